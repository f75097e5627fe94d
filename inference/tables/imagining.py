"""Expectations: what would be seen after an action, and what one would believe then (thesis eq. 5.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values, as_dict, check_actions
from inference.tables.table import FEW_OUTCOMES

# How many numbers are held at a time; more would not stay in a processor's cache, and take twice as long.
CHUNK = 500_000
# A function of the interest's log probabilities (N, n), (N,).
Worth = Callable[[Tensor], Tensor]


def information_gain(engine: Any, belief: Any, actions: Any, samples: int, seed: int) -> Tensor:
    """Return I(interest; next observation | action) under the exact engine, nats, (*batch, K)."""

    def gain(imagined: Imagination) -> Tensor:
        # No information is negative; rounding, and few imagined observations, can make it seem so.
        return (uncertainty(imagined.before()) - imagined.expected(uncertainty, samples, seed)).clamp(min=0)

    return of_pairs(engine, belief, actions, gain, samples)


def expectation(engine: Any, belief: Any, worth: Worth, actions: Any, samples: int, seed: int) -> Tensor:
    """Return E[worth(the next belief about the interest) | action] under the exact engine, (*batch, K)."""
    return of_pairs(engine, belief, actions, lambda imagined: imagined.expected(worth, samples, seed), samples)


def imagine(engine: Any, belief: Any, actions: Values, samples: int, seed: int) -> tuple[Values, Tensor]:
    """Return observations (B, S, *shape) by name, and how probable each is, (B, S); see ``Engine.imagine``."""
    imagined = Imagination(engine, belief, torch.arange(len(belief.log_probs)), actions)
    seen, weights = imagined.seen(samples, seed, samples)
    return {name: value.reshape(*value.shape[:2], *engine.shown[name]) for name, value in seen.items()}, weights


def of_pairs(
    engine: Any, belief: Any, actions: Any, answer: Callable[[Imagination], Tensor], samples: int = 1
) -> Tensor:
    """Return what R rows answer, (R,), for every pair of a belief and an action, (*batch, K); some rows at a time."""
    acts = choices(engine, actions)
    many = len(next(iter(acts.values()))) if acts else 1
    count = len(belief.log_probs)
    step = max(1, CHUNK // (max(samples, 1) * torch.Size(engine.layout.sizes).numel()))
    parts = []
    for pairs in torch.arange(count * many).split(step):
        rows, chosen = pairs // many, {name: values[pairs % many] for name, values in acts.items()}
        parts.append(answer(Imagination(engine, belief, rows, chosen)))
    answers = torch.cat(parts).reshape(count, many)
    return answers[0] if belief.batch is None else answers


def uncertainty(logs: Tensor) -> Tensor:
    """Return the entropy of log probabilities (N, n), nats, (N,)."""
    return -(logs.exp() * logs.clamp(min=torch.finfo(logs.dtype).min)).sum(-1)


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


class Imagination:
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

    def before(self) -> Tensor:
        """Return the interest's log probabilities after the action and before anything is seen, (R, n)."""
        return self._interest(self.logs)

    def expected(self, worth: Worth, samples: int, seed: int) -> Tensor:
        """Return the expectation of a function of the interest's log probabilities, over what is seen, (R,).

        Where observations have few outcomes it is a sum over all of them; else an average over imagined ones, drawn
        with the same random numbers for every action, so that differences between actions are much surer than the
        expectations themselves.
        """
        seen, weights = self.seen(samples, seed, FEW_OUTCOMES)
        after = self._posterior(seen)
        # An outcome that cannot happen has no posterior, and no weight.
        normalised = after - self._total(after).clamp(min=-1e30).reshape(*after.shape[:2], *[1] * (after.dim() - 2))
        worths = worth(self._interest(normalised.flatten(0, 1))).reshape(weights.shape)
        return (weights * torch.where(weights > 0, worths, 0.0)).sum(1)

    def seen(self, samples: int, seed: int, few: int) -> tuple[Values, Tensor]:
        """Return observations (R, S, elements) by name and their weights (R, S): all of them where they are few."""
        outcomes = {name: table.outcomes for name, table in self.engine.tabulation.tables.items()}
        counts = [len(values) for values in outcomes.values() if values is not None]
        if len(counts) == len(outcomes) and torch.Size(counts).numel() <= few:
            seen = self._all(outcomes, torch.Size(counts))
            return seen, self._total(self._posterior(seen)).exp()
        return self._drawn(samples, seed), self.logs.new_full((len(self.rows), samples), 1.0 / samples)

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

    def other(self, name: str) -> str | None:
        """Return a hidden variable, other than the interest as it is now, that an observation depends on, if any."""
        names = self.engine.structure.interest
        for axis, size in zip(self.engine.layout.step_axes, self.engine.tabulation.shapes[name], strict=True):
            if size > 1 and (axis.lag or axis.name not in names):
                return f"prev_{axis.name}" if axis.lag else axis.name
        return None

    def _interest(self, logs: Tensor) -> Tensor:
        """The interest's log probabilities now, (N, n), from normalised log weights (N, *mesh)."""
        present = logs.logsumexp(tuple(self.past)) if len(self.past) else logs
        return self.engine.projections.marginal(self.engine.layout.padded(present), self.engine.names(None))[1]
