"""Finite beliefs along a whole record: likelihoods of all steps at once, and one product of probabilities a step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from inference.beliefs import FiniteBelief
from inference.records.record import Beliefs, Later, Record, alike, alone, folded
from inference.tables.slices import contract
from inference.tables.table import Table

# So many numbers of one kind are held at a time; what needs more is led along in pieces.
MOST = 1 << 24
# Pieces of fewer steps than these are not worth the trouble.
FEWEST = 8
# Up to so many contexts in a step, rows are sorted by context, instead of fetching each row a matrix of its own.
SORTED = 64


def along(engine: Any, record: Record, batch: int | None) -> Beliefs | list[Any]:
    """Return the beliefs along a record; step by step, where they cannot be had otherwise."""
    belief = engine.start(batch)
    if record.steps < 2:
        return engine.stepwise(belief, record)
    with alone(belief.log_probs.numel()):
        whole = _Whole(engine, record, belief)
        size = MOST // whole.numbers
        items: list[Any] = []
        while len(items) < record.steps and size >= FEWEST:
            span = range(len(items), min(len(items) + size, record.steps))
            found = whole.piece(belief, span)
            items += engine.stepwise(belief, record, span.start, span.stop) if found is None else found
            belief = Beliefs(items[-1:])[0]
        return Beliefs([*items, *engine.stepwise(belief, record, len(items))])


@dataclass
class _Likelihood:
    """Of one observation: exp(ratio - shift) in each of some cells, (cells, *sizes), and which cell each step reads.

    ``cells`` is (steps, rows or 1), or None where a cell is a step's row; ``shift`` is (cells, *statics, 1 ...).
    """

    values: Tensor
    shift: Tensor
    base: Tensor | None
    cells: Tensor | None
    rows: int

    def at(self, t: int) -> Tensor:
        """Return a step's values, (rows or 1, *sizes)."""
        if self.cells is None:
            return self.values[t * self.rows : (t + 1) * self.rows]
        return self.values.index_select(0, self.cells[t])

    def every(self, part: Tensor) -> Tensor:
        """Return a part of all steps, (steps, rows or 1, ...)."""
        return part.unflatten(0, (-1, self.rows)) if self.cells is None else part[self.cells]


