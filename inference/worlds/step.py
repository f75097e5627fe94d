"""What a bank holds: a belief after a step, and a step while it is being made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from apmodels.simulation import Values
from inference.beliefs import Belief
from inference.worlds.frame import Frame
from inference.worlds.gaussian import Gaussian


@dataclass(frozen=True)
class BankBelief(Belief):
    """Worlds with log weights (rows, worlds), normalised; and what is believed in each of them.

    ``values`` are the worlds' own variables by name, (rows or 1, worlds, *shape); ``gaussian``, ``fields`` and
    ``counts`` belong to the plan's groups, in order; ``finite`` are log probabilities (rows, worlds, *sizes).
    """

    log_weights: Tensor = field(repr=False)
    values: Values = field(repr=False)
    gaussian: tuple[Gaussian, ...] = field(repr=False)
    fields: tuple[dict, ...] = field(repr=False)
    counts: tuple[Tensor, ...] = field(repr=False)
    finite: Tensor | None = field(repr=False)
    past: Any = field(repr=False, default=None)


@dataclass
class Step:
    """A step while it is being made: the context, what is believed so far, and how well the worlds did."""

    frame: Frame
    lead: tuple[int, int]
    gaussian: list[Gaussian]
    fields: list[dict]
    counts: list[Tensor]
    finite: Tensor | None
    score: Tensor
    # log p of the values that worlds drew for themselves; asked for where a path is scored or the best is chosen.
    prior: Tensor
    # The worlds' statics, where they are given instead of drawn.
    given: Values | None = None
    # What is seen after the step, where what is drawn may depend on it.
    seen: Values | None = None


def drawn(belief: Gaussian, lead: tuple[int, int]) -> Tensor:
    """Draw from a Gaussian whose covariance may be singular."""
    values, vectors = torch.linalg.eigh(belief.covariance)
    root = vectors * values.clamp(min=0).sqrt()[..., None, :]
    noise = torch.randn(*lead, belief.mean.shape[-1], dtype=root.dtype)
    return belief.mean + (root @ noise[..., None])[..., 0].to(belief.mean.dtype)


def even(log_weights: Tensor, count: int, start: Tensor | None = None) -> Tensor:
    """Choose worlds at even steps of their weights (systematic sampling), (rows, count)."""
    if start is None:
        start = torch.rand(len(log_weights), 1, dtype=log_weights.dtype)
    cumulative = log_weights.exp().cumsum(1, dtype=torch.float64)
    # How many of the steps lie below the end of each world's share.
    below = (cumulative / cumulative[:, -1:] * count - start).ceil().clamp(0, count).long()
    times = torch.diff(below, dim=1, prepend=below.new_zeros(len(below), 1))
    chosen = torch.repeat_interleave(times.flatten(), output_size=len(below) * count).reshape(-1, count)
    return chosen - log_weights.shape[1] * torch.arange(len(below))[:, None]


def pick(value: Tensor, index: Tensor) -> Tensor:
    """Return the values (rows or 1, worlds or 1, ...) of chosen worlds (rows, count)."""
    if value.shape[1] == 1:
        return value
    wide = value.expand(len(index), *value.shape[1:])
    at = index.reshape(*index.shape, *[1] * (value.dim() - 2)).expand(*index.shape, *value.shape[2:])
    return wide.gather(1, at)


def flat(value: Tensor) -> Tensor:
    """Return values (rows, worlds, *shape) as (rows, worlds, numbers)."""
    return value.reshape(*value.shape[:2], -1)


def pick_rows(value: Tensor, index: Tensor) -> Tensor:
    """Return the values (rows or 1, ...) of chosen rows."""
    return value[index] if value.shape[0] > 1 else value


Take = Callable[[Tensor], Tensor]


def taken(step: Step, take: Take, lead: tuple[int, int]) -> Step:
    """Return a step of which every tensor has been taken from."""
    return Step(
        Frame({key: take(value) for key, value in step.frame.values.items()}),
        lead,
        [Gaussian(take(g.mean), take(g.covariance)) for g in step.gaussian],
        [{name: (take(m), take(v)) for name, (m, v) in images.items()} for images in step.fields],
        [take(counts) for counts in step.counts],
        None if step.finite is None else take(step.finite),
        take(step.score),
        take(step.prior),
    )


def take_rows(step: Step, index: Tensor) -> Step:
    """Return a step of other rows, (len(index), worlds)."""
    return taken(step, lambda value: pick_rows(value, index), (len(index), step.lead[1]))


def take_worlds(step: Step, index: Tensor) -> Step:
    """Return a step of other worlds, (rows, count)."""
    return taken(step, lambda value: pick(value, index), (step.lead[0], index.shape[1]))
