"""Tabulated laws of an observation: log p(y | hypothesis, context) by the family's own kernel.

A context is all that is known and bears on the observation (the action, known states); a hypothesis is one
combination of the hidden values that bear on it. A table keeps K contexts × H hypotheses. Elements of the
observation that a hypothesis leaves like the common baseline are not kept, and never scored.

Every table answers ``ratio``, log p(y | h) - log p(y | baseline), and ``base``, log p(y | baseline); where there is
no common baseline the latter is zero.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from apmodels import Planted, ValueOutOfRange
from apmodels.distributions import base_of, compact, picked, tensors, with_tensors
from apmodels.simulation import seeded

# A hypothesis may differ from the baseline in at most this share of the elements for a sparse table to pay.
SPARSE = 0.25
# Up to so many outcomes an expectation over the observation is a sum.
FEW_OUTCOMES = 1024


# Which contexts a batch is in: (B,), or a slice of one.
Rows = Tensor | slice


class Misfit(Exception):
    """A later context needs another kind of table than the first ones did."""


class Table:
    """K contexts × H hypotheses of one observation. Subclasses are families."""

    # Tensors whose first dimension is the context.
    stacked: tuple[str, ...] = ()
    event_shape: torch.Size
    hypotheses: int
    # Sparse tables as ``ratio`` reads them; see ``settle``.
    flat_index: Tensor
    flat_table: Tensor
    flat_slope: Tensor
    flat_middle: Tensor

    def append(self, other: Table) -> None:
        """Add the contexts of another table of the same observation; Misfit if they are not of one kind."""
        if type(self) is not type(other) or self.stacked != other.stacked:
            raise Misfit
        for name in self.stacked:
            old, new = getattr(self, name), getattr(other, name)
            if old.shape[1:] != new.shape[1:]:
                raise Misfit
            setattr(self, name, torch.cat([old, new]))

    def read(self, y: Tensor, name: str) -> Tensor:
        """Return y (B, elements) as the other methods want it; ValueOutOfRange where it cannot have been seen.

        Elements that are NaN are missing.
        """
        # One sum finds both the infinite and the missing.
        if not math.isfinite(float(y.sum())) and bool(torch.isinf(y).any()):
            raise ValueOutOfRange(f"{name} is infinite in some element; observe a number, or NaN where it is missing")
        return y

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H), for y (B, elements) in contexts rows (B,)."""
        raise NotImplementedError

    def base(self, rows: Rows, y: Tensor) -> Tensor | float:
        """Return log p(y | baseline), (B,)."""
        return 0.0

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements) under hypotheses chosen (R, S) in contexts rows (R,), with common random numbers."""
        raise NotImplementedError

    @property
    def outcomes(self) -> Tensor | None:
        """All values of the whole observation (outcomes, elements), where they are few."""
        return None

    def settle(self) -> None:
        """Lay out sparse tables with hypotheses and their elements in one dimension, as ``ratio`` reads them."""
        if getattr(self, "index", None) is not None:
            for name in ("index", "slope", "middle", "table"):
                if hasattr(self, name):
                    setattr(self, f"flat_{name}", getattr(self, name).flatten(1, 2))


def tabulate(law: Any, contexts: int, hypotheses: int, generic: bool = False) -> Table:
    """Make the table of a law whose batch shape is (contexts, hypotheses); ``generic`` serves every family alike."""
    base, added = base_of(law)
    if generic:
        parts = None
    elif isinstance(base, Planted):
        parts = _planted(base)
    elif len(base.event_shape) == 0:
        parts = _elementwise(base, added, contexts, hypotheses)
    else:
        parts = None
    name = type(base.here if isinstance(base, Planted) else base).__name__
    table: Table | None = None
    if parts is not None and name == "Normal":
        table = GaussianTable.of(*parts)
    elif parts is not None and name in ("Categorical", "Bernoulli"):
        table = FiniteTable.of(*parts, categorical=name == "Categorical")
    table = table or GenericTable(law)
    table.event_shape, table.hypotheses = law.event_shape, hypotheses
    return table


Parts = tuple[Tensor | None, list[Tensor], list[Tensor] | None]


def _family_parameters(base: Any) -> list[Tensor]:
    """Parameters of one element, each with all batch dimensions and one more for the parameter's own."""
    if type(base).__name__ == "Normal":
        return [base.loc[..., None], base.scale[..., None]]
    if type(base).__name__ == "Bernoulli":
        return [torch.stack([1 - base.probs, base.probs], -1)]
    return [base.probs] if type(base).__name__ == "Categorical" else []


