"""What is believed of every step once the whole record is known (Rauch, Tung and Striebel 1965)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from inference.worlds.frame import Frame
from inference.worlds.gaussian import Gaussian, condition, move
from inference.worlds.gaussian_block import GaussianBlock
from inference.worlds.step import BankBelief, flat


def smoothed(engine: Any, start: BankBelief, beliefs: list[BankBelief], actions: list, seen: list) -> list[BankBelief]:
    """Return beliefs about each step given the whole record.

    ``actions`` (rows, *shape) and observations ``seen`` (rows, 1, *shape) are dicts by name, for each step.
    """
    if engine.plan.fields or engine.plan.finite:
        names = [*(name for group in engine.plan.fields for name in group), *engine.plan.finite]
        raise ValueOutOfRange(f"{', '.join(names)} cannot be smoothed: only what is jointly Gaussian or static can")
    last = beliefs[-1]
    found = [last]
    steps = zip([start, *beliefs[:-1]], actions, seen, strict=True)
    for before, action, see in reversed(list(steps)):
        step, _ = engine.step_of(before, action)
        engine.move(step)
        step.frame.values |= {(name, 0): value for name, value in see.items()}
        gaussian = []
        for i, block in enumerate(engine.gaussians):
            gaussian.append(_back(block, before, i, step.frame, found[-1].gaussian[i]))
        found.append(replace(before, gaussian=tuple(gaussian), log_weights=last.log_weights, counts=last.counts))
    return found[:-1][::-1]


def _back(block: GaussianBlock, before: BankBelief, index: int, frame: Frame, later: Gaussian) -> Gaussian:
    """What is believed of the end of a step, given what is known in the end of the next one."""
    stage = block.steps[""]
    whole = before.gaussian[index]
    matrix, offset, noise = stage.moves(frame)
    if before.time and block.first != block.last:
        matrix = matrix @ _picking(block, block.last, block.first)
    both = _beside(whole, matrix, offset, noise)
    if block.seen:
        # What is seen may tell of both ends of the step.
        view, shift, spread = block.view(frame)
        view = torch.cat([view.new_zeros(*view.shape[:-1], whole.mean.shape[-1]), view], -1)
        value = torch.cat([flat(frame.values[name, 0]) for name in block.seen], -1)
        both, _ = condition(both, view, shift, spread, value)
    size = whole.mean.shape[-1]
    kept = torch.cat([torch.arange(size), size + block._places(stage.end, block.last)])
    return backward(Gaussian(both.mean[..., kept], both.covariance[..., kept, :][..., kept]), size, later)


def _beside(belief: Gaussian, matrix: Tensor, offset: Tensor, noise: Tensor) -> Gaussian:
    """What is believed jointly of x and of ``matrix`` x + ``offset`` + e."""
    size, more = belief.mean.shape[-1], offset.shape[-1]
    eye = torch.eye(size, dtype=matrix.dtype).expand(*matrix.shape[:-2], size, size)
    pad = torch.nn.functional.pad
    wide = pad(noise, (size, 0, size, 0)).expand(*noise.shape[:-2], size + more, size + more)
    return move(belief, torch.cat([eye, matrix], -2), pad(offset, (size, 0)), wide)


def _picking(block: GaussianBlock, layout: list, wanted: list) -> Tensor:
    at = block._places(layout, wanted)
    return torch.eye(sum(block._width(layout)), dtype=torch.float64)[at]


def backward(both: Gaussian, size: int, later: Gaussian) -> Gaussian:
    """Return the first ``size`` numbers of a joint belief, once the others are known better; they may be singular."""
    mean, covariance = both.mean.double(), both.covariance
    first, cross, second = covariance[..., :size, :size], covariance[..., :size, size:], covariance[..., size:, size:]
    gain = cross @ torch.linalg.pinv(second, hermitian=True)
    change = (gain @ (later.mean.double() - mean[..., size:])[..., None])[..., 0]
    spread = first + gain @ (later.covariance - second) @ gain.mT
    return Gaussian(both.mean[..., :size] + change.to(both.mean.dtype), 0.5 * (spread + spread.mT))
