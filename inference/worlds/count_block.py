"""Variables that are known by counting: Beta above Bernoulli, Dirichlet above Categorical, Gamma above Poisson.

A law that selects a component is evaluated at numbers that tell the components apart: which of them comes out is the
one selected. What is counted is then kept beside the prior's own pseudo-counts (thesis eqs 4.27 to 4.47).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Dirichlet, Gamma

from apmodels.distributions import base_of, family
from apmodels.laws import Laws
from apmodels.variables import Parent
from inference.worlds.frame import Frame, Key, Memory

# No two components are so alike that one could be taken for another.
SAME = 1e-9


class CountBlock:
    """Pseudo-counts (b, n, components, outcomes) of a group of variables that share outcomes.

    Of a Beta the outcomes are 0 and 1, of a Dirichlet the categories; of a Gamma there are two numbers, its shape and
    its rate.
    """

    def __init__(self, model, names: tuple[str, ...], children: list[str], shapes: dict[str, tuple[int, ...]]):
        self.laws = Laws(model, torch.float64)
        self.names, self.shapes = names, shapes
        self.kind = model.structure.nodes[names[0]].family
        self.selected = {child: self._memory(child) for child in children}

    def start(self, frame: Frame) -> Tensor:
        """Return the priors' pseudo-counts."""
        rows = [_pseudo_counts(frame.evaluate(self.laws, name), self.kind) for name in self.names]
        lead = torch.broadcast_shapes(*(row.shape[:2] for row in rows))
        return torch.cat([row.expand(*lead, *row.shape[2:]) for row in rows], 2)

    def count(self, counts: Tensor, frame: Frame, child: str, value: Tensor) -> tuple[Tensor, Tensor]:
        """Count an outcome (b, n, *shape); return the counts and its log probability, nats, (b, n)."""
        index, alone = self.selected[child](frame)
        y = value.reshape(*value.shape[:2], -1).double()
        lead = torch.broadcast_shapes(index.shape[:2], y.shape[:2])
        y, index = y.expand(*lead, -1), index.expand(*lead, -1)
        seen = ~torch.isnan(y)
        score = torch.where(seen & (index < 0), self._alone(alone, y), 0.0).sum(-1)
        told = seen & (index >= 0)
        outcomes = self._outcomes(torch.where(told, y, 0.0), counts.shape[-1]) * told[..., None]
        added = torch.zeros(*lead, *counts.shape[2:], dtype=torch.float64)
        at = index.clamp(min=0)[..., None].expand(outcomes.shape)
        after = counts + added.scatter_add(2, at, outcomes)
        score = score + (_log_normaliser(after, self.kind) - _log_normaliser(counts, self.kind)).sum(-1)
        if self.kind == "Gamma":
            score = score - torch.where(told, torch.lgamma(y + 1), 0.0).sum(-1)
        return after, score

    def draw(self, counts: Tensor, frame: Frame, child: str, lead: tuple[int, int], laws: Laws) -> Tensor:
        """Draw an outcome from its predictive law: what it selects from is drawn first."""
        drawn = self.sample(counts, lead)
        values = {(name, 0): value.to(laws.dtype) for name, value in drawn.items()}
        return Frame(frame.values | values).draw(laws, child, lead)[1]

    def sample(self, counts: Tensor, lead: tuple[int, int]) -> dict[str, Tensor]:
        """Draw the variables themselves, (*lead, *shape) by name."""
        counts = counts.expand(*lead, *counts.shape[2:])
        if self.kind == "Gamma":
            drawn = Gamma(counts[..., 0], counts[..., 1], validate_args=False).sample()
        else:
            drawn = Dirichlet(counts, validate_args=False).sample()
            drawn = drawn[..., 1] if self.kind == "Beta" else drawn
        return {name: part.reshape(*lead, *self.shapes[name]) for name, part in self._split(drawn).items()}

    def parameters(self, counts: Tensor, name: str) -> Tensor:
        """Return the pseudo-counts of one variable, (b, n, its components, outcomes)."""
        return self._split(counts)[name]

    def components(self, name: str) -> int:
        """How many components a variable has."""
        shape = self.shapes[name][:-1] if self.kind == "Dirichlet" else self.shapes[name]
        return torch.Size(shape).numel()

    def _split(self, values: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.names, values.split([self.components(n) for n in self.names], 2), strict=True))

    # Which component a law selects.

    def _memory(self, child: str) -> Memory:
        keys: list[Key] = [(p.name, p.lag) for p in self.laws.variables[child].parents if p.name not in self.names]
        return Memory(keys, lambda frame: self._select(child, frame))

    def _select(self, child: str, frame: Frame) -> tuple[Tensor, Tensor]:
        """Which component each element selects, -1 for none, (b, n, elements); and what it is if none, (..., row)."""
        parents = [p for p in self.laws.variables[child].parents if p.name in self.names]
        points, options = self._telling(parents)
        law = frame.evaluate(self.laws, child, points)
        chosen = _probability(law)
        row = chosen.shape[-1]
        if not parents:
            options = torch.zeros(0, 2, row, dtype=torch.float64)
        close = (chosen[:, :, :, :, None] - options.transpose(0, 1)[None, None, :, None]).abs() <= SAME
        match = close.all(-1).all(2)
        index = torch.where(match.any(-1), match.to(torch.uint8).argmax(-1) if match.shape[-1] else -1, -1)
        if parents:
            places = torch.cat([self._at(p.name) for p in parents])
            index = torch.where(index >= 0, places[index.clamp(min=0)], -1)
        return index, chosen[:, :, 0]

    def _at(self, name: str) -> Tensor:
        before = 0
        for other in self.names:
            if other == name:
                break
            before += self.components(other)
        return torch.arange(before, before + self.components(name))

    def _telling(self, parents: list[Parent]) -> tuple[dict[str, Tensor], Tensor]:
        """Two worlds in which all components differ, by argument; and the components (n, 2, row)."""
        generator = torch.Generator().manual_seed(0)
        points, options = {}, []
        for parent in parents:
            flat = torch.rand((2, *self.shapes[parent.name]), generator=generator, dtype=torch.float64)
            if self.kind == "Dirichlet":
                flat = flat / flat.sum(-1, keepdim=True)
            points[parent.argument] = flat
            rows = flat.reshape(2, self.components(parent.name), -1)
            options.append(rows.transpose(0, 1))
        return points, torch.cat(options) if options else torch.zeros(0)

    def _outcomes(self, y: Tensor, outcomes: int) -> Tensor:
        if self.kind == "Gamma":
            return torch.stack([y, torch.ones_like(y)], -1)
        return torch.nn.functional.one_hot(y.long(), outcomes).double()

    def _alone(self, chosen: Tensor, y: Tensor) -> Tensor:
        """log p of elements that select nothing."""
        if self.kind == "Gamma":
            return torch.xlogy(y, chosen[..., 0]) - chosen[..., 0] - torch.lgamma(torch.nan_to_num(y) + 1)
        if self.kind == "Beta":
            p = chosen[..., 0]
            return torch.where(y == 1, p, 1 - p).log()
        whole = torch.nan_to_num(y).long()[..., None]
        return chosen.expand(*whole.shape[:-1], -1).gather(-1, whole)[..., 0].log()


def _probability(law) -> Tensor:
    """A law's probabilities or rates, (b, n, points, elements, row)."""
    base, _ = base_of(law)
    values = base.rate if family(law) == "Poisson" else base.probs
    row = values.shape[-1] if family(law) == "Categorical" else 1
    return values.reshape(*values.shape[:3], -1, row).double()


def _pseudo_counts(law: Any, kind: str) -> Tensor:
    """A prior's parameters, (b, n, components, outcomes)."""
    base, _ = base_of(law)
    lead = law.batch_shape[:2]
    if kind == "Beta":
        pair = torch.stack([base.concentration0, base.concentration1], -1)
    elif kind == "Gamma":
        pair = torch.stack([base.concentration, base.rate], -1)
    else:
        pair = base.concentration
    return pair.reshape(*lead, -1, pair.shape[-1]).double()


def _log_normaliser(counts: Tensor, kind: str) -> Tensor:
    if kind == "Gamma":
        shape, rate = counts.unbind(-1)
        return torch.lgamma(shape) - shape * rate.log()
    return torch.lgamma(counts).sum(-1) - torch.lgamma(counts.sum(-1))
