"""Covariances of a Kalman filter for all steps of a record at once.

They do not depend on what is seen, but on which elements of it are. How a covariance is led through some steps is
three matrices, and those of two spans of steps make those of both, so that all spans from the first step on are found
in a number of products that grows with the logarithm of the number of steps (Särkkä and García-Fernández 2021). One
step of Joseph's form, from each of them, then gives the gains, and tells whether the spans were accurate.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# By how much a covariance may differ from what one accurate step makes of the one before, in deviations.
CLOSE = 1e-9


class Gains(NamedTuple):
    """Of each step: what is known after it (T, *lead, k, k), the gain (..., k, m), and the root of the spread seen."""

    covariance: Tensor
    gain: Tensor
    root: Tensor


def gains(start: Tensor, matrix: Tensor, noise: Tensor, view: Tensor, blur: Tensor, kept: Tensor) -> Gains | None:
    """Return covariances and gains along a record, or None where they are not accurate like this.

    Args:
        start: covariance (*lead, n, n) of what is carried from step to step, before the first one.
        matrix: (T, *lead, k, n), how a step's k numbers come from what is carried.
        noise: (T, *lead, k, k).
        view: (T, *lead, m, k), how what is seen comes from those.
        blur: (T, *lead, m, m).
        kept: which n of the k are carried on.
    """
    carried = start[None]
    if len(matrix) > 1 and start.shape[-1]:
        spans = _spans(start, matrix, noise, view, blur, kept)
        if spans is None:
            return None
        carried = torch.cat([carried.expand_as(spans[:1]), spans[:-1]])
    ahead = _symmetric(matrix @ carried @ matrix.mT + noise)
    cross = ahead @ view.mT
    root, failed = torch.linalg.cholesky_ex(_symmetric(view @ cross + blur))
    gain = torch.cholesky_solve(cross.mT, root).mT
    rest = torch.eye(view.shape[-1], dtype=view.dtype) - gain @ view
    after = _symmetric(rest @ ahead @ rest.mT + gain @ blur @ gain.mT)
    good = (failed == 0).all()
    if len(matrix) > 1 and start.shape[-1]:
        good = good & _alike(after[..., kept, :][..., kept], spans)
    return Gains(after, gain, root) if bool(good) else None


def _spans(start: Tensor, matrix: Tensor, noise: Tensor, view: Tensor, blur: Tensor, kept: Tensor) -> Tensor | None:
    """What is carried after each step, (T, *lead, n, n)."""
    steps, alike = len(matrix), all(part.stride(0) == 0 for part in (matrix, noise, view, blur))
    if alike:
        matrix, noise, view, blur = (part[:1] for part in (matrix, noise, view, blur))
    cross = noise @ view.mT
    root, failed = torch.linalg.cholesky_ex(_symmetric(view @ cross + blur))
    if bool((failed != 0).any()):
        return None
    gain = torch.cholesky_solve(cross.mT, root).mT[..., kept, :]
    seen = view @ matrix
    white = torch.linalg.solve_triangular(root, seen, upper=False)
    lead = matrix[..., kept, :] - gain @ seen
    spread = _symmetric(noise[..., kept, :][..., kept] - gain @ cross[..., kept, :].mT)
    told = white.mT @ white
    first = torch.zeros_like(start), start, torch.zeros_like(start)
    begun = _joined(first, (lead[0], spread[0], told[0]))
    if alike:
        return _doubled(begun, (lead, spread, told), steps)
    parts = [
        torch.cat([one.expand_as(rest[:1]), rest[1:]]) for one, rest in zip(begun, (lead, spread, told), strict=True)
    ]
    return _scanned(parts[0], parts[1], parts[2])[1]


def _doubled(begun: Span, step: Span, steps: int) -> Tensor:
    """What is carried after each of some steps that are all alike but the first one."""
    spans = begun[0][None], begun[1][None], begun[2][None]
    while len(spans[1]) < steps:
        # All the spans so far, and as many steps as there are of them, with that many more.
        more = _joined((_with(spans[0], step[0]), _with(spans[1], step[1]), _with(spans[2], step[2])), step)
        spans = (
            torch.cat([spans[0], more[0][:-1]]),
            torch.cat([spans[1], more[1][:-1]]),
            torch.cat([spans[2], more[2][:-1]]),
        )
        step = more[0][-1:], more[1][-1:], more[2][-1:]
    return spans[1][:steps]


def _with(spans: Tensor, step: Tensor) -> Tensor:
    return torch.cat([spans, step.expand_as(spans[:1])])


Span = tuple[Tensor, Tensor, Tensor]


def _scanned(lead: Tensor, spread: Tensor, told: Tensor) -> Span:
    """The spans from the first step up to each, of spans of one step each."""
    steps = len(lead)
    if steps == 1:
        return lead, spread, told
    parts = lead, spread, told
    even = [part[0 : steps - steps % 2 : 2] for part in parts]
    odd = [part[1::2] for part in parts]
    pairs = _scanned(*_joined((even[0], even[1], even[2]), (odd[0], odd[1], odd[2])))
    more = (steps - 1) // 2
    ends = _joined((pairs[0][:more], pairs[1][:more], pairs[2][:more]), (lead[2::2], spread[2::2], told[2::2]))
    woven = []
    for part, two, one in zip(parts, pairs, ends, strict=True):
        whole = torch.empty_like(part)
        whole[0], whole[1::2], whole[2::2] = part[0], two, one
        woven.append(whole)
    return woven[0], woven[1], woven[2]


def _joined(early: Span, late: Span) -> Span:
    """One span of two."""
    size = early[0].shape[-1]
    both = early[1] @ late[2]
    both.diagonal(dim1=-2, dim2=-1).add_(1.0)
    sides = torch.cat(torch.broadcast_tensors(early[0], early[1]), -1)
    lead, spread = torch.linalg.solve_ex(both, sides)[0].split(size, -1)
    told = early[0].mT @ late[2] @ lead + early[2]
    return late[0] @ lead, late[0] @ spread @ late[0].mT + late[1], told


def _alike(one: Tensor, other: Tensor) -> Tensor:
    deviation = one.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    floor = 1e-7 * deviation.amax(-1, keepdim=True)
    scale = torch.maximum(deviation, floor)
    return ((one - other).abs() <= CLOSE * scale[..., :, None] * scale[..., None, :]).all()


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)
