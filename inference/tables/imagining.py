"""Expected information: what would be seen after an action, and how much surer that would make one (eq. 5.4)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values, as_dict, check_actions
from inference.tables.table import FEW_OUTCOMES

# How many numbers are held at a time.
CHUNK = 8_000_000


def information_gain(engine: Any, belief: Any, actions: Any, samples: int, seed: int) -> Tensor:
    """Return I(interest; next observation | action) under the exact engine, nats, (*batch, K).

    Every pair of a belief and an action is a row. Where the observations of a row have few outcomes, the
    expectation is a sum over all of them; else an average over imagined ones, drawn with the same random numbers
    for every action, so that differences between actions are much surer than the gains themselves.
    """
    acts = choices(engine, actions)
    many = len(next(iter(acts.values()))) if acts else 1
    count = len(belief.log_probs)
    step = max(1, CHUNK // (max(samples, 1) * torch.Size(engine.layout.sizes).numel()))
    parts = []
    for pairs in torch.arange(count * many).split(step):
        rows, chosen = pairs // many, {name: values[pairs % many] for name, values in acts.items()}
        parts.append(_Imagination(engine, belief, rows, chosen).gain(samples, seed))
    gains = torch.cat(parts).reshape(count, many)
    return gains[0] if belief.batch is None else gains


def choices(engine: Any, actions: Any) -> Values:
    """Return the actions to be compared, (K, *shape) by name: those given, or all of a finite space."""
    names = engine.model.action_names
    if actions is None and len(names) == 1:
        space = engine.model.space(names[0])
        if space.size is None:
            raise ValueOutOfRange(f"{names[0]} is a continuum; pass the actions to be compared")
        return {names[0]: space.values()}
    checked = check_actions(engine.model, as_dict(actions, names, "action"))
    for name, value in checked.items():
        shape = engine.spaces[name].shape
        if value.dim() != 1 + len(shape):
            raise ValueOutOfRange(f"{name} to be compared has shape {tuple(value.shape)}; K actions are (K, *{shape})")
    return checked


class _Imagination:
    """What R beliefs expect after R actions: log p(statics, states before, states now), and the observations."""

    def __init__(self, engine: Any, belief: Any, rows: Tensor, actions: Values):
        known = {name: value[rows] for name, value in belief.known.items()}
        part = replace(belief, batch=len(rows), log_probs=belief.log_probs[rows], known=known)
        _, context = engine.know(part, actions)
        self.engine = engine
        self.rows = engine.tabulation.find(context).expand(len(rows))
        self.past = range(1 + len(engine.layout.statics), 1 + len(engine.layout.statics) + len(engine.layout.previous))
        if engine.tabulation.late == set(engine.tabulation.tables):
            logs, _ = engine.predict(part.log_probs, self.rows, [])
            shape = logs.shape[: self.past.start] + (1,) * len(self.past) + logs.shape[self.past.start :]
            self.logs = logs.reshape(shape)
        else:
            self.logs = engine.joint(part.log_probs, self.rows).log()

    def gain(self, samples: int, seed: int) -> Tensor:
        """Return the expected information of each row, nats, (R,)."""
        outcomes = {name: table.outcomes for name, table in self.engine.tabulation.tables.items()}
        few = [len(values) for values in outcomes.values() if values is not None]
        before = self._entropy(self.logs)
        if len(few) == len(outcomes) and torch.Size(few).numel() <= FEW_OUTCOMES:
            after = self._posterior(self._all(outcomes, torch.Size(few)))
            weights = self._total(after).exp()
        else:
            after = self._posterior(self._drawn(samples, seed))
            weights = torch.full(after.shape[:2], 1.0 / samples, dtype=after.dtype)
        # An outcome that cannot happen has no posterior, and no weight.
        normalised = after - self._total(after).clamp(min=-1e30).reshape(*after.shape[:2], *[1] * (after.dim() - 2))
        entropies = self._entropy(normalised.flatten(0, 1)).reshape(weights.shape)
        gain = before - (weights * torch.where(weights > 0, entropies, 0.0)).sum(1)
        # No information is negative; rounding, and few imagined observations, can make it seem so.
        return gain.clamp(min=0)

    def _all(self, outcomes: dict[str, Tensor], counts: torch.Size) -> Values:
        """Every joint outcome, (R, outcomes, elements) by name."""
        picks = torch.cartesian_prod(*[torch.arange(n) for n in counts]).reshape(-1, len(counts))
        return {
            name: values[picks[:, i]].expand(len(self.rows), -1, -1)
            for i, (name, values) in enumerate(outcomes.items())
        }

    def _drawn(self, samples: int, seed: int) -> Values:
        """Imagined observations, (R, samples, elements) by name: worlds at even steps of the belief, then noise."""
        weights = self.logs.reshape(len(self.logs), -1).exp()
        cumulative = weights.cumsum(1)
        # Even steps from a random start: unbiased, and far less noisy than independent draws.
        start = torch.rand((), generator=torch.Generator().manual_seed(seed), dtype=weights.dtype)
        even = (torch.arange(samples, dtype=weights.dtype) + start) / samples
        worlds = torch.searchsorted(cumulative, even * cumulative[:, -1:]).clamp(max=weights.shape[1] - 1)
        drawn = {}
        for i, (name, table) in enumerate(self.engine.tabulation.tables.items()):
            shape = self.engine.tabulation.shapes[name]
            own = torch.arange(torch.Size(shape).numel()).reshape(shape).expand(self.logs.shape[1:]).flatten()
            drawn[name] = table.sample(self.rows, own[worlds], seed + i)
        return drawn

    def _posterior(self, seen: Values) -> Tensor:
        """log p(world, observation), up to what all worlds share, (R, S, *mesh)."""
        logs = self.logs[:, None]
        exact = all(table.outcomes is not None for table in self.engine.tabulation.tables.values())
        for name, table in self.engine.tabulation.tables.items():
            y = seen[name]
            rows = self.rows.repeat_interleave(y.shape[1])
            ratio = table.ratio(rows, y.flatten(0, 1))
            if exact:
                base = table.base(rows, y.flatten(0, 1))
                ratio = ratio + (base[:, None] if isinstance(base, Tensor) else base)
            logs = logs + ratio.reshape(*y.shape[:2], *self.engine.tabulation.shapes[name])
        return logs

    def _total(self, logs: Tensor) -> Tensor:
        return logs.reshape(*logs.shape[:2], -1).logsumexp(2)

    def _entropy(self, logs: Tensor) -> Tensor:
        """The entropy of the interest now, (N,), from normalised log weights (N, *mesh)."""
        present = logs.logsumexp(tuple(self.past)) if len(self.past) else logs
        return self.engine.projections.entropy(self.engine.layout.padded(present), self.engine.names(None))
