"""Drawing worlds from a model, many at a time, and scoring whole records of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.errors import ValueOutOfRange
from apmodels.laws import Laws
from apmodels.variables import Variable

Values = dict[str, Tensor]


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from a seed of one's own, and leave the global generator as it was."""
    if seed is None:
        yield
        return
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


class Worlds:
    """A batch of worlds drawn from a model, moved on by actions. Values are (batch, *shape) by variable."""

    def __init__(self, laws: Laws, batch: int, given: Mapping[str, Any] | None = None):
        self.laws = laws
        self.batch = batch
        self.given = {name: torch.as_tensor(value) for name, value in (given or {}).items()}
        declaration = laws.model.declaration
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
            given = self.given[variable.name]
            return given.expand(self.batch, *given.shape[1:]) if given.dim() else given.expand(self.batch)
        law = self.law(variable, values)
        return law.sample() if isinstance(law, Distribution) else law


def as_dict(values: Any, names: list[str], what: str) -> Values:
    """Return what a user gave for several variables as a dict: None for none, a tensor for one, a dict for more."""
    if not names:
        if values is not None and values != {}:
            raise ValueOutOfRange(f"this model has no {what}; pass None")
        return {}
    if isinstance(values, Tensor) and len(names) == 1:
        return {names[0]: values}
    if isinstance(values, Mapping):
        unknown = [name for name in values if name not in names]
        missing = [name for name in names if name not in values]
        if unknown or missing:
            raise ValueOutOfRange(f"the {what}s are {names}; unknown: {unknown}, missing: {missing}")
        return {name: torch.as_tensor(values[name]) for name in names}
    if values is None:
        raise ValueOutOfRange(f"an {what} is needed: {names}")
    if len(names) > 1:
        raise ValueOutOfRange(f"this model has several {what}s; pass a dict by name: {names}")
    return {names[0]: torch.as_tensor(values)}


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
    whole = {}
    for name, value in given.items():
        inner = len(spaces[name].shape)
        if value.dim() - inner == 0 or value.shape[value.dim() - inner - 1] != steps:
            raise ValueOutOfRange(f"{steps} steps need {steps} actions {name}, but it has shape {tuple(value.shape)}")
        if value.dim() - inner == 1:
            value = value.expand(batch or 1, *value.shape)
        whole[name] = value
    return whole


def log_prob(model: Any, record: Mapping[str, Tensor]) -> Tensor:
    """See ``Model.log_prob``."""
    declaration = model.declaration
    statics = [v.name for v in declaration.of_role("static")]
    timed = [v for v in declaration.of_role("action", "state", "observation") if v.name in record]
    if not timed:
        raise ValueOutOfRange(f"a record of {type(model).__name__} needs {list(declaration.variables)}")
    laws = Laws(model)
    space = timed[0].space_of(model) if timed[0].role == "action" else None
    batched = _is_batched(model, laws, record, timed[0], space)
    record = {name: torch.as_tensor(v) if batched else torch.as_tensor(v)[None] for name, v in record.items()}
    first = record[timed[0].name]
    scorer = _Scorer(laws, first.shape[0], {name: record[name] for name in statics if name in record})
    for t in range(first.shape[1]):
        scorer.given = {variable.name: record[variable.name][:, t] for variable in timed}
        scorer.step({variable.name: scorer.given[variable.name] for variable in timed if variable.role == "action"})
    return scorer.total if batched else scorer.total[0]


def _is_batched(model: Any, laws: Laws, record: Mapping[str, Tensor], timed: Variable, space: Any) -> bool:
    """Tell (batch, time, *shape) from (time, *shape) by the shape that the variable has in one world."""
    if space is not None:
        shape = space.shape
    else:
        with seeded(0):
            worlds = Worlds(laws, 1)
            worlds.step({name: model.space(name).sample((1,)) for name in model.action_names})
        shape = worlds.values[timed.name].shape[1:]
    return torch.as_tensor(record[timed.name]).dim() - len(shape) == 2


class _Scorer(Worlds):
    """Worlds that are given instead of drawn: each random variable adds its log probability."""

    def __init__(self, laws: Laws, batch: int, given: Values):
        self.total = torch.zeros(batch)
        super().__init__(laws, batch, given)

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        parents = self.parents(variable, values)
        example = self.laws.one(variable.name, {name: value[0] for name, value in parents.items()})
        if isinstance(example, Tensor):
            return self.law(variable, values)  # type: ignore[return-value]
        if variable.name not in self.given:
            raise ValueOutOfRange(f"the record has no {variable.role} {variable.name}, which is random")
        value = self.given[variable.name]
        value = value.to(self.laws.dtype) if value.is_floating_point() else value
        if variable.role != "observation" and value.is_floating_point() and torch.isnan(value).any():
            raise ValueOutOfRange(f"{variable.name} is NaN; only observations may be missing")
        self.total = self.total + self.laws.score(variable.name, parents, value, (self.batch,))
        return value
