"""Tables of elements with finitely many outcomes."""

from __future__ import annotations

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from inference.tables.table import FEW_OUTCOMES, Rows, Table, alike, generator, of_rows, summed


class FiniteTable(Table):
    """Elements with finitely many outcomes: log ratios by outcome, gathered (thesis eqs 5.22 and 5.23)."""

    stacked = ("index", "table", "baseline")

    # Scores as lines (first, step) of the outcome, of hypotheses and of the baseline, where there are two outcomes.
    affine: tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None

    def __init__(self, index: Tensor | None, table: Tensor, baseline: Tensor | None):
        self.index, self.table, self.baseline = index, table, baseline
        if index is None:
            self.stacked = ("table",)

    @classmethod
    def of(cls, index: Tensor | None, here: list[Tensor], baseline: list[Tensor] | None) -> FiniteTable | None:
        """Make the table; None where the baseline excludes an outcome, for which no ratio exists."""
        table = here[0].log()
        if baseline is None:
            return cls(None, table, None)
        assert index is not None
        floor = baseline[0].log()
        if not torch.isfinite(floor).all():
            return None
        at = floor.gather(1, index.flatten(1)[..., None].expand(-1, -1, floor.shape[-1])).reshape(table.shape)
        return cls(index, table - at, floor)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H)."""
        if self.index is None:
            if isinstance(rows, Tensor):
                return self._looked_up(rows, y)
            table = self.table[rows]
            return _outcome(table, y[:, None].expand(table.shape[:-1])).sum(-1)
        return summed(_chosen(self.flat_table, rows, self.shown(rows, y)), self.hypotheses)

    def _looked_up(self, rows: Tensor, y: Tensor) -> Tensor:
        """The same of a batch: only the outcomes that were seen are read, not the table of every one of it."""
        elements, outcomes = self.table.shape[2:]
        cells = (rows[:, None] * elements + torch.arange(elements)) * outcomes
        if not y.is_floating_point():
            return torch.nn.functional.embedding_bag(cells + y, self.by_outcome, mode="sum")
        missing = torch.isnan(y)
        nothing = len(self.by_outcome) - 1
        cells = torch.where(missing, nothing, cells + torch.where(missing, 0.0, y).long())
        return torch.nn.functional.embedding_bag(cells, self.by_outcome, mode="sum", padding_idx=nothing)

    def settle(self) -> None:
        """Lay out a dense table by outcome, and one of two outcomes as what is affine in the outcome."""
        super().settle()
        if self.index is None:
            by_outcome = self.table.permute(0, 2, 3, 1).flatten(0, 2)
            # And a last row, for what is missing.
            self.by_outcome = torch.cat([by_outcome, torch.zeros_like(by_outcome[:1])])
        self.affine = None
        if self.baseline is not None and self.table.shape[-1] == 2 and bool(torch.isfinite(self.table).all()):
            self.affine = _line(self.flat_table), _line(self.baseline)

    def score(self, rows: Rows, y: Tensor) -> tuple[Tensor, Tensor | float]:
        """Return ``ratio`` and ``base``."""
        if self.affine is None or self.baseline is None:
            return super().score(rows, y)
        y = y.to(self.table.dtype)
        ratio, base = (
            # What is missing scores nothing.
            (of_rows(first, rows) + of_rows(step, rows) * seen).nan_to_num(0.0)
            for (first, step), seen in zip(self.affine, (self.shown(rows, y), y), strict=True)
        )
        return summed(ratio, self.hypotheses), base.sum(1)

    def read(self, y: Tensor, name: str) -> Tensor:
        """Return outcomes (B, elements) as int64, or as they are if some are missing."""
        last = self.table.shape[-1] - 1
        if torch.equal(y.trunc().clamp_(0, last), y):
            return y if self.affine is not None else y.long()
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
        return _chosen(self.baseline, rows, y).sum(-1)

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements), with common random numbers."""
        elements = self.table.shape[2] if self.baseline is None else self.baseline.shape[1]
        uniform = torch.rand(chosen.shape[1], elements, generator=generator(seed), dtype=self.table.dtype)
        if self.baseline is None:
            return _inverse(self.table[rows[:, None], chosen], uniform)
        assert self.index is not None
        cumulative = self.baseline[rows].exp().cumsum(-1)
        # (R, elements, S): a search among an element's outcomes, instead of a comparison with each.
        levels = uniform.T.expand(len(rows), -1, -1) * cumulative[..., -1:]
        drawn = torch.searchsorted(cumulative, levels.contiguous()).clamp_(max=cumulative.shape[-1] - 1)
        drawn = drawn.transpose(1, 2).contiguous()
        index = self.index[rows[:, None], chosen]
        floor = self.baseline[rows].gather(1, index.flatten(1)[..., None].expand(-1, -1, self.baseline.shape[-1]))
        here = self.table[rows[:, None], chosen] + floor.reshape(*index.shape, -1)
        at = uniform.expand(len(rows), -1, -1).gather(2, index)
        return drawn.scatter(2, index, _inverse(here, at))

    def divergence(self, rows: Tensor) -> Tensor | None:
        """Return KL(p(y | h) | p(y | baseline)), nats, (R, H); finite, as a baseline excludes no outcome."""
        if self.baseline is None or self.index is None:
            return None
        ratio, index = self.table[rows], self.index[rows]
        floor = self.baseline[rows].gather(1, index.flatten(1)[..., None].expand(-1, -1, ratio.shape[-1]))
        return torch.xlogy((ratio + floor.reshape(ratio.shape)).exp(), ratio.exp()).sum((-2, -1))


def _line(table: Tensor) -> tuple[Tensor, Tensor]:
    """Scores (K, E) of outcome 0, and how much more those of outcome 1 are."""
    once = table[:1] if alike(table) else table
    first = once[..., 0].contiguous()
    step = once[..., 1] - first
    return first.expand(table.shape[:-1]), step.expand(table.shape[:-1])


def _chosen(table: Tensor, rows: Rows, y: Tensor) -> Tensor:
    """Scores (B, E) of outcomes y (B, E) in a table (K, E, C); only those that were seen are read."""
    if isinstance(rows, slice):
        return _outcome(of_rows(table, rows).expand(*y.shape, -1), y)
    elements, outcomes = table.shape[1:]
    first = torch.arange(elements) * outcomes
    cells, values = (first, table[0]) if alike(table) else (rows[:, None] * (elements * outcomes) + first, table)
    if not y.is_floating_point():
        return values.take(cells + y)
    missing = torch.isnan(y)
    return torch.where(missing, 0.0, values.take(cells + torch.where(missing, 0.0, y).long()))


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
