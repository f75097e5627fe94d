"""A model as a Pyro program, so that SVI, NUTS and the rest of Pyro are open to its users.

Sites are called like the variables: ``target`` for a static, ``position_1``, ``position_2`` ... for what changes, by
step. Laws are vectorised over whatever dimensions Pyro puts to the left: plates, enumeration, particles.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import pyro
import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of, log_prob_of
from apmodels.errors import ValueOutOfRange
from apmodels.evidence import Evidence
from apmodels.laws import Laws
from apmodels.planted import Planted
from apmodels.simulation import Values, as_dict, check_actions
from apmodels.variables import Variable


def export(
    model: Any, steps: int | None, actions: Any, observations: Any, enumerate_finite: bool
) -> Callable[[], Values]:
    """See ``Model.pyro``."""
    names = model.declaration.names
    shapes = {name: tuple(node.shape) for name, node in model.structure.nodes.items()}
    acts = check_actions(model, as_dict(actions, names["action"], "action")) if names["action"] else {}
    seen = as_dict(observations, names["observation"], "observation") if observations is not None else {}
    records = acts | seen
    extra = {name: value.dim() - 1 - len(shapes[name]) for name, value in records.items()}
    if any(n not in (0, 1) for n in extra.values()):
        raise ValueOutOfRange(f"records are (steps, *shape) or (batch, steps, *shape), not {_shapes(records)}")
    lengths = {value.shape[extra[name]] for name, value in records.items()} | ({steps} if steps is not None else set())
    if len(lengths) != 1:
        raise ValueOutOfRange(f"one number of steps is needed, not {sorted(lengths)}; give steps=, or records")
    batches = {len(value) for name, value in records.items() if extra[name]}
    if len(batches) > 1:
        raise ValueOutOfRange(f"the records differ in how many they are: {_shapes(records)}")
    batch = next(iter(batches), None)
    finite = (
        {n.name for n in model.structure.hidden if n.random and n.values is not None} if enumerate_finite else set()
    )
    timed = {name: (value if extra[name] else value[None]).movedim(1, 0) for name, value in records.items()}
    if batch is None:
        timed = {name: value[:, 0] for name, value in timed.items()}
    program = _Program(model, shapes, finite, timed, next(iter(lengths)), batch)
    return program.run


def _shapes(records: Values) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in records.items()}


class _Program:
    """One run of the model: every random variable is a sample statement."""

    def __init__(self, model: Any, shapes: dict, finite: set[str], records: Values, steps: int, batch: int | None):
        self.laws = Laws(model)
        self.declaration = model.declaration
        self.shapes, self.finite, self.records = shapes, finite, records
        self.steps, self.batch = steps, batch

    def run(self) -> Values:
        """Return the values of all sites, by site."""
        plate = pyro.plate("records", self.batch, dim=-1) if self.batch is not None else contextlib.nullcontext()
        with plate:
            statics: Values = {}
            for variable in self.declaration.of_role("static"):
                statics[variable.name] = self._site(variable, variable.name, statics, {})
            past = {name: self._before(name, statics) for name in self.declaration.remembered}
            found = dict(statics)
            for t in range(self.steps):
                now = {**statics, **{name: self.records[name][t] for name in self.declaration.names["action"]}}
                for variable in self.declaration.of_role("state", "observation"):
                    site = f"{variable.name}_{t + 1}"
                    now[variable.name] = found[site] = self._site(variable, site, now, past, t)
                past = {name: now[name] for name in past}
        return found

    def _before(self, name: str, statics: Values) -> Tensor:
        before = self.laws.before(name)
        return statics[before.name] if isinstance(before, Variable) else before

    def _site(self, variable: Variable, site: str, now: Values, past: Values, t: int = 0) -> Tensor:
        law = self._law(variable, now, past)
        if isinstance(law, Tensor):
            return law
        if variable.role == "observation" and variable.name in self.records:
            return self._observed(site, law, self.records[variable.name][t])
        infer = {"enumerate": "parallel"} if variable.name in self.finite else {}
        value: Any = pyro.sample(site, law, infer=infer)  # type: ignore[arg-type]
        return value

    def _law(self, variable: Variable, now: Values, past: Values) -> Any:
        parents = {p.argument: (past if p.lag else now)[p.name] for p in variable.parents}
        events = {p.argument: len(self.shapes[p.name]) for p in variable.parents}
        dims = max((v.dim() - events[name] for name, v in parents.items()), default=0)
        wide = {}
        for name, value in parents.items():
            missing = dims - (value.dim() - events[name])
            wide[name] = value.reshape((1,) * missing + tuple(value.shape))
        leads = [tuple(value.shape[:dims]) for value in wide.values()]
        return self.laws.many(variable.name, wide, tuple(torch.broadcast_shapes((), *leads)))

    def _observed(self, site: str, law: Distribution, value: Tensor) -> Tensor:
        base, added = base_of(law)
        value = value.to(self.laws.dtype) if value.is_floating_point() else value
        missing = torch.isnan(value)
        if isinstance(base, (Planted, Evidence)):
            pyro.factor(site, log_prob_of(law, value))
        elif not bool(missing.any()):
            pyro.sample(site, law, obs=value)  # type: ignore[arg-type]
        else:
            stand_in = torch.where(missing, 0.0 if base.support.is_discrete else 0.5, value)
            told = ~missing.flatten(-len(law.event_shape)).any(-1) if len(base.event_shape) else ~missing
            masked = law.mask(told) if len(base.event_shape) else base.mask(told).to_event(added)  # type: ignore[attr-defined]
            pyro.sample(site, masked, obs=stand_in)
        return value
