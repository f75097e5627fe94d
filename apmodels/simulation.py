"""Drawing worlds from a model, many at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of
from apmodels.errors import ValueOutOfRange, nearest
from apmodels.laws import Laws
from apmodels.variables import Variable

Values = dict[str, Tensor]


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from a seed of one's own, and leave the global generator as it was."""
    if seed is None:
        yield
        return
    # Far quicker than fork_rng and manual_seed, which note a traceback for devices that are not there.
    before = torch.get_rng_state()
    torch.default_generator.manual_seed(seed)
    try:
        yield
    finally:
        torch.set_rng_state(before)


class Worlds:
    """A batch of worlds drawn from a model, moved on by actions. Values are (batch, *shape) by variable."""

    def __init__(self, laws: Laws, batch: int, given: Mapping[str, Any] | None = None):
        self.laws = laws
        self.batch = batch
        self.given = {name: torch.as_tensor(value) for name, value in (given or {}).items()}
        declaration = laws.model.declaration
        for name in self.given:
            if name not in declaration.names["static"]:
                statics = nearest(name, declaration.names["static"])
                raise ValueOutOfRange(f"{type(laws.model).__name__} has no static {name} to give{statics}")
        self.statics: Values = {}
        self.values: Values = {}
        for variable in declaration.of_role("static"):
            self.statics[variable.name] = self._draw(variable, self.statics)
        self.previous: Values = {}
        for name in declaration.remembered:
            before = laws.before(name)
            if isinstance(before, Variable):
                self.previous[name] = self.statics[before.name]
            else:
                self.previous[name] = before.expand(batch, *before.shape)

    def step(self, actions: Values) -> Values:
        """Act, move, sense: draw the next states and observations and return the observations."""
        declaration = self.laws.model.declaration
        values = {**self.statics, **actions}
        for variable in declaration.of_role("state", "observation"):
            values[variable.name] = self._draw(variable, values)
        self.values = values
        self.previous = {name: values[name] for name in self.previous}
        return {v.name: values[v.name] for v in declaration.of_role("observation")}

    def parents(self, variable: Variable, values: Values) -> Values:
        """Return a law's arguments, by argument name."""
        return {p.argument: (self.previous if p.lag else values)[p.name] for p in variable.parents}

    def law(self, variable: Variable, values: Values) -> Tensor | Distribution:
        """Evaluate a variable's law in every world."""
        return self.laws.many(variable.name, self.parents(variable, values), (self.batch,))

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        if variable.name in self.given:
            parents = {name: value[0] for name, value in self.parents(variable, values).items()}
            law = self.laws.one(variable.name, parents)
            where = f"{type(self.laws.model).__name__}.{variable.name}"
            return fitted(law, self.given[variable.name], self.batch, where)
        law = self.law(variable, values)
        return law.sample() if isinstance(law, Distribution) else law


def fitted(law: Tensor | Distribution, value: Tensor, batch: int, where: str) -> Tensor:
    """Return a value that was given for a variable as (batch, *shape); ValueOutOfRange where it cannot be one."""
    shape = tuple(law.shape if isinstance(law, Tensor) else law.event_shape)
    if tuple(value.shape) not in (shape, (1, *shape), (batch, *shape)):
        raise ValueOutOfRange(f"{where} has shape {tuple(value.shape)}; one value has shape {shape}, of {batch} worlds")
    base = base_of(law)[0] if isinstance(law, Distribution) else None
    good = ~torch.isinf(value)
    if base is not None and not len(base.event_shape) and base.support.is_discrete:
        good = torch.isnan(value) | base.support.check(value)
    if not bool(good.all()):
        raise ValueOutOfRange(f"{where} is {value[~good].flatten()[0]:g}, which it can never be")
    return value.expand(batch, *shape)


