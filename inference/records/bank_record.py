"""A bank of hypotheses led along a whole record, all steps at once where nothing stands against it."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values
from inference.records.passage import WIDEST, Passage, missing, passage
from inference.records.record import Beliefs, Later, Record, alike, folded
from inference.worlds.frame import Frame, Key, Memory
from inference.worlds.step import BankBelief

# So many numbers of one kind are held at a time; what needs more is led along in pieces.
MOST = 1 << 22
# Pieces of fewer steps than these are not worth the trouble.
FEWEST = 8


def along(engine: Any, record: Record, batch: int | None) -> Beliefs | list[Any]:
    """Return the beliefs along a record; step by step, where they cannot be had otherwise."""
    belief = engine.start(batch)
    if not _serves(engine, belief) or record.steps < 2:
        return engine.stepwise(belief, record)
    whole = _Whole(engine, record, belief)
    items: list[Any] = []
    while len(items) < record.steps:
        found = whole.piece(belief, len(items))
        if found is None:
            return Beliefs([*items, *engine.stepwise(belief, record, len(items))])
        items += found
        belief = Beliefs(items[-1:])[0]
    return Beliefs(items)


def _serves(engine: Any, belief: BankBelief) -> bool:
    plan, roles = engine.plan, engine.roles
    if plan.fields or plan.finite or plan.counted or not plan.gaussian:
        return False
    if any(roles[name] == "state" and name in belief.values for name in plan.computed):
        return False
    if any(len(value) > 1 for value in belief.values.values()):
        return False
    return all(block.seen and sum(block._width(block.steps[""].end)) <= WIDEST for block in engine.gaussians)


class _Whole:
    def __init__(self, engine: Any, record: Record, belief: BankBelief):
        self.engine, self.steps = engine, record.steps
        self.rows, self.worlds = belief.log_weights.shape
        self.actions, self.seen = record.checked(engine, self.rows)
        context, self.kept = engine.known.along(self.actions, self.seen, self.steps, self.rows)
        self.context = {key: alike(value) for key, value in context.items()}
        self.states = [name for name in engine.plan.computed if engine.roles[name] == "state"]
        self.statics: Values = {name: value for name, value in belief.values.items() if name not in self.states}
        keys = {key for block in engine.gaussians for m in _memories(block) for key in m.keys if key in self.context}
        common = all(self.context[key].shape[1] == 1 for key in keys)
        gone = [missing(_flat(self.seen[name])) for block in engine.gaussians for name in block.seen]
        common = common and all(some is None or some.shape[1] == 1 for some in gone)
        groups = self.worlds * (1 if common else self.rows)
        widest = max(sum(block._width(block.steps[""].end)) for block in engine.gaussians)
        self.size = MOST // max(groups * widest * widest, self.rows * self.worlds * widest)

    def piece(self, belief: BankBelief, first: int) -> list[Later] | None:
        """Return some steps' beliefs, from ``first`` on, or None where there is no more than step by step."""
        span = range(first, min(first + self.size, self.steps))
        if self.size < FEWEST:
            return None
        engine = self.engine
        computed: Values = {}
        for name in self.states:
            computed[name] = self._computed(name, span, computed)
        scores, passages = [], []
        for block, gaussian in zip(engine.gaussians, belief.gaussian, strict=True):
            value = _side_by_side([self.seen[name][span.start : span.stop] for name in block.seen])
            parts = partial(self._parts, span=span, computed=computed)
            found = passage(block, gaussian, belief.time, parts, value, self.rows)
            if found is None:
                return None
            passages.append(found)
            scores.append(found.score)
        for name in engine.model.observation_names:
            if name not in engine.owner:
                scores.append(self._score(name, span, computed))
        return self._beliefs(belief, span, scores, passages, computed)

    def _beliefs(
        self, belief: BankBelief, span: range, scores: list[Tensor], passages: list[Passage], computed: Values
    ) -> list[Later]:
        engine = self.engine
        total = scores[0]
        for score in scores[1:]:
            total = total + score
        total = total.cumsum(0, dtype=torch.float64)
        if self.worlds > 1:
            weights = belief.log_weights + total
            evidence = weights.logsumexp(2)
            weights = (weights - evidence[:, :, None]).to(engine.dtype)
        else:
            evidence = total.expand(-1, self.rows, -1)[:, :, 0]
            weights = torch.zeros(1, 1, 1, dtype=engine.dtype).expand(len(span), self.rows, 1)
        if not math.isfinite(float(evidence.detach().sum())):
            raise ValueOutOfRange(f"{type(engine.model).__name__} gives what was observed no probability at all")
        evidence = evidence if belief.batch is not None else evidence[:, 0]
        evidence = (belief.log_evidence + evidence).to(engine.dtype)
        values = {name: value for name, value in belief.values.items() if name not in computed}

        def made(t: int) -> BankBelief:
            here = {name: value[t if len(value) > 1 else 0] for name, value in computed.items()}
            return BankBelief(
                engine=engine,
                batch=belief.batch,
                time=belief.time + 1 + t,
                log_evidence=evidence[t],
                known=self.kept[span.start + t],
                log_weights=weights[t],
                values=values | here,
                gaussian=tuple(one.at(t) for one in passages),
                fields=(),
                counts=(),
                finite=None,
            )

        return [Later(made, t) for t in range(len(span))]

    # Laws in the contexts of many steps at once.

    def _frame(self, keys: list[Key], span: range, computed: Values) -> tuple[Frame, int]:
        """What is known of these, with steps and rows folded into rows; and how many rows there are to a step."""
        timed = {}
        for key in keys:
            if key in self.context:
                timed[key] = self.context[key][span.start : span.stop][:, :, None]
            elif key[0] in computed and not key[1]:
                timed[key] = computed[key[0]]
            elif key[0] in self.seen and not key[1]:
                timed[key] = self.seen[key[0]][span.start : span.stop][:, :, None]
        rows = max((value.shape[1] for value in timed.values()), default=1)
        frame: dict[Key, Tensor] = {}
        for key in keys:
            frame[key] = folded(timed[key], rows) if key in timed else self.statics[key[0]]
        return Frame(frame), rows

    def _parts(self, memory: Memory, span: range, computed: Values) -> tuple[Tensor, ...]:
        frame, rows = self._frame(memory.keys, span, computed)
        return tuple(_unfolded(part, rows) for part in memory(frame))

    def _computed(self, name: str, span: range, computed: Values) -> Tensor:
        frame, rows = self._frame(self.engine._parents(name), span, computed)
        law = frame.in_all(self.engine.laws, name, frame.lead())
        assert isinstance(law, Tensor)
        return _unfolded(law, rows)

    def _score(self, name: str, span: range, computed: Values) -> Tensor:
        frame, rows = self._frame([*self.engine._parents(name), (name, 0)], span, computed)
        score = frame.score(self.engine.laws, name, frame.values[name, 0], frame.lead())
        return _unfolded(score, rows)


def _memories(block: Any) -> tuple[Memory, Memory]:
    return block.steps[""].moves, block.steps[""].views


def _unfolded(part: Tensor, rows: int) -> Tensor:
    """(steps * rows or 1, worlds or 1, ...) as (steps or 1, rows or 1, worlds or 1, ...)."""
    return part[:, None] if len(part) == 1 else part.unflatten(0, (-1, rows))


def _side_by_side(values: list[Tensor]) -> Tensor:
    """(steps, rows or 1, numbers of all)."""
    rows = max(value.shape[1] for value in values)
    if len(values) == 1:
        return _flat(values[0])
    return torch.cat([_flat(value).expand(-1, rows, -1) for value in values], -1)


def _flat(value: Tensor) -> Tensor:
    """(steps, rows, *shape) as (steps, rows, numbers)."""
    return value.reshape(*value.shape[:2], -1)