class _Whole:
    def __init__(self, engine: Any, record: Record, belief: FiniteBelief):
        rows = len(belief.log_probs)
        self.engine, self.layout, self.rows = engine, engine.layout, rows
        self.actions, self.seen = record.checked(engine, rows)
        context, self.kept = engine.known.along(self.actions, self.seen, record.steps, rows)
        self.context = {key: alike(context[key]) for key in self.layout.keys}
        self.wide = max((value.shape[1] for value in self.context.values()), default=1)
        statics, states = len(self.layout.statics), len(self.layout.present)
        self.lead = 1 + statics
        self.now = tuple(range(1 + statics, 1 + statics + states))
        self.outcomes: dict[str, tuple[Table, int, _Likelihood]] = {}
        self._rows(range(1))
        largest = max(_width(table) for table in engine.tabulation.tables.values())
        # How many numbers are held for a step.
        self.numbers = max(belief.log_probs.numel(), rows * largest)

    def _rows(self, span: range) -> Tensor:
        """Which context each of some steps is in, (steps, rows or 1)."""
        here = {key: value[span.start : span.stop] for key, value in self.context.items()}
        index = self.engine.tabulation.find({key: folded(value, self.wide) for key, value in here.items()})
        return index.reshape(-1, self.wide) if len(index) > 1 else index.expand(len(span), 1)

    def piece(self, belief: FiniteBelief, span: range) -> list[Later] | None:
        """Return some steps' beliefs, or None where probabilities get too small for what follows."""
        engine, tabulation = self.engine, self.engine.tabulation
        index = self._rows(span)
        seen = [self._likelihood(name, index, self.seen[name][span.start : span.stop]) for name in tabulation.tables]
        logs, alpha = self._divided(belief.log_probs)
        rises = torch.zeros(1, 1, *logs.shape[1:], dtype=torch.float64)
        if self.now:
            late = [one for one, name in zip(seen, tabulation.tables, strict=True) if name in tabulation.late]
            early = [one for one, name in zip(seen, tabulation.tables, strict=True) if name not in tabulation.late]
            alphas, totals = _Chain(self, index, early).run(alpha, late, len(span))
            total = torch.stack(totals)
            if not float(total.detach().amin()) > torch.finfo(total.dtype).tiny ** 0.3:
                return None
            rises = rises + total.log()
        else:
            alphas = []
        for one in seen:
            rises = rises + one.every(one.shift)
        logs = logs + rises.cumsum(0)
        one_static = logs[0, 0].numel() == 1
        evidence = logs.flatten(2)[..., 0] if one_static else logs.flatten(2).logsumexp(2)
        if not math.isfinite(float(evidence.detach().sum())):
            return None
        logs = (logs - evidence.reshape(*evidence.shape, *[1] * (logs.dim() - 2))).to(engine.dtype)
        for one in seen:
            if one.base is not None:
                evidence = evidence + one.every(one.base).cumsum(0, dtype=torch.float64)
        evidence = evidence if belief.batch is not None else evidence[:, 0]
        evidence = (belief.log_evidence + evidence).to(engine.dtype)

        def made(t: int) -> FiniteBelief:
            with alone(belief.log_probs.numel()):
                found = logs[t].expand(self.rows, *logs.shape[2:])
                if self.now:
                    found = alphas[t].log() if one_static else alphas[t].log() + found
                found = self.layout.padded(found)
            kept = self.kept[span.start + t]
            return FiniteBelief(engine, belief.batch, belief.time + 1 + t, evidence[t], kept, found)

        return [Later(made, t) for t in range(len(span))]

    def _divided(self, log_probs: Tensor) -> tuple[Tensor, Tensor]:
        """Log p(statics), (rows, *statics, 1 ...), in double precision; and p(states | statics), (rows, *sizes)."""
        if not self.now:
            return log_probs.double(), log_probs
        logs = log_probs.logsumexp(self.now, keepdim=True)
        some = torch.where(torch.isfinite(logs), logs, 0.0)
        # Where statics are impossible, any states will do.
        return logs.double(), torch.where(torch.isfinite(logs), (log_probs - some).exp(), 1.0)

    def _likelihood(self, name: str, index: Tensor, seen: Tensor) -> _Likelihood:
        table: Table = self.engine.tabulation.tables[name]
        rows = max(index.shape[1], seen.shape[1])
        y = table.read(folded(seen.reshape(*seen.shape[:2], -1), rows), self.engine.labels[name])
        outcomes, contexts = table.outcomes, int(index.max()) + 1
        at = index[0].expand(len(y)) if index.stride(0) == 0 else index.expand(-1, rows).flatten()
        if outcomes is None or y.is_floating_point() or contexts * len(outcomes) > len(y):
            return self._told(name, table, at, y, None, rows)
        # So few that all of them are looked up: the likelihood of every outcome in every context.
        held = self.outcomes.get(name)
        if held is None or held[0] is not table or held[1] < contexts:
            each = torch.arange(contexts).repeat_interleave(len(outcomes))
            found = self._told(name, table, each, outcomes.repeat(contexts, 1), None, rows)
            held = self.outcomes[name] = table, contexts, found
        base = round(len(outcomes) ** (1 / y.shape[1]))
        weights = base ** torch.arange(y.shape[1] - 1, -1, -1)
        cells = (at * len(outcomes) + (y * weights).sum(1)).reshape(-1, rows)
        return _Likelihood(held[2].values, held[2].shift, held[2].base, cells, rows)

    def _told(self, name: str, table: Table, at: Tensor, y: Tensor, cells: Tensor | None, rows: int) -> _Likelihood:
        tabulation = self.engine.tabulation
        ratio, base = table.score(at, y)
        late = name in tabulation.late
        ratio = ratio.reshape(len(ratio), *(tabulation.now_shapes if late else tabulation.shapes)[name])
        states = tuple(range(self.lead, ratio.dim()))
        if not states:
            return _Likelihood(torch.ones(1), ratio, base if isinstance(base, Tensor) else None, cells, rows)
        shift = ratio.amax(states, keepdim=True).clamp(min=torch.finfo(ratio.dtype).min)
        values = (ratio - shift).exp()
        shift = shift.flatten(self.lead)[..., :1].reshape(*shift.shape[: self.lead], *[1] * len(self.now))
        return _Likelihood(values, shift, base if isinstance(base, Tensor) else None, cells, rows)


