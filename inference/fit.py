"""Learning a model's free parameters from records: by counting where that is conjugate, else by gradient.

A field is counted where, in every world of the records, it is what an observed or known outcome's law selects from: the
most probable value is then the share of each outcome. Every other field follows the gradient of the log evidence, in a
space without bounds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.distributions import biject_to, constraints

from apmodels import DeclarationError, Model, ValueOutOfRange
from apmodels.errors import nearest
from apmodels.progress import progress
from apmodels.simulation import Values, as_given
from inference.choose import bids
from inference.counting_fit import counted
from inference.engine import Refusal

DOMAINS = {
    "real": constraints.real,
    "positive": constraints.positive,
    "unit": constraints.unit_interval,
    "simplex": constraints.simplex,
}
# Engines through which a gradient can pass, in the order of preference.
SMOOTH = ("Exact", "Kalman")
# Steps of an optimiser that takes the curvature into account, and when it has arrived.
ROUNDS, ARRIVED = 60, 1e-9
# The cost of parameters that the model does not allow.
IMPOSSIBLE = 1e30


@dataclasses.dataclass(frozen=True)
class Fit:
    """The model with its parameters learned, their values, how each was learned, and the log evidence on the way."""

    model: Model
    values: dict[str, Any]
    how: dict[str, str]
    log_evidence: list[float]

    def __repr__(self) -> str:
        found = ", ".join(f"{name} by {self.how[name]}" for name in self.values)
        return f"Fit({self.model!r}; {found}; log evidence {self.log_evidence[0]:.4g} -> {self.log_evidence[-1]:.4g})"


def fit(
    model: Model,
    data: Mapping[str, Any],
    free: str | Iterable[str] | Mapping[str, str],
    rounds: int = ROUNDS,
    engine: str | None = None,
    prior: float = 0.0,
) -> Fit:
    """Learn free parameters from records.

    Args:
        model: where to begin.
        data: records as ``Model.simulate`` returns them: actions and observations (steps, *shape), or (batch, steps,
            *shape); hidden variables too, where they are known. NaN observations are missing.
        free: the fields to learn; or name -> domain, one of real, positive, unit, simplex, where it cannot be found by
            trying.
        rounds: how many steps of the optimiser at the most.
        engine: through which to differentiate; the best of Exact and Kalman by default.
        prior: pseudo-counts of every outcome that is counted.

    Returns:
        A Fit; its ``model`` is the one to use.

    Raises:
        ValueOutOfRange: no such field, or one that is no number.
        Refusal: hidden variables, and no engine through which a gradient can pass.
    """
    names = [free] if isinstance(free, str) else list(free)
    _check_fields(model, names)
    domains = dict(free) if isinstance(free, Mapping) else {}
    known = {name: torch.as_tensor(value) for name, value in data.items()}
    values, how = {}, {}
    for name in names:
        found = counted(model, name, known, prior) if name not in domains else None
        if found is not None:
            values[name], how[name] = found, "counting"
    counted_model = model.replace(**values) if values else model
    rest = [name for name in names if name not in values]
    if not rest:
        return Fit(counted_model, values, how, [_complete(model, known), _complete(counted_model, known)])
    climbed, curve = _climb(counted_model, known, rest, domains, rounds, engine)
    values |= climbed
    how |= dict.fromkeys(rest, "gradient")
    return Fit(counted_model.replace(**climbed), {name: values[name] for name in names}, how, curve)


def _check_fields(model: Model, names: list[str]) -> None:
    fields = [field.name for field in dataclasses.fields(model)]  # type: ignore[arg-type]
    for name in names:
        if name not in fields:
            raise ValueOutOfRange(f"{type(model).__name__} has no parameter {name}{nearest(name, fields)}")
        value = getattr(model, name)
        if not isinstance(value, (int, float, Tensor)) or isinstance(value, bool):
            raise ValueOutOfRange(
                f"{type(model).__name__}.{name} is a {type(value).__name__}, and no number to be learned"
            )


def _complete(model: Model, known: Values) -> float:
    """The log density of records in which nothing random is hidden."""
    return float(model.log_prob(known).sum())


# Climbing.


def _climb(
    model: Model, known: Values, names: list[str], domains: dict[str, str], rounds: int, engine: str | None
) -> tuple[dict[str, Any], list[float]]:
    score = _score(model, known, engine)
    starts = {name: torch.as_tensor(getattr(model, name)).double() for name in names}
    ways = {name: biject_to(_domain(model, name, starts[name], domains.get(name), score)) for name in names}
    free = {name: ways[name].inv(starts[name]).clone().requires_grad_() for name in names}
    curve = [float(score(starts))]
    best: list[Any] = [curve[0], {name: value.detach().clone() for name, value in free.items()}]

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        parts = torch.as_tensor(flat).split([value.numel() for value in free.values()])
        with torch.no_grad():
            for value, part in zip(free.values(), parts, strict=True):
                value.copy_(part.reshape(value.shape))
                value.grad = None
        try:
            loss = -score({name: ways[name](value) for name, value in free.items()})
            loss.backward()
        except (ValueOutOfRange, DeclarationError):
            return IMPOSSIBLE, np.zeros_like(flat)
        slope = torch.cat([value.grad.flatten() for value in free.values()]).numpy()  # type: ignore[union-attr]
        now = float(loss.detach())
        if not math.isfinite(now) or not np.isfinite(slope).all():
            return IMPOSSIBLE, np.zeros_like(flat)
        if -now > best[0]:
            best[:] = [-now, {name: value.detach().clone() for name, value in free.items()}]
        return now, slope

    with progress() as bar:
        task = bar.add_task("fitting", total=rounds)

        def after(_: np.ndarray) -> None:
            curve.append(best[0])
            bar.advance(task)

        first = torch.cat([value.detach().flatten() for value in free.values()]).numpy()
        minimize(cost, first, jac=True, method="L-BFGS-B", callback=after, options={"maxiter": rounds, "ftol": ARRIVED})
    curve.append(best[0])
    kept = best[1]
    values = {}
    for name in names:
        value = ways[name](kept[name]).to(torch.get_default_dtype())
        values[name] = value if isinstance(getattr(model, name), Tensor) else float(value)
    return values, curve


def _score(model: Model, known: Values, wanted: str | None) -> Any:
    """A function from parameters to log p(records)."""
    hidden = [node.name for node in model.structure.hidden if node.random]
    if all(name in known for name in hidden):
        return lambda values: _with(model, values).log_prob(known).sum()
    made = bids(model)
    serving = [name for name in ([wanted] if wanted else SMOOTH) if made.get(name)]
    if not serving:
        reasons = "; ".join(f"{name}: {made[name].reason}" for name in SMOOTH)
        raise Refusal(
            f"no engine passes a gradient through {type(model).__name__} ({reasons}); give what is hidden in data"
        )
    kind = serving[0]
    actions = {name: known[name] for name in model.action_names}
    seen = {name: known[name] for name in model.observation_names}
    shape = seen[model.observation_names[0]].dim() - len(model.structure.nodes[model.observation_names[0]].shape)
    batch = len(next(iter(seen.values()))) if shape == 2 else None

    def score(values: Values) -> Tensor:
        from inference.choose import ENGINES

        engine = next(e for e in ENGINES if e.__name__ == kind)(_with(model, values), dtype=torch.float64)
        belief = engine.start(batch)
        for t in range(next(iter(seen.values())).shape[shape - 1]):
            act, see = ({n: v.select(shape - 1, t) for n, v in some.items()} for some in (actions, seen))
            belief = engine.update(belief, as_given(act), as_given(see))
        return belief.log_evidence.sum()

    return score


def _with(model: Model, values: Values) -> Model:
    """The model with other parameters, and the structure that it has whatever they are."""
    other = model.replace(**values)
    object.__setattr__(other, "_structure", model.structure)
    return other


def _domain(model: Model, name: str, value: Tensor, wanted: str | None, score: Any) -> Any:
    """Where a parameter may be: as told, or found by trying values that only some domains allow."""
    if wanted is not None:
        if wanted not in DOMAINS:
            raise ValueOutOfRange(f"the domain of {name} is {wanted!r}; it must be one of {', '.join(DOMAINS)}")
        return DOMAINS[wanted]
    if value.dim() and bool((value >= 0).all()) and bool(((value.sum(-1) - 1).abs() < 1e-5).all()):
        return constraints.simplex
    if _allows(model, name, -value.abs() - 1, score):
        return constraints.real
    return constraints.positive if _allows(model, name, value.abs() + 2, score) else constraints.unit_interval


def _allows(model: Model, name: str, value: Tensor, score: Any) -> bool:
    try:
        with torch.no_grad():
            return bool(torch.isfinite(score({name: value})))
    except (ValueOutOfRange, DeclarationError, ValueError):
        return False