def _planted(law: Planted) -> Parts:
    """Index (K, H, 1), parameters there (K, H, 1, P), and elsewhere (K, E, P)."""
    here = [p.unsqueeze(2) for p in _family_parameters(law.here)]
    # What is planted does not change what is elsewhere; if it does, the law is as good as dense.
    elsewhere = [compact(p) for p in _family_parameters(law.elsewhere)]
    if any(p.shape[1] != 1 for p in elsewhere):
        index = law.index[..., None, None]
        dense = [
            e.expand(*law.index.shape, *e.shape[2:]).scatter(2, index.expand(*h.shape), h)
            for e, h in zip(_family_parameters(law.elsewhere), here, strict=True)
        ]
        return None, dense, None
    shape = (len(law.index), *elsewhere[0].shape[2:3])
    return law.index[..., None], here, [p[:, 0].expand(*shape, p.shape[-1]) for p in elsewhere]


def _elementwise(base: Any, added: int, contexts: int, hypotheses: int) -> Parts:
    """Index, parameters there and baseline of a dense law if most elements are alike, else (None, dense, None)."""
    dense = [p.reshape(contexts, hypotheses, -1, p.shape[-1]) for p in _family_parameters(base)]
    if not dense or hypotheses < 3 or dense[0].shape[2] < 2:
        return None, dense, None
    baseline = _baseline(dense)
    differs = torch.stack([(p != b[:, None]).any(-1) for p, b in zip(dense, baseline, strict=True)]).any(0)
    most = int(differs.sum(-1).max())
    if most > SPARSE * differs.shape[-1]:
        return None, dense, None
    index = _positions(differs, max(most, 1))
    here = [p.gather(2, index[..., None].expand(*index.shape, p.shape[-1])) for p in dense]
    return index, here, baseline


def _baseline(dense: list[Tensor]) -> list[Tensor]:
    """The parameters (K, E, P) that at least two of three hypotheses share, else any: then nothing is alike."""
    first, middle, last = 0, dense[0].shape[1] // 2, dense[0].shape[1] - 1
    agree = torch.stack([(p[:, first] == p[:, middle]).all(-1) for p in dense]).all(0)
    return [torch.where(agree[..., None], p[:, first], p[:, last]) for p in dense]


def _positions(differs: Tensor, most: int) -> Tensor:
    """The positions of the true elements, (K, H, most); where there are fewer, elements that do not differ."""
    # A stable descending sort of a mask puts the true elements first.
    return differs.to(torch.uint8).topk(most, dim=-1).indices