def as_dict(values: Any, names: list[str], what: str, dtype: torch.dtype | None = None) -> Values:
    """Return what a user gave for several variables as a dict: None for none, a tensor for one, a dict for more.

    Numbers that are no arrays yet are read with ``dtype`` where they have a fraction.
    """
    if not names:
        if values is not None and values != {}:
            raise ValueOutOfRange(f"this model has no {what}; pass None")
        return {}
    # The commonest cases first: looking whether a number is a mapping takes longer than a step of the loop may.
    if len(names) == 1 and isinstance(values, (Tensor, int)):
        return {names[0]: torch.as_tensor(values)}
    if isinstance(values, Mapping):
        unknown = [name for name in values if name not in names]
        missing = [name for name in names if name not in values]
        if unknown or missing:
            raise ValueOutOfRange(f"the {what}s are {names}; unknown: {unknown}, missing: {missing}")
        return {name: _as_tensor(values[name], what, name, dtype) for name in names}
    if values is None:
        raise ValueOutOfRange(f"an {what} is needed: {names}")
    if len(names) > 1:
        raise ValueOutOfRange(f"this model has several {what}s; pass a dict by name: {names}")
    return {names[0]: _as_tensor(values, what, names[0], dtype)}


def _as_tensor(value: Any, what: str, name: str, dtype: torch.dtype | None) -> Any:
    if isinstance(value, Tensor):
        return value
    # A name, of a finite space that has names, is for the space to read.
    if isinstance(value, str) and what == "action":
        return value
    try:
        found = torch.as_tensor(value)
        plain = not hasattr(value, "dtype") and found.is_floating_point()
        return torch.as_tensor(value, dtype=dtype) if plain and dtype is not None else found
    except (TypeError, ValueError, RuntimeError):
        raise ValueOutOfRange(f"the {what} {name} is {value!r}, and no number or array of numbers") from None


def as_given(values: Values) -> Any:
    """The reverse of :func:`as_dict`: None, a tensor or a dict."""
    if not values:
        return None
    return next(iter(values.values())) if len(values) == 1 else values


def check_actions(model: Any, actions: Values) -> Values:
    """Return actions as the spaces want them; ValueOutOfRange, by name, for one that is outside its space."""
    variables = model.declaration.variables
    name = type(model).__name__
    return {key: variables[key].space_of(model).check(value, f"{name}.{key}") for key, value in actions.items()}


def simulate(
    model: Any, steps: int, actions: Any, batch: int | None, seed: int | None, given: Mapping[str, Any] | None
) -> Values:
    """See ``Model.simulate``."""
    if steps < 1 or (batch is not None and batch < 1):
        raise ValueOutOfRange(f"there must be 1 step or more and 1 record or more, not {steps} and {batch}")
    count = 1 if batch is None else batch
    names = model.action_names
    with seeded(seed):
        drawn = _actions(model, actions, names, steps, batch)
        worlds = Worlds(Laws(model), count, given)
        slices = []
        for t in range(steps):
            worlds.step({name: drawn[name][:, t] for name in names})
            slices.append(worlds.values)
    record = dict(worlds.statics)
    for variable in model.declaration.of_role("action", "state", "observation"):
        record[variable.name] = torch.stack([values[variable.name] for values in slices], 1)
    return {name: value[0] for name, value in record.items()} if batch is None else record


def _actions(model: Any, actions: Any, names: list[str], steps: int, batch: int | None) -> Values:
    """Return actions (batch, steps, *shape) by name; uniform draws where none were given."""
    spaces = {name: model.space(name) for name in names}
    if actions is None:
        return {name: space.sample((batch or 1, steps)) for name, space in spaces.items()}
    given = check_actions(model, as_dict(actions, names, "action"))
    return {name: _record_of(name, value, spaces[name].shape, steps, batch) for name, value in given.items()}


def _record_of(name: str, value: Tensor, shape: tuple[int, ...], steps: int, batch: int | None) -> Tensor:
    """A record of actions as (batch, steps, *shape)."""
    lead = tuple(value.shape[: value.dim() - len(shape)])
    if lead not in ((steps,), (1, steps), (batch or 1, steps)):
        each = f" in each of {batch} records" if batch else ""
        shape = tuple(value.shape)
        raise ValueOutOfRange(f"{steps} steps need {steps} actions {name}{each}, but it has shape {shape}")
    return value.expand(batch or 1, steps, *shape)
