"""Random variables as methods: the decorators with which a model is declared.

A variable's parents are the arguments of its method: ``name`` is the parent in this step, ``prev_name=before``
the same one a step ago, and ``before`` its value before time began (a number, a tensor, another variable, or a
function of the model).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from apmodels.errors import DeclarationError

PREVIOUS = "prev_"
ROLES = ("static", "action", "state", "observation")
NO_SPACE = "has no space; write action(Binary()), action(Grid(7, 7)), or action(lambda self: self.grid)"
KINDS = ("finite", "selects", "affine", "moves", "given", "nonlinear")


@dataclass(frozen=True)
class Parent:
    """One argument of a law: which variable it is, and how many steps ago."""

    name: str
    lag: int = 0
    before: Any = None

    @property
    def argument(self) -> str:
        """The argument's name as the law spells it."""
        return PREVIOUS + self.name if self.lag else self.name


class Variable:
    """A declared variable: its role, its law and its parents. On an instance it is the law itself, bound."""

    def __init__(self, role: str, law: Callable | None = None, space: Any = None, pins: dict | None = None):
        self.role = role
        self.law = law
        self.space = space
        self.pins = dict(pins or {})
        self.name = ""
        self.owner = ""
        self.__doc__ = inspect.getdoc(law) if law is not None else None
        for parent, kind in self.pins.items():
            if kind not in KINDS:
                raise DeclarationError(f"the kind pinned for {parent} is {kind!r}; it must be one of {KINDS}")

    def __set_name__(self, owner: type, name: str) -> None:
        # `interest = responsive` gives one variable a second name; its own name is the first.
        if not self.name:
            self.name, self.owner = name, owner.__name__

    def __get__(self, model: Any, owner: type | None = None) -> Any:
        if model is None:
            return self
        return self.space_of(model) if self.role == "action" else functools.partial(self.law, model)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return f"<{self.role} {self.owner}.{self.name}>"

    def space_of(self, model: Any) -> Any:
        """Return an action's space, for a model whose parameters may decide it."""
        return self.space(model) if inspect.isfunction(self.space) else self.space

    @functools.cached_property
    def parents(self) -> tuple[Parent, ...]:
        """The parents in the order of the law's arguments; empty for an action."""
        if self.law is None:
            return ()
        arguments = list(inspect.signature(self.law).parameters.values())
        if not arguments or arguments[0].name != "self":
            raise DeclarationError(f"{self.owner}.{self.name}: the first argument of a law is self; its parents follow")
        arguments = arguments[1:]
        return tuple(self._parent(argument) for argument in arguments)

    def _parent(self, argument: inspect.Parameter) -> Parent:
        where = f"{self.owner}.{self.name}"
        if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
            raise DeclarationError(
                f"{where} takes *{argument.name}: name each parent, an argument is a random variable"
            )
        has_default = argument.default is not argument.empty
        if not argument.name.startswith(PREVIOUS):
            if has_default:
                raise DeclarationError(
                    f"{where}: {argument.name}={argument.default!r} has a default, but only a {PREVIOUS} argument "
                    f"has a value before time began; write {argument.name}, or make it a field and use self."
                )
            return Parent(argument.name)
        name = argument.name.removeprefix(PREVIOUS)
        if not has_default:
            raise DeclarationError(
                f"{where}: {argument.name} needs its value before time began; "
                f"write {argument.name}=0, or another variable"
            )
        before = argument.default
        return Parent(name, 1, before)


def _declare(role: str, law: Callable | None, pins: dict | None) -> Any:
    if law is None:
        return lambda function: Variable(role, function, pins=pins)
    return Variable(role, law)


def static(law: Callable | None = None, *, kinds: dict[str, str] | None = None) -> Any:
    """Declare a variable drawn once an episode. ``kinds`` pins the kind of an arrow by its parent's name."""
    return _declare("static", law, kinds)


def state(law: Callable | None = None, *, kinds: dict[str, str] | None = None) -> Any:
    """Declare a variable that has a new value every step. ``kinds`` as for :func:`static`."""
    return _declare("state", law, kinds)


def observation(law: Callable | None = None, *, kinds: dict[str, str] | None = None) -> Any:
    """Declare what the body senses at the end of every step. ``kinds`` as for :func:`static`."""
    return _declare("observation", law, kinds)


def interest(law: Callable) -> Any:
    """Declare what information is about, as a function of other variables."""
    return Variable("interest", law)


def action(space: Any) -> Any:
    """Declare an action: it has a space (or a function of the model that returns one) and no law."""
    return Variable("action", space=space)
