"""The base of every model: a class whose methods are random variables and whose fields are parameters."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from inspect import get_annotations
from typing import Any, ClassVar, dataclass_transform

import numpy as np
import torch
from torch import Tensor

from apmodels import declaration as declarations
from apmodels import scoring, simulation
from apmodels.errors import DeclarationError, ValueOutOfRange, nearest
from apmodels.laws import Laws
from apmodels.simulation import Values
from apmodels.spaces import Space
from apmodels.variables import NO_SPACE, Variable


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Model:
    """What the world is like, declared once.

    A subclass is a frozen dataclass: annotated names are parameters, given by keyword. Methods under
    ``@static``, ``@state`` and ``@observation`` are random variables whose parents are their arguments;
    ``name = action(space)`` is what the agent chooses. A wrong declaration raises DeclarationError when the
    class is made; write ``class Base(Model, abstract=True)`` for one that is only to be inherited.
    """

    declaration: ClassVar[declarations.Declaration]

    def __init_subclass__(cls, abstract: bool = False, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _reserve(cls)
        dataclasses.dataclass(frozen=True, eq=False, kw_only=True, repr=True)(cls)
        cls.__init__ = _checking(cls.__init__)  # type: ignore[method-assign]
        if not abstract:
            cls.declaration = declarations.declare(cls)

    def __post_init__(self) -> None:
        """Evaluate what has no parents, so that a wrong parameter fails when the model is built."""
        if "declaration" not in type(self).__dict__:
            raise TypeError(f"{type(self).__name__} is abstract: it declares no whole model; inherit from it")
        for variable in self.declaration.of_role("action"):
            if not isinstance(variable.space_of(self), Space):
                raise DeclarationError(f"{type(self).__name__}.{variable.name} {NO_SPACE}")
        laws = Laws(self)
        for variable in self.declaration.of_role("static"):
            if not variable.parents:
                laws.one(variable.name, {})

    def replace(self, **changes: Any) -> Any:
        """Return a copy with other parameters."""
        fields = [field.name for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        for name in changes:
            if name not in fields:
                raise ValueOutOfRange(f"{type(self).__name__} has no parameter {name}{nearest(name, fields)}")
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def space(self, name: str) -> Space:
        """Return the space of an action."""
        return self.declaration.variables[name].space_of(self)

    @property
    def action_names(self) -> list[str]:
        """The actions, in order."""
        return self.declaration.names["action"]

    @property
    def observation_names(self) -> list[str]:
        """The observations, in order."""
        return self.declaration.names["observation"]

    def simulate(
        self,
        steps: int,
        actions: Any = None,
        batch: int | None = None,
        seed: int | None = None,
        given: Mapping[str, Any] | None = None,
    ) -> Values:
        """Draw records of this world.

        Args:
            steps: how many steps.
            actions: (steps, *shape) or (batch, steps, *shape), a dict by name where there are several; drawn
                uniformly from their spaces where None.
            batch: how many records; None for one without a batch dimension.
            seed: for draws that can be repeated.
            given: values of statics that are fixed instead of drawn, scalars or (batch, *shape).

        Returns:
            Every variable by name: statics (batch, *shape), all others (batch, steps, *shape).
        """
        return simulation.simulate(self, steps, actions, batch, seed, given)

    def log_prob(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the log density, in nats, of a record as ``simulate`` returns it: (batch,), or () without batch.

        Deterministic variables may be left out; observations that are NaN are missing.
        """
        return scoring.log_prob(self, record)

    def pyro(
        self, steps: int | None = None, actions: Any = None, observations: Any = None, enumerate_finite: bool = True
    ) -> Any:
        """Return this model as a Pyro program without arguments, for SVI, NUTS and all else that Pyro has.

        Args:
            steps: how many steps; may be left out where a record is given.
            actions: (steps, *shape), or (batch, steps, *shape) for a plate of records; dicts by name of several.
            observations: likewise; NaN is missing. Where None, they are sample sites too.
            enumerate_finite: mark hidden finite variables for parallel enumeration, which NUTS needs.

        Returns:
            A function whose sites are called like the variables, with ``_1``, ``_2`` ... after those that change.
        """
        from apmodels.pyro_export import export

        return export(self, steps, actions, observations, enumerate_finite)

    @property
    def structure(self) -> Any:
        """The variables, the kind of every arrow, and what can be integrated; read once, by probing the laws."""
        from apmodels.structure import read

        if "_structure" not in self.__dict__:
            object.__setattr__(self, "_structure", read(self))
        return self.__dict__["_structure"]

    def explain(self) -> Any:
        """Return an explanation that prints: the variables, the kinds of arrows, what is integrated, and why."""
        from apmodels.explanation import Explanation

        return Explanation(self)

    def _repr_html_(self) -> str:
        from apmodels.drawing import draw

        return draw(self)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_structure"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        names = [field.name for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        return all(_equal(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        return hash(type(self))


def _checking(init: Any) -> Any:
    """Wrap a dataclass's constructor, so that a misspelt or nameless parameter is told in the model's own words."""

    @functools.wraps(init)
    def checked(self: Any, *values: Any, **parameters: Any) -> None:
        fields = [field.name for field in dataclasses.fields(self) if field.init]
        if values:
            raise ValueOutOfRange(f"{type(self).__name__} takes its parameters by name: {', '.join(fields)}")
        for name in parameters:
            if name not in fields:
                raise ValueOutOfRange(f"{type(self).__name__} has no parameter {name}{nearest(name, fields)}")
        init(self, **parameters)

    return checked


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return torch.equal(a, b)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, (tuple, list)) and type(a) is type(b):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _reserve(cls: type) -> None:
    """Refuse a variable that would hide a method which every model has."""
    reserved = {name for name in (*vars(Model), "declaration") if not name.startswith("__")}
    fields = get_annotations(cls)
    variables = [name for name, value in vars(cls).items() if isinstance(value, Variable)]
    for name in (*variables, *fields):
        if name in reserved:
            raise DeclarationError(f"{cls.__name__}.{name}: every model has a {name}; choose another name")