class _Chain:
    """How states follow each other, in probabilities."""

    def __init__(self, whole: _Whole, index: Tensor, early: list[_Likelihood]):
        self.layout, self.now, self.early, self.index = whole.layout, whole.now, early, index
        self.tabulation = whole.engine.tabulation
        self.alike = (index == index[:, :1]).all(1).tolist()
        self.first = index[:, 0].tolist()
        layout = self.layout
        self.single = len(layout.present) == len(layout.previous) == 1 and not early
        if self.single:
            matrices = self.tabulation.transitions(slice(None))[0]
            # A state that does not depend on its past has one row for all of it.
            self.matrices = matrices.expand(*matrices.shape[:-2], layout.previous[0].size, matrices.shape[-1])
            self.varies = layout.varies(layout.present[0].name)
            self.later = self.matrices[..., : layout.present[0].size, :].contiguous()

    def run(self, alpha: Tensor, late: list[_Likelihood], steps: int) -> tuple[list[Tensor], list[Tensor]]:
        """Return p(states | statics) after each step (rows, *sizes), and what each step's likelihood came to."""
        alphas, totals = [], []
        for t in range(steps):
            alpha = self._matrix(alpha, t) if self.single else self._contracted(alpha, t)
            for one in late:
                alpha = alpha.mul_(one.at(t))
            total = alpha.sum(self.now, keepdim=True)
            alpha = alpha.div_(total)
            alphas.append(alpha)
            totals.append(total)
        return alphas, totals

    def _matrix(self, alpha: Tensor, t: int) -> Tensor:
        """One state, and one matrix for each context."""
        # A value that only the time before the first step had never comes back.
        matrices = self.later if alpha.shape[-1] == self.later.shape[-2] else self.matrices
        if not self.varies or self.alike[t]:
            matrix = matrices[self.first[t] if self.varies else 0]
            if matrix.dim() == 2 or matrix.shape[:-2].numel() == 1:
                return alpha @ matrix.reshape(matrix.shape[-2:])
            return (alpha.movedim(0, -2) @ matrix).movedim(-2, 0)
        rows = self.index[t]
        kinds, counts = rows.unique(return_counts=True)
        if len(kinds) > SORTED:
            return (alpha[..., None, :] @ matrices[rows]).squeeze(-2)
        order = rows.argsort(stable=True)
        parts = alpha.index_select(0, order).split(counts.tolist())
        pairs = zip(parts, kinds.tolist(), strict=True)
        made = torch.cat([(part.movedim(0, -2) @ matrices[kind]).movedim(-2, 0) for part, kind in pairs])
        return torch.empty_like(made).index_copy(0, order, made)

    def _contracted(self, alpha: Tensor, t: int) -> Tensor:
        """Any number of states, of which only some are remembered."""
        layout = self.layout
        rows = self.index[t, :1] if self.alike[t] else self.index[t]
        kept = {axis.name for axis in layout.previous}
        past = alpha
        gone = [dim for dim, axis in zip(self.now, layout.states, strict=True) if axis.name not in kept]
        past = past.sum(gone) if gone else past
        sizes = [axis.size for axis in layout.previous]
        missing = [n for size, now in zip(reversed(sizes), reversed(past.shape), strict=False) for n in (0, size - now)]
        past = torch.nn.functional.pad(past, missing) if any(missing) else past
        past = past.reshape(*past.shape, *[1] * len(layout.present))
        factors = [past, *(one.at(t) for one in self.early), *self.tabulation.transitions(rows)]
        return contract(factors, len(layout.statics), len(layout.previous))


def _width(table: Table) -> int:
    """How many numbers it takes to score one observation."""
    index = getattr(table, "index", None)
    elements = table.event_shape.numel()
    return table.hypotheses * elements if index is None else index[0].numel() + elements
