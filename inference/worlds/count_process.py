"""The sufficient statistic of a counted model as a Markov chain that actions steer: what plans are made on.

Of "is anybody answering me?" its states are the timer, and the sounds and silences while an answer could have come and
while none could (thesis eqs 4.52 to 4.54).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values
from inference.worlds.frame import Frame
from inference.worlds.statistic import MOST, actions_of, bearing, hypotheses_of


@dataclass(frozen=True)
class CountProcess:
    """Known states that actions lead through, and atoms: kinds of outcomes that are counted apart.

    ``states`` (Z, numbers) are the known states, the first of which is number ``first``; ``after`` (Z, U) is where an
    action leads, and ``atom`` (Z, U) what the outcome there is counted as, -1 where it tells nothing. An atom's
    outcomes are drawn from ``component`` (K, H) under each hypothesis, with pseudo-counts ``prior`` (H, components,
    outcomes); ``log_prior`` (H,) is the hypotheses'. ``actions`` are by name, (U, *shape).
    """

    engine: Any
    states: Tensor
    first: int
    after: Tensor
    atom: Tensor
    actions: Values
    component: Tensor
    prior: Tensor
    log_prior: Tensor

    @property
    def atoms(self) -> int:
        """How many kinds of outcomes are counted apart."""
        return len(self.component)

    def read(self, belief: Any) -> tuple[Tensor, Tensor]:
        """Return a belief's known state, (rows,), and its counts, (rows, atoms, outcomes)."""
        rows = len(belief.log_weights)
        kept = _row(belief.known, rows)
        state = (kept[:, None] == self.states[None]).all(-1).to(torch.uint8).argmax(-1)
        added = belief.counts[0] - self.prior[None]
        found = [added[:, h, c] for h, c in _telling(self.component)]
        counts = torch.stack(found, 1) if found else torch.zeros(rows, 0, self.prior.shape[-1])
        return state, counts.expand(rows, *counts.shape[1:]).round().long()

    def beliefs(self, counts: Tensor) -> Any:
        """Return what is believed after counts (rows, atoms, outcomes)."""
        start = self.engine.start(len(counts))
        added = torch.zeros(len(counts), *self.prior.shape, dtype=torch.float64)
        for k in range(self.atoms):
            for h in range(self.prior.shape[0]):
                added[:, h, self.component[k, h]] += counts[:, k].double()
        logs = self.log_prior + _log_evidence(self.prior + added) - _log_evidence(self.prior)
        weights = logs.log_softmax(1).to(self.engine.dtype)
        return replace(start, counts=(self.prior + added,), log_weights=weights)


def count_process(engine: Any) -> CountProcess:
    """Return the statistic of an engine that counts one Bernoulli or categorical observation."""
    name = type(engine.model).__name__
    if len(engine.tallies) != 1 or engine.plan.finite or engine.plan.gaussian or engine.plan.fields:
        raise ValueOutOfRange(f"{name} is not known by counting alone; there is no finite statistic to plan on")
    block = engine.tallies[0]
    children = list(block.selected)
    if block.kind == "Gamma" or len(children) != 1 or torch.Size(engine.shown[children[0]]).numel() != 1:
        raise ValueOutOfRange(f"{name} counts more than one outcome of few values a step: {', '.join(children)}")
    start = engine.start()
    hypotheses = hypotheses_of(engine, start)
    prior = block.start(Frame(hypotheses)).expand(1, start.log_weights.shape[1], -1, -1)[0]
    states, after, selected, actions = _walked(engine, block, children[0], hypotheses, len(prior))
    table, kinds = torch.unique(selected.flatten(0, 1), dim=0, return_inverse=True)
    asked = any(name in engine.plan.integrated for name in engine.structure.interest)
    told = (table >= 0).any(1) if asked else bearing(table, prior)
    number = torch.where(told, told.cumsum(0) - 1, -1)
    component = table[told]
    _telling(component)
    return CountProcess(
        engine=engine,
        states=states,
        first=0,
        after=after,
        atom=number[kinds].reshape(after.shape),
        actions=actions,
        component=component,
        prior=prior,
        log_prior=start.log_weights[0].double(),
    )


def _walked(engine: Any, block: Any, child: str, hypotheses: dict, count: int) -> tuple:
    """All known states, where every action leads, and what the outcome there selects under each hypothesis."""
    choices = actions_of(engine)
    sensed = set(engine.known.kept) & set(engine.model.observation_names)
    if sensed:
        raise ValueOutOfRange(f"{type(engine.model).__name__} remembers what it saw: {', '.join(sorted(sensed))}")
    rows: dict[tuple, int] = {}
    waiting = [engine.known.first(1)]
    rows[_mark(waiting[0])] = 0
    states, after, selected = [_row(waiting[0], 1)], [], []
    for kept in waiting:
        leads, picks = [], []
        for action in choices:
            known, context = engine.known.move(kept, action, 1)
            there = {name: (known | action)[name] for name in engine.known.kept}
            mark = _mark(there)
            if mark not in rows:
                rows[mark] = len(rows)
                states.append(_row(there, 1))
                waiting.append(there)
                if len(rows) > MOST:
                    raise ValueOutOfRange(f"what is known takes more than {MOST} values; bound it, with clamp say")
            leads.append(rows[mark])
            frame = Frame({key: value[:, None] for key, value in context.items()} | hypotheses)
            picks.append(block.selected[child](frame)[0][0, :, 0].expand(count))
        after.append(leads)
        selected.append(torch.stack(picks))
    actions = {name: torch.cat([choice[name] for choice in choices]) for name in choices[0]}
    return torch.cat(states), torch.tensor(after), torch.stack(selected), actions


def _telling(component: Tensor) -> list[tuple[int, int]]:
    """For every atom a (hypothesis, component) that counts it and no other."""
    found = []
    for k, row in enumerate(component.tolist()):
        own = [(h, c) for h, c in enumerate(row) if c >= 0 and (component[:, h] == c).sum() == 1]
        if not own:
            raise ValueOutOfRange(f"outcomes of kind {k} are never counted apart from others: no plan can be made")
        found.append(own[-1])
    return found


def _log_evidence(counts: Tensor) -> Tensor:
    """log of the Dirichlet normaliser, summed over components, (..., H)."""
    return (torch.lgamma(counts).sum(-1) - torch.lgamma(counts.sum(-1))).sum(-1)


def _mark(kept: Values) -> tuple:
    return tuple(_row(kept, 1)[0].tolist())


def _row(kept: Values, rows: int) -> Tensor:
    parts = [value.reshape(value.shape[0], -1).expand(rows, -1).double() for value in kept.values()]
    return torch.cat(parts, 1) if parts else torch.zeros(rows, 0, dtype=torch.float64)
