"""Reading a model class: which variables it declares, in which order they happen, and whether it can mean anything.

Within a step the order is act, move, sense: actions have no parents, states come before observations, and what
is drawn once an episode comes before time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from inspect import isfunction
from typing import Any

import torch

from apmodels.errors import DeclarationError, nearest
from apmodels.spaces import Space
from apmodels.variables import NO_SPACE, PREVIOUS, ROLES, Parent, Variable

# What each role may have as a parent in this step.
ALLOWED = {
    "static": ("static",),
    "state": ("static", "action", "state"),
    "observation": ROLES,
    "interest": ROLES,
}


@dataclass(frozen=True)
class Declaration:
    """The variables of one model class, in the order in which they happen, and its interest."""

    name: str
    variables: dict[str, Variable]
    interest: Variable | None
    interest_names: tuple[str, ...]

    def of_role(self, *roles: str) -> list[Variable]:
        """Return the variables of these roles, in order."""
        return [variable for variable in self.variables.values() if variable.role in roles]

    @cached_property
    def names(self) -> dict[str, list[str]]:
        """Role -> the names of its variables, in order."""
        return {role: [variable.name for variable in self.of_role(role)] for role in ROLES}

    @cached_property
    def remembered(self) -> dict[str, object]:
        """The variables that some law asks for a step late, with their values before time began."""
        lagged = [parent for v in self.variables.values() for parent in v.parents if parent.lag]
        return {parent.name: parent.before for parent in lagged}


def declare(cls: type) -> Declaration:
    """Read and check a model class; raises DeclarationError naming class, variable and mend."""
    found = _collect(cls)
    _check_names(cls, found)
    for variable in found.values():
        for parent in variable.parents:
            _check_parent(cls, variable, parent, found)
        _check_pins(cls, variable)
        if variable.role == "action" and not (isinstance(variable.space, Space) or isfunction(variable.space)):
            raise DeclarationError(f"{cls.__name__}.{variable.name} {NO_SPACE}")
    ordered = _in_order(cls, found)
    interest, names = _read_interest(cls, ordered)
    declaration = Declaration(cls.__name__, ordered, interest, names)
    _check_senses(cls, declaration)
    _check_befores(cls, declaration)
    return declaration


def _collect(cls: type) -> dict[str, Variable]:
    found: dict[str, Variable] = {}
    for base in reversed(cls.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, Variable) and name != "interest":
                found[value.name] = value
            elif name in found:
                raise DeclarationError(
                    f"{cls.__name__}.{name} replaces the {found[name].role} {name} by something that is no variable; "
                    f"write @{found[name].role} above it, or choose another name"
                )
    return found


def _check_names(cls: type, found: dict[str, Variable]) -> None:
    fields = getattr(cls, "__dataclass_fields__", {})
    for name, variable in found.items():
        if name.startswith(PREVIOUS):
            raise DeclarationError(f"{cls.__name__}.{name}: names that begin with {PREVIOUS} mean a step ago")
        if variable.role == "interest":
            raise DeclarationError(f"{cls.__name__}.{name}: an @interest method must be called interest")
        if name in fields:
            raise DeclarationError(f"{cls.__name__}.{name} is a field and a variable; rename one of them")


def _check_parent(cls: type, variable: Variable, parent: Parent, found: dict[str, Variable]) -> None:
    where = f"{cls.__name__}.{variable.name}"
    if parent.name not in found:
        if parent.name in getattr(cls, "__dataclass_fields__", {}):
            raise DeclarationError(f"{where}: {parent.name} is a field, which is known; write self.{parent.name}")
        if callable(getattr(cls, parent.name, None)):
            raise DeclarationError(
                f"{where} has a parent {parent.name}, which is a plain method; "
                "write @static, @state or @observation above it"
            )
        raise DeclarationError(
            f"{where} has an unknown parent {parent.argument}{nearest(parent.name, found)}; "
            "declare it, or write self. before it if it is a field"
        )
    role = found[parent.name].role
    if parent.lag and role == "static":
        raise DeclarationError(f"{where}: {parent.name} is static and never changes; write {parent.name}")
    if parent.lag and variable.role == "static":
        raise DeclarationError(f"{where} is drawn before time began and has no {parent.argument}; make it a @state")
    if not parent.lag and role not in ALLOWED[variable.role]:
        mend = "make it a @state" if variable.role == "static" else f"write {PREVIOUS}{parent.name}=..."
        raise DeclarationError(
            f"{where} is {_a(variable.role)} and cannot depend on the {role} {parent.name} of the same step "
            f"(the order is act, move, sense); {mend}"
        )


def _check_pins(cls: type, variable: Variable) -> None:
    arguments = {p.argument for p in variable.parents} | {p.name for p in variable.parents}
    for name in variable.pins:
        if name not in arguments:
            raise DeclarationError(
                f"{cls.__name__}.{variable.name} pins the kind of {name}, which is no parent of it"
                f"{nearest(name, sorted(arguments))}"
            )


def _a(role: str) -> str:
    return f"an {role}" if role[0] in "aeiou" else f"a {role}"


def _in_order(cls: type, found: dict[str, Variable]) -> dict[str, Variable]:
    """Sort by role and then so that parents come first; a cycle within a step is an error."""
    ordered: dict[str, Variable] = {}

    def place(variable: Variable, path: tuple[str, ...]) -> None:
        if variable.name in path:
            cycle = " -> ".join([*path[path.index(variable.name) :], variable.name])
            raise DeclarationError(
                f"{cls.__name__}.{variable.name} depends on itself within a step ({cycle}); "
                f"let one of them depend on {PREVIOUS}{path[-1]} instead"
            )
        if variable.name in ordered:
            return
        for parent in variable.parents:
            if not parent.lag:
                place(found[parent.name], (*path, variable.name))
        ordered[variable.name] = variable

    for role in ROLES:
        for variable in found.values():
            if variable.role == role:
                place(variable, ())
    return ordered


def _read_interest(cls: type, found: dict[str, Variable]) -> tuple[Variable | None, tuple[str, ...]]:
    declared = getattr(cls, "interest", None)
    if declared is None:
        return None, tuple(v.name for v in found.values() if v.role in ("static", "state"))
    if isinstance(declared, Variable) and declared.role == "interest":
        for parent in declared.parents:
            _check_parent(cls, declared, parent, found)
            if parent.lag:
                raise DeclarationError(f"{cls.__name__}.interest: information is about now; write {parent.name}")
        return declared, tuple(parent.name for parent in declared.parents)
    several = declared if isinstance(declared, (tuple, list)) else (declared,)
    names = tuple(v.name if isinstance(v, Variable) else str(v) for v in several)
    for name in names:
        if name not in found:
            raise DeclarationError(f"{cls.__name__}.interest: there is no variable {name}{nearest(name, found)}")
        if found[name].role not in ("static", "state"):
            raise DeclarationError(
                f"{cls.__name__}.interest: {name} is {_a(found[name].role)} and no secret; name a static or a state"
            )
    return None, names


def _check_senses(cls: type, declaration: Declaration) -> None:
    if not declaration.of_role("observation"):
        raise DeclarationError(
            f"{cls.__name__} has no observation, so nothing can ever be learned; "
            "declare one with @observation, or write class "
            f"{cls.__name__}(..., abstract=True) if it is only to be inherited"
        )
    for variable in declaration.of_role("static", "state"):
        family = _ancestors(variable.name, declaration.variables)
        if not any(_reaches_observation(name, declaration.variables) for name in family):
            raise DeclarationError(
                f"{cls.__name__}.{variable.name} is a {variable.role} that nothing can ever inform: no observation "
                f"depends on it or on its causes; make it an argument of an observation, or remove it"
            )


def _ancestors(name: str, found: dict[str, Variable]) -> set[str]:
    """The variable and its causes at any lag, but for actions: those are chosen, and no secret."""
    seen: set[str] = set()
    waiting = [name]
    while waiting:
        at = waiting.pop()
        if at in seen or at not in found or found[at].role == "action":
            continue
        seen.add(at)
        for parent in found[at].parents:
            waiting.append(parent.name)
            if isinstance(parent.before, Variable):
                waiting.append(parent.before.name)
    return seen


def _reaches_observation(name: str, found: dict[str, Variable]) -> bool:
    return any(v.role == "observation" and name in _ancestors(v.name, found) for v in found.values())


def _check_befores(cls: type, declaration: Declaration) -> None:
    for variable in declaration.variables.values():
        for parent in variable.parents:
            if not (parent.lag and isinstance(parent.before, Variable)):
                continue
            first = declaration.variables.get(parent.before.name)
            if first is None or first.role != "static":
                raise DeclarationError(
                    f"{cls.__name__}.{variable.name}: {parent.argument} begins as {parent.before.name}, "
                    "which must be a @static variable of the model"
                )
    _check_one_before(cls, declaration)


def _check_one_before(cls: type, declaration: Declaration) -> None:
    firsts: dict[str, tuple[Variable, Any]] = {}
    for variable in declaration.variables.values():
        for parent in variable.parents:
            if not parent.lag:
                continue
            other, before = firsts.setdefault(parent.name, (variable, parent.before))
            if before is not parent.before and not _same(before, parent.before):
                raise DeclarationError(
                    f"{cls.__name__}: {parent.argument} begins as {before!r} in {other.name} and as "
                    f"{parent.before!r} in {variable.name}; a variable has one value before time began"
                )


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Variable) or isinstance(b, Variable) or callable(a) or callable(b):
        return False
    return torch.equal(torch.as_tensor(a).double(), torch.as_tensor(b).double())
