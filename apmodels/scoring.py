"""Scoring whole records of a model's worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from apmodels.errors import ValueOutOfRange, nearest
from apmodels.evidence import Evidence
from apmodels.laws import Laws
from apmodels.simulation import Values, Worlds, check_actions, fitted
from apmodels.variables import Variable


def log_prob(model: Any, record: Mapping[str, Tensor]) -> Tensor:
    """See ``Model.log_prob``."""
    values, batched = _as_batch(model, record)
    names = model.declaration.names
    timed = [name for role in ("action", "state", "observation") for name in names[role] if name in values]
    rows, steps = values[timed[0]].shape[:2]
    scorer = _Scorer(Laws(model), rows, {name: values[name] for name in names["static"] if name in values})
    for t in range(steps):
        scorer.given = {name: values[name][:, t] for name in timed}
        scorer.step({name: scorer.given[name] for name in names["action"]})
    return scorer.total if batched else scorer.total[0]


def _as_batch(model: Any, record: Mapping[str, Tensor]) -> tuple[Values, bool]:
    """Check a record's names and shapes; return it with a batch dimension, and whether it had one."""
    variables = model.declaration.variables
    name = type(model).__name__
    for given in record:
        if given not in variables:
            raise ValueOutOfRange(f"{name} has no variable {given}{nearest(given, variables)}")
    for needed in (*model.action_names, *model.observation_names):
        if needed not in record:
            raise ValueOutOfRange(f"the record of {name} has no {variables[needed].role} {needed}")
    values = {key: torch.as_tensor(value) for key, value in record.items()}
    values |= check_actions(model, {key: values[key] for key in model.action_names})
    extra = {key: values[key].dim() - len(_shape(model, key)) - _times(variables[key]) for key in values}
    known = {key: n for key, n in extra.items() if model.structure.nodes[key].family != "Evidence"}
    batched = max(known.values(), default=0) == 1
    if not batched:
        values = {key: value[None] for key, value in values.items()}
    sizes: dict[int, tuple[str, int]] = {}
    for key, value in values.items():
        _check_lead(model, key, value, known.get(key, int(batched)) != int(batched), sizes)
    return values, batched


def _check_lead(model: Any, key: str, value: Tensor, misfit: bool, sizes: dict[int, tuple[str, int]]) -> None:
    """Raise ValueOutOfRange unless a variable has as many records and steps as the others."""
    where = f"{type(model).__name__}.{key}"
    shape, times = _shape(model, key), _times(model.declaration.variables[key])
    evidence = model.structure.nodes[key].family == "Evidence"
    if misfit or (not evidence and tuple(value.shape[1 + times :]) != shape):
        raise ValueOutOfRange(f"{where} has shape {tuple(value.shape[1:])}, but one value of it has shape {shape}")
    for dim in range(1 + times):
        other, size = sizes.setdefault(dim, (key, value.shape[dim]))
        if value.shape[dim] != size:
            what = "steps" if dim else "records"
            raise ValueOutOfRange(f"{where} has {value.shape[dim]} {what}, but {other} has {size}")


def _shape(model: Any, key: str) -> tuple[int, ...]:
    return tuple(model.structure.nodes[key].shape)


def _times(variable: Variable) -> int:
    return 0 if variable.role == "static" else 1


class _Scorer(Worlds):
    """Worlds that are given instead of drawn: each random variable adds its log probability."""

    def __init__(self, laws: Laws, batch: int, given: Values):
        self.total = torch.zeros(batch)
        super().__init__(laws, batch, given)

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        parents = self.parents(variable, values)
        law = self.laws.one(variable.name, {name: value[0] for name, value in parents.items()})
        if isinstance(law, Tensor):
            return self.law(variable, values)  # type: ignore[return-value]
        where = f"{type(self.laws.model).__name__}.{variable.name}"
        if variable.name not in self.given:
            raise ValueOutOfRange(f"the record has no {variable.role} {variable.name}, which is random")
        value = self.given[variable.name]
        value = value.to(self.laws.dtype) if value.is_floating_point() else value
        if not isinstance(law, Evidence):
            value = fitted(law, value, self.batch, where)
        if variable.role != "observation" and value.is_floating_point() and torch.isnan(value).any():
            raise ValueOutOfRange(f"{variable.name} is NaN; only observations may be missing")
        self.total = self.total + self.laws.score(variable.name, parents, value, (self.batch,))
        return value
