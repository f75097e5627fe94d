"""Brute force over many worlds at once: on a grid, or drawn from the prior; each is weighed by the record."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from scipy.special import roots_jacobi
from torch import Tensor

from apmodels.distributions import base_of
from apmodels.laws import Laws
from apmodels.simulation import Values, Worlds, seeded
from apmodels.variables import Variable

# So many worlds are drawn, a chunk at a time, and so many nodes may a grid have.
WORLDS = 400_000
CHUNK = 100_000
GRID = 200_000


@dataclass(frozen=True)
class Reference:
    """Log evidence (nats); and of every checked variable its mean and standard deviation, or its probabilities.

    ``moments`` name -> (mean, standard deviation), each (*shape); ``probs`` name -> probabilities over the variable's
    values; ``errors`` name -> standard error of the mean or the probabilities, 0 where the method is exact.
    """

    method: str
    log_evidence: float
    evidence_error: float
    probs: dict[str, Tensor]
    moments: dict[str, tuple[Tensor, Tensor]]
    errors: dict[str, Tensor]


def same(values: Tensor, listed: Tensor) -> Tensor:
    """Which of the listed values each value is, (n, listed)."""
    flat = listed.double().reshape(len(listed), -1)
    return (values.double().reshape(len(values), 1, -1) == flat).all(-1)


def drawn(model: Any, actions: Values, seen: Values, names: list[str], count: int, seed: int) -> Reference:
    """Draw worlds from the prior, weigh them by the record."""
    logs, values, laws = [], {name: [] for name in names}, Laws(model)
    with seeded(seed):
        for start in range(0, count, CHUNK):
            part, found = weighed(laws, actions, seen, min(CHUNK, count - start))
            logs.append(part)
            for name in names:
                values[name].append(found[name])
    weights = torch.cat(logs).double()
    top = weights.max()
    relative = (weights - top).exp()
    mean = relative.mean()
    evidence = float(mean.log() + top)
    error = float(relative.std() / mean / math.sqrt(count))
    weights = relative / relative.sum()
    found = {name: torch.cat(parts) for name, parts in values.items()}
    probs, moments = _summed(model, weights, found, names)
    errors = {}
    for name in names:
        node, value = model.structure.nodes[name], found[name].double()
        value = same(value, node.values).double() if node.values is not None else value
        centre = probs[name] if name in probs else moments[name][0]
        wide = weights.reshape(-1, *[1] * (value.dim() - 1))
        errors[name] = (wide**2 * (value - centre) ** 2).sum(0).sqrt()
    return Reference(f"{count:,} worlds drawn from the prior", evidence, error, probs, moments, errors)


def gridded(model: Any, actions: Values, seen: Values, names: list[str]) -> Reference | None:
    """Integrate static rates by Gauss-Jacobi quadrature, exact for what counts make of them; None if too many."""
    finite = [node for node in model.structure.hidden if node.random and node.values is not None]
    rates = [node for node in model.structure.hidden if node.random and node.values is None]
    cells = math.prod(len(n.values) for n in finite if n.values is not None)
    dims = sum(torch.Size(node.shape).numel() for node in rates)
    # A record of so many steps makes a polynomial of at most twice the degree that so many nodes integrate exactly.
    least = len(next(iter(seen.values()))) // 2 + 2
    nodes = min(24, int((GRID / cells) ** (1 / dims)))
    if nodes < least:
        return None
    laws = Laws(model, torch.float64)
    axes, weights = [], []
    for node in rates:
        base: Any = base_of(laws.one(node.name, {}))[0]
        pairs = zip(base.concentration1.flatten().tolist(), base.concentration0.flatten().tolist(), strict=True)
        for a, b in pairs:
            points, weight = roots_jacobi(nodes, b - 1, a - 1)
            axes.append(torch.as_tensor((points + 1) / 2))
            weights.append(torch.as_tensor(weight / weight.sum()).log())
    picks = torch.cartesian_prod(
        *[torch.arange(len(n.values)) for n in finite if n.values is not None], *map(_range, axes)
    )
    picks = picks.reshape(len(picks), -1)
    given: Values = {n.name: n.values[picks[:, i]] for i, n in enumerate(finite) if n.values is not None}
    logs, at = torch.zeros(len(picks), dtype=torch.float64), len(finite)
    for node in rates:
        size = torch.Size(node.shape).numel()
        columns = [axes[at - len(finite) + i][picks[:, at + i]] for i in range(size)]
        logs = logs + sum(weights[at - len(finite) + i][picks[:, at + i]] for i in range(size))
        given[node.name] = torch.stack(columns, 1).reshape(-1, *node.shape)
        at += size
    for node in finite:
        parents = {p.argument: given[p.name] for p in laws.variables[node.name].parents}
        logs = logs + laws.score(node.name, parents, given[node.name], (len(picks),))
    part, found = weighed(laws, actions, seen, len(picks), given)
    weights_now = (logs + part).double()
    evidence = float(weights_now.logsumexp(0))
    probs, moments = _summed(model, (weights_now - evidence).exp(), found, names)
    errors = {name: torch.zeros_like(value) for name, value in probs.items()}
    errors |= {name: torch.zeros_like(mean) for name, (mean, _) in moments.items()}
    return Reference(f"numerical integration, {len(picks):,} nodes", evidence, 0.0, probs, moments, errors)


def _range(axis: Tensor) -> Tensor:
    return torch.arange(len(axis))


def _summed(model: Any, weights: Tensor, found: Values, names: list[str]) -> tuple[dict, dict]:
    """Probabilities, and (mean, standard deviation), of variables in weighted worlds."""
    probs, moments = {}, {}
    for name in names:
        node, value = model.structure.nodes[name], found[name].double()
        value = same(value, node.values).double() if node.values is not None else value
        wide = weights.reshape(-1, *[1] * (value.dim() - 1))
        centre = (wide * value).sum(0)
        if node.values is not None:
            probs[name] = centre
        else:
            moments[name] = centre, (wide * (value - centre) ** 2).sum(0).sqrt()
    return probs, moments


def weighed(
    laws: Laws, actions: Values, seen: Values, count: int, given: Values | None = None
) -> tuple[Tensor, Values]:
    """Return how probable a record is in many worlds, log p (count,), and the worlds' last values by name."""
    worlds = _SeenWorlds(laws, count, given)
    for t in range(len(next(iter(seen.values())))):
        worlds.now = {name: value[t] for name, value in seen.items()}
        acts = {n: v.to(laws.dtype) if v.is_floating_point() else v for n, v in actions.items()}
        worlds.step({name: value[t].expand(count, *value.shape[1:]) for name, value in acts.items()})
    return worlds.total, {**worlds.statics, **worlds.values}


class _SeenWorlds(Worlds):
    """Worlds that draw what is hidden, and score what was seen."""

    def __init__(self, laws: Laws, batch: int, given: Values | None):
        self.total, self.now = torch.zeros(batch, dtype=laws.dtype), {}
        super().__init__(laws, batch, given)

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        if variable.role != "observation":
            return super()._draw(variable, values)
        y = self.now[variable.name].to(self.laws.dtype)
        wide = y.expand(self.batch, *y.shape)
        law = self.laws.many(variable.name, self.parents(variable, values), (self.batch,))
        if isinstance(law, Tensor):
            same = (
                (torch.isnan(wide) | (law == wide)).flatten(1).all(1)
                if law.dim() > 1
                else torch.isnan(wide) | (law == wide)
            )
            self.total = self.total + same.to(self.laws.dtype).log()
        else:
            self.total = self.total + self.laws.score(
                variable.name, self.parents(variable, values), wide, (self.batch,)
            )
        whole = self.laws.model.structure.nodes[variable.name].family == "Categorical"
        return wide.long() if whole and not bool(torch.isnan(y).any()) else wide
