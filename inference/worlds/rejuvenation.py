"""Giving particles that share a static value values of their own again, without changing what they stand for.

A Metropolis-Hastings move for each static, whose target is the posterior given a particle's own path: the whole record
is scored again under the proposed value (resample-move; Gilks and Berzuini 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import biject_to

from apmodels.distributions import base_of
from apmodels.simulation import Values
from inference.worlds.step import BankBelief, flat, pick

# Metropolis steps after each resampling.
SWEEPS = 3


@dataclass(frozen=True)
class Past:
    """What was done and seen, and what every particle drew for itself: a list that shares its beginnings."""

    before: Past | None = None
    actions: Values | None = None
    seen: Values | None = None
    drawn: Values | None = None
    # Which particle of before each one comes from, where it was resampled.
    index: Tensor | None = None

    def after(self, actions: Values, seen: Values, drawn: Values) -> Past:
        """Return the past after one more step."""
        return Past(self, actions, seen, drawn)

    def resampled(self, index: Tensor) -> Past:
        """Return the past of chosen particles."""
        return Past(self, index=index)

    def record(self) -> list[tuple[Values, Values, Values]]:
        """Return (actions, observations, the particles' own path) of every step, oldest first."""
        found, node, lineage = [], self, None
        while node is not None:
            if node.index is not None:
                lineage = node.index if lineage is None else node.index.gather(1, lineage)
            elif node.actions is not None:
                assert node.seen is not None and node.drawn is not None
                path = node.drawn if lineage is None else {n: pick(v, lineage) for n, v in node.drawn.items()}
                found.append((node.actions, node.seen, path))
            node = node.before  # type: ignore[assignment]
        return found[::-1]


def rejuvenated(engine: Any, belief: BankBelief, rows: Tensor) -> BankBelief:
    """Move the statics of the particles of some rows (rows,), those that were just resampled."""
    record = belief.past.record()
    now = {name: belief.values[name] for name in engine.sampled_statics}
    score, made = _replayed(engine, belief, now, record)
    for _ in range(SWEEPS):
        for names in _blocks(engine):
            proposed, ratio = _proposal(engine, belief, now, names)
            other, remade = _replayed(engine, belief, now | proposed, record)
            accepted = (torch.rand(score.shape, dtype=score.dtype).log() < other - score + ratio) & rows[:, None]
            now = {n: _where(accepted, proposed.get(n, now[n]), now[n]) for n in now}
            score = torch.where(accepted, other, score)
            made = _merged(accepted, remade, made)
    return replace(
        belief,
        values={name: _where(rows[:, None], value, belief.values[name]) for name, value in made.values.items()},
        gaussian=made.gaussian,
        fields=made.fields,
        counts=made.counts,
        finite=made.finite,
    )


def forgotten(engine: Any, belief: BankBelief) -> bool:
    """Tell whether some row has no particle any more with some value of a finite static."""
    for name in engine.sampled_statics:
        listed = engine.structure.nodes[name].values
        if listed is not None and len(listed) <= engine.particles:
            value, wanted = flat(belief.values[name]), listed.reshape(1, 1, len(listed), -1)
            if not bool((value[:, :, None] == wanted).all(-1).any(1).all()):
                return True
    return False


def _blocks(engine: Any) -> list[tuple[str, ...]]:
    """What is moved together: all continuous statics, and each finite one."""
    finite = [name for name in engine.sampled_statics if engine.structure.nodes[name].values is not None]
    rest = tuple(name for name in engine.sampled_statics if name not in finite)
    return [*((rest,) if rest else ()), *((name,) for name in finite)]


def _replayed(engine: Any, belief: BankBelief, statics: Values, record: list) -> tuple[Tensor, BankBelief]:
    """Score a record under these statics along the particles' paths, (rows, worlds); and what is then believed."""
    start = engine.replay_start(belief.batch, statics)
    total = start.log_weights
    for actions, seen, path in record:
        step, known = engine.step_of(start, actions)
        engine.move(step, path)
        engine.sense(step, seen)
        total = total + step.prior + step.score
        flat = torch.zeros(step.lead, dtype=engine.dtype)
        start = engine.made(replace(start, past=None), step, known | actions, flat, seen)
    return total, start


def _proposal(engine: Any, belief: BankBelief, now: Values, names: tuple[str, ...]) -> tuple[Values, Tensor]:
    """New values, and the log of how much likelier the way back is than the way there, (rows, worlds)."""
    lead = belief.log_weights.shape
    listed = engine.structure.nodes[names[0]].values
    if listed is not None:
        value = now[names[0]].expand(*lead, *now[names[0]].shape[2:])
        # Half of them what others have, and half any value at all: one that all have lost may be right in the end.
        any_value = listed.to(value.dtype)[torch.randint(len(listed), lead)]
        other = _where(torch.rand(lead) < 0.5, any_value, pick(value, torch.randint(lead[1], lead)))
        here, there = (_share(value, listed, v) + 1 / len(listed) for v in (value, other))
        return {names[0]: other}, here.log() - there.log()
    ways = {name: _unbounded(engine, name) for name in names}
    free = {name: flat(ways[name].inv(now[name])) for name in names}
    whole = torch.cat(list(free.values()), -1).double()
    size = whole.shape[-1]
    off = whole - whole.mean(1, keepdim=True)
    covariance = off.mT @ off / lead[1] + 1e-10 * torch.eye(size, dtype=torch.float64)
    step = 2.38 / size**0.5 * torch.linalg.cholesky(covariance)
    moved = whole + (step[:, None] @ torch.randn(*lead, size, 1, dtype=torch.float64))[..., 0]
    proposed, ratio = {}, torch.zeros(lead, dtype=engine.dtype)
    parts = moved.to(engine.dtype).split([part.shape[-1] for part in free.values()], -1)
    for name, part in zip(names, parts, strict=True):
        moved_to = part.reshape(ways[name].inv(now[name]).shape)
        proposed[name] = ways[name](moved_to)
        ratio = ratio + _slope(ways[name], moved_to) - _slope(ways[name], ways[name].inv(now[name]))
    return proposed, ratio


def _unbounded(engine: Any, name: str) -> Any:
    """The way from all real numbers to the values that a static may have."""
    law, _ = base_of(engine.model_law(name))
    return biject_to(law.support)


def _slope(way: Any, free: Tensor) -> Tensor:
    slope = way.log_abs_det_jacobian(free, way(free))
    return slope.flatten(2).sum(-1) if slope.dim() > 2 else slope


def _share(values: Tensor, listed: Tensor, wanted: Tensor) -> Tensor:
    """How large a share of the particles of its row has each wanted value, (rows, worlds)."""
    have, want = (_places(listed, value) for value in (values, wanted))
    counts = torch.zeros(len(have), len(listed), dtype=torch.float64).scatter_add(
        1, have, torch.ones(have.shape, dtype=torch.float64)
    )
    return counts.gather(1, want) / have.shape[1]


def _places(listed: Tensor, values: Tensor) -> Tensor:
    """Which of some values each particle has, (rows, worlds)."""
    same = flat(values)[:, :, None] == listed.reshape(1, 1, len(listed), -1)
    return same.all(-1).to(torch.uint8).argmax(-1)


def _where(chosen: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    return torch.where(chosen.reshape(*chosen.shape, *[1] * (yes.dim() - 2)), yes, no)


def _merged(chosen: Tensor, yes: BankBelief, no: BankBelief) -> BankBelief:
    def both(a: Tensor, b: Tensor) -> Tensor:
        if a.shape[:2] == b.shape[:2] == (1, 1) and torch.equal(a, b):
            return a
        return _where(chosen, a, b)

    gaussian = zip(yes.gaussian, no.gaussian, strict=True)
    return replace(
        no,
        values={name: _where(chosen, yes.values[name], value) for name, value in no.values.items()},
        gaussian=tuple(type(a)(both(a.mean, b.mean), both(a.covariance, b.covariance)) for a, b in gaussian),
        fields=tuple(
            {n: (both(a[n][0], b[n][0]), both(a[n][1], b[n][1])) for n in a}
            for a, b in zip(yes.fields, no.fields, strict=True)
        ),
        counts=tuple(both(a, b) for a, b in zip(yes.counts, no.counts, strict=True)),
        finite=None if yes.finite is None or no.finite is None else both(yes.finite, no.finite),
    )