class GaussianTable(Table):
    """Normal elements whose spread no hypothesis changes: log ratios (y - middle) · slope (thesis eq. 5.18)."""

    stacked = ("index", "slope", "middle", "location", "scale")

    def __init__(self, index: Tensor | None, slope: Tensor, middle: Tensor, location: Tensor, scale: Tensor):
        self.index, self.slope, self.middle, self.location, self.scale = index, slope, middle, location, scale
        if index is None:
            self.stacked = tuple(name for name in self.stacked if name != "index")

    @classmethod
    def of(cls, index: Tensor | None, here: list[Tensor], baseline: list[Tensor] | None) -> GaussianTable | None:
        """Make the table, or return None where hypotheses change the spread."""
        location, scale = (p.squeeze(-1) for p in here)
        if baseline is None:
            base_location, base_scale = location.mean(1), scale[:, 0]
            at_location, at_scale = base_location[:, None], base_scale[:, None]
        else:
            base_location, base_scale = (p.squeeze(-1) for p in baseline)
            assert index is not None
            at_location, at_scale = (_at(p, index) for p in (base_location, base_scale))
        if not torch.equal(scale, at_scale.expand_as(scale)):
            return None
        slope = (location - at_location) / (scale * scale)
        return cls(index, slope, (location + at_location) / 2, base_location, base_scale)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H)."""
        if self.index is None:
            # Centred on the baseline, so that nothing large cancels.
            residual = y - self.location[rows]
            slope, offset = self.slope[rows], self.middle[rows] - self.location[rows][:, None]
            missing = torch.isnan(residual)
            here = (~missing).to(y.dtype)
            linear = torch.einsum("be,bhe->bh", torch.where(missing, 0.0, residual), slope)
            return linear - torch.einsum("be,bhe->bh", here, slope * offset)
        at = y.gather(1, self.flat_index[rows])
        scores = (at - self.flat_middle[rows]) * self.flat_slope[rows]
        return _summed(scores.nan_to_num(0.0), self.hypotheses)

    def base(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | baseline), (B,)."""
        scale = self.scale[rows]
        standardised = (y - self.location[rows]) / scale
        scores = -0.5 * standardised * standardised - scale.log() - 0.9189385332046727
        return scores.nan_to_num(0.0).sum(-1)

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements), with common random numbers."""
        elements = self.location.shape[-1]
        noise = torch.randn(chosen.shape[1], elements, generator=_generator(seed), dtype=self.location.dtype)
        location = self.location[rows][:, None].expand(-1, chosen.shape[1], -1)
        twice = 2 * self.middle[rows[:, None], chosen]
        if self.index is None:
            location = twice - location
        else:
            index = self.index[rows[:, None], chosen]
            location = location.scatter(2, index, twice - location.gather(2, index))
        return location + self.scale[rows][:, None] * noise


class FiniteTable(Table):
    """Elements with finitely many outcomes: log ratios by outcome, gathered (thesis eqs 5.22 and 5.23)."""

    stacked = ("index", "table", "baseline")

    def __init__(self, index: Tensor | None, table: Tensor, baseline: Tensor | None, categorical: bool):
        self.index, self.table, self.baseline, self.categorical = index, table, baseline, categorical
        if index is None:
            self.stacked = ("table",)

    @classmethod
    def of(
        cls, index: Tensor | None, here: list[Tensor], baseline: list[Tensor] | None, categorical: bool
    ) -> FiniteTable | None:
        """Make the table; None where the baseline excludes an outcome, for which no ratio exists."""
        table = here[0].log()
        if baseline is None:
            return cls(None, table, None, categorical)
        assert index is not None
        floor = baseline[0].log()
        if not torch.isfinite(floor).all():
            return None
        at = floor.gather(1, index.flatten(1)[..., None].expand(-1, -1, floor.shape[-1])).reshape(table.shape)
        return cls(index, table - at, floor, categorical)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H)."""
        if self.index is None:
            table = self.table[rows]
            return _outcome(table, y[:, None].expand(table.shape[:-1])).sum(-1)
        return _summed(_outcome(self.flat_table[rows], y.gather(1, self.flat_index[rows])), self.hypotheses)

    def read(self, y: Tensor, name: str) -> Tensor:
        """Return outcomes (B, elements) as int64, or as they are if some are missing."""
        last = self.table.shape[-1] - 1
        outcomes = y.to(torch.int64).clamp_(0, last)
        if torch.equal(outcomes.to(y.dtype), y):
            return outcomes
        wrong = ~(torch.isnan(y) | (y >= 0) & (y <= last) & (y == y.round()))
        if bool(wrong.any()):
            value = y[wrong][0].item()
            raise ValueOutOfRange(f"{name} is {value:g} in some element; it must be a whole number from 0 to {last}")
        return y

    @property
    def outcomes(self) -> Tensor | None:
        """All values of the whole observation (outcomes, elements), where they are few."""
        elements, count = (self.table if self.baseline is None else self.baseline[:, None]).shape[2:]
        if count**elements > FEW_OUTCOMES:
            return None
        values = torch.arange(count)
        return torch.cartesian_prod(*[values] * elements).reshape(-1, elements)

    def base(self, rows: Rows, y: Tensor) -> Tensor | float:
        """Return log p(y | baseline), (B,)."""
        if self.baseline is None:
            return 0.0
        return _outcome(self.baseline[rows], y).sum(-1)

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements), with common random numbers."""
        elements = self.table.shape[2] if self.baseline is None else self.baseline.shape[1]
        uniform = torch.rand(chosen.shape[1], elements, generator=_generator(seed), dtype=self.table.dtype)
        if self.baseline is None:
            return _inverse(self.table[rows[:, None], chosen], uniform)
        assert self.index is not None
        drawn = _inverse(self.baseline[rows][:, None], uniform)
        index = self.index[rows[:, None], chosen]
        floor = self.baseline[rows].gather(1, index.flatten(1)[..., None].expand(-1, -1, self.baseline.shape[-1]))
        here = self.table[rows[:, None], chosen] + floor.reshape(*index.shape, -1)
        at = uniform.expand(len(rows), -1, -1).gather(2, index)
        return drawn.scatter(2, index, _inverse(here, at))


class GenericTable(Table):
    """Any other family: its own ``log_prob``, on all elements."""

    def __init__(self, law: Any):
        self.law = law

    def append(self, other: Table) -> None:
        """Add the contexts of another table of the same observation."""
        assert isinstance(other, GenericTable)
        parts = [torch.cat(pair) for pair in zip(tensors(self.law), tensors(other.law), strict=True)]
        self.law = with_tensors(self.law, parts, parts[0].shape[:2], 2)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h), (B, H)."""
        base, _ = base_of(picked(self.law, rows, (len(y), self.hypotheses), 2))
        y = y.reshape(len(y), 1, *self.event_shape)
        missing = torch.isnan(y) if y.is_floating_point() else torch.zeros_like(y, dtype=torch.bool)
        if not len(base.event_shape):
            scores = torch.where(missing, 0.0, base.log_prob(torch.where(missing, 1.0, y).to(y.dtype)))
            return scores.reshape(*scores.shape[:2], -1).sum(-1)
        gone = missing.reshape(len(y), -1)
        if not bool((gone.all(-1) == gone.any(-1)).all()):
            raise ValueOutOfRange(f"elements of a {type(base).__name__} cannot be missing one by one")
        scores = base.log_prob(torch.where(missing, 0.0, y).to(y.dtype))
        return torch.where(gone.any(-1, keepdim=True), 0.0, scores.reshape(*scores.shape[:2], -1).sum(-1))

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements); every context draws from the same seed."""
        drawn = []
        for row, hypotheses in zip(rows.tolist(), chosen, strict=True):
            law = picked(self.law, (row, hypotheses), (len(hypotheses),), 2)
            with seeded(seed):
                drawn.append(law.sample().reshape(len(hypotheses), -1))
        return torch.stack(drawn)


def _summed(scores: Tensor, hypotheses: int) -> Tensor:
    """Scores (B, H * n) summed to (B, H)."""
    if scores.shape[1] == hypotheses:
        return scores
    return scores.reshape(len(scores), hypotheses, -1).sum(-1)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """values (K, E) at index (K, H, n)."""
    return values.gather(1, index.flatten(1)).reshape(index.shape)


def _outcome(table: Tensor, y: Tensor) -> Tensor:
    """table (..., C) at outcomes y (...); NaN is missing and scores zero."""
    if not y.is_floating_point():
        return table.gather(-1, y[..., None]).squeeze(-1)
    missing = torch.isnan(y)
    outcome = torch.where(missing, 0.0, y).to(torch.int64)
    return torch.where(missing, 0.0, table.gather(-1, outcome[..., None]).squeeze(-1))


def _inverse(log_probs: Tensor, uniform: Tensor) -> Tensor:
    """The outcomes (...) whose cumulative probability passes uniform numbers (...)."""
    cumulative = log_probs.exp().cumsum(-1)
    total = cumulative[..., -1:]
    outcome = (cumulative < uniform[..., None] * total).sum(-1)
    return outcome.clamp(max=log_probs.shape[-1] - 1)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
