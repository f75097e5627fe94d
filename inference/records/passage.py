"""A Gaussian group led along a whole record: what does not depend on what is seen first, then means in few products."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from inference.records.record import alone
from inference.records.riccati import gains
from inference.worlds.frame import Memory
from inference.worlds.gaussian import Gaussian
from inference.worlds.gaussian_block import GaussianBlock

# Beliefs about more numbers than these gain nothing: their products take longer than calling for them.
WIDEST = 32

Parts = tuple[Tensor, ...]


@dataclass(frozen=True)
class Passage:
    """A group after each of some steps, and how well it did, (steps, rows, worlds or 1).

    Means are (steps, groups, n, columns) and covariances (steps, groups, n, n): where a batch has its covariances in
    common, groups are worlds and columns its rows; else groups are rows and worlds.
    """

    means: Tensor
    covariances: Tensor
    score: Tensor
    rows: int
    common: bool

    def at(self, step: int) -> Gaussian:
        """Return the belief after a step, (rows, worlds or 1, n)."""
        mean, covariance = self.means[step], self.covariances[step]
        if self.common:
            return Gaussian(mean.permute(2, 0, 1), covariance[None])
        lead = (self.rows, mean.shape[0] // self.rows)
        return Gaussian(mean.reshape(*lead, -1), covariance.unflatten(0, lead))


def passage(
    block: GaussianBlock, belief: Gaussian, time: int, parts: Callable[[Memory], Parts], value: Tensor, rows: int
) -> Passage | None:
    """Lead a group along, or return None where that must be done step by step.

    Args:
        block: the group.
        belief: before the first step, at ``time``.
        parts: returns a memory's tables, each (steps or 1, rows or 1, worlds or 1, ...).
        value: what is seen, (steps, rows or 1, m).
        rows: of the batch.
    """
    stage = block.steps[""]
    belief = block.enter(belief, time)
    moves, views = parts(stage.moves), parts(stage.views)
    mask = missing(value)
    # The rows and worlds in which anything differs but what is seen.
    mean = _narrow(belief.mean)
    leads = [part.shape[1:3] for part in (*moves, *views)] + [belief.covariance.shape[:2], (1, mean.shape[1])]
    lead = torch.broadcast_shapes(*leads, (1 if mask is None else mask.shape[1], 1))
    matrix, offset, noise, view, base, blur = (_grouped(part, lead) for part in (*moves, *views))
    offset, base = offset[..., None], base[..., None]
    count: Tensor | int = value.shape[-1]
    if mask is not None:
        value = value.nan_to_num(0.0)
        here = _grouped((~mask).to(noise.dtype)[:, :, None], lead)[..., None]
        # What is missing is seen through nothing, with a noise of its own: it says nothing.
        view, base, blur = view * here, base * here, blur * here * here.mT + torch.diag_embed(1 - here[..., 0])
        count = here.sum((-2, -1))
    kept, last = (block._places(stage.end, wanted) for wanted in (block.first, block.last))
    start = belief.covariance.expand(*lead, *belief.covariance.shape[-2:]).flatten(0, 1)
    matrices, noises, seen_by, blurs = (p.expand(len(value), *p.shape[1:]) for p in (matrix, noise, view, blur))
    found = gains(start, matrices, noises, seen_by, blurs, kept)
    if found is None:
        return None
    common = lead[0] == 1
    first = mean.expand(rows, lead[1], -1)
    first = first.permute(1, 2, 0) if common else first.flatten(0, 1)[..., None]
    dtype = mean.dtype
    seen = _plus(_columns(value, lead, rows), -base)
    rest = torch.eye(view.shape[-1], dtype=view.dtype) - found.gain @ view
    lead_on, shift, gain = (rest @ matrix).to(dtype), rest @ offset, found.gain.to(dtype)
    means = _means(first, lead_on[..., kept, :], gain[..., kept, :], seen, shift[..., kept, :])
    past, after = means[:-1], means[1:]
    if block.first != block.last:
        after = _plus(lead_on[..., last, :] @ past + gain[..., last, :] @ seen, shift[..., last, :])
    surprise = _plus(((-view @ matrix).to(dtype) @ past).add_(seen), -view @ offset)
    score = _score(surprise, found.root, count)
    covariance = found.covariance
    if block.last != stage.end:
        covariance = covariance[..., last, :][..., last]
    score = score.mT if common else score.unflatten(1, lead)[..., 0]
    return Passage(after, covariance, score, rows, common)


def missing(value: Tensor) -> Tensor | None:
    """Which elements (steps, rows or 1, m) are missing, one row where that is alike in all; None where none is."""
    if math.isfinite(float(value.detach().sum())):
        return None
    gone = torch.isnan(value)
    return gone[:, :1] if bool((gone == gone[:, :1]).all()) else gone


def _means(first: Tensor, lead: Tensor, gain: Tensor, seen: Tensor, shift: Tensor) -> Tensor:
    """x_t = lead_t x_{t-1} + gain_t seen_t + shift_t, (1 + steps, groups, n, columns), from the first one on."""
    if torch.is_grad_enabled() and any(part.requires_grad for part in (first, lead, gain, seen, shift)):
        more = _plus(gain @ seen, shift)
        x = first
        return torch.stack([x, *(x := torch.baddbmm(here, a, x) for here, a in zip(more, lead, strict=True))])
    whole = first.new_empty(1 + len(gain), *first.shape)
    whole[0] = first
    torch.matmul(gain, seen, out=whole[1:])
    if bool(shift.any()):
        whole[1:] += shift
    single = len(first) == 1
    places, leads = (part.squeeze(1).unbind(0) if single else part.unbind(0) for part in (whole, lead))
    with alone(first.numel()):
        for t, matrix in enumerate(leads):
            if single:
                places[t + 1].addmm_(matrix, places[t])
            else:
                places[t + 1].baddbmm_(matrix, places[t])
    return whole


def _score(surprise: Tensor, root: Tensor, count: Tensor | int) -> Tensor:
    """Log p of what surprises (steps, groups, m, columns), (steps, groups, columns), nats."""
    unit = torch.eye(root.shape[-1], dtype=root.dtype).expand_as(root)
    white = torch.linalg.solve_triangular(root, unit, upper=False).to(surprise.dtype) @ surprise
    scale = root.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * math.log(2 * math.pi) * count
    return torch.add(-scale[..., None], white.square_().sum(-2), alpha=-0.5)


def _plus(value: Tensor, more: Tensor) -> Tensor:
    """value + more, where the latter is often nothing."""
    return value if not more.requires_grad and not bool(more.any()) else value + more.to(value.dtype)


def _grouped(part: Tensor, lead: tuple[int, ...]) -> Tensor:
    """(steps or 1, rows or 1, worlds or 1, ...) as (steps or 1, groups, ...)."""
    return part.expand(part.shape[0], *lead, *part.shape[3:]).flatten(1, 2)


def _columns(value: Tensor, lead: tuple[int, ...], rows: int) -> Tensor:
    """What is seen, (steps, rows or 1, m), as (steps, 1 or groups, m, columns)."""
    if lead[0] == 1:
        return value.expand(-1, rows, -1).mT.contiguous()[:, None]
    return _grouped(value[:, :, None], lead)[..., None]


def _narrow(mean: Tensor) -> Tensor:
    """Keep one world of what is the same in all of them."""
    return mean[:, :1] if mean.shape[1] > 1 and mean.stride(1) == 0 else mean
