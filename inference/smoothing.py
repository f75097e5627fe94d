"""What is believed of every step once the whole record is known (Rauch, Tung and Striebel 1965)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from inference.gaussian import Gaussian
from inference.gaussian_block import GaussianBlock
from inference.worlds import BankBelief


def smoothed(engine: Any, start: BankBelief, beliefs: list[BankBelief], actions: list[dict]) -> list[BankBelief]:
    """Return beliefs about each step given the whole record; ``actions`` (rows, *shape) by name, for each step."""
    if engine.plan.fields or engine.plan.finite:
        names = [*(name for group in engine.plan.fields for name in group), *engine.plan.finite]
        raise ValueOutOfRange(f"{', '.join(names)} cannot be smoothed: only what is jointly Gaussian or static can")
    last = beliefs[-1]
    found = [last]
    for before, action in zip(reversed([start, *beliefs[:-1]]), reversed(actions), strict=True):
        step, _ = engine.step_of(before, action)
        engine.move(step)
        gaussian = []
        for i, block in enumerate(engine.gaussians):
            gaussian.append(_back(block, before, i, step.frame, found[-1].gaussian[i]))
        found.append(replace(before, gaussian=tuple(gaussian), log_weights=last.log_weights, counts=last.counts))
    return found[:-1][::-1]


def _back(block: GaussianBlock, before: BankBelief, index: int, frame: Any, later: Gaussian) -> Gaussian:
    """What is believed of the end of a step, given what is known in the end of the next one."""
    stage = block.steps[""]
    whole = before.gaussian[index]
    entered = block.enter(whole, before.time)
    matrix, offset, noise = stage.moves(frame)
    kept = block._places(stage.end, block.last)
    matrix, offset, noise = matrix[..., kept, :], offset[..., kept], noise[..., kept, :][..., kept]
    if before.time and block.first != block.last:
        matrix = matrix @ _picking(block, block.last, block.first)
    else:
        whole = entered
    return backward(whole, matrix, offset, noise, later)


def _picking(block: GaussianBlock, layout: list, wanted: list) -> Tensor:
    at = block._places(layout, wanted)
    return torch.eye(sum(block._width(layout)), dtype=torch.float64)[at]


def backward(before: Gaussian, matrix: Tensor, offset: Tensor, noise: Tensor, later: Gaussian) -> Gaussian:
    """Return x given what is known of ``matrix`` x + ``offset`` + e in the end; covariances may be singular."""
    covariance = matrix @ before.covariance @ matrix.mT + noise
    gain = before.covariance @ matrix.mT @ torch.linalg.pinv(0.5 * (covariance + covariance.mT), hermitian=True)
    mean = (matrix @ before.mean.double()[..., None])[..., 0] + offset
    change = (gain @ (later.mean.double() - mean)[..., None])[..., 0]
    spread = before.covariance + gain @ (later.covariance - covariance) @ gain.mT
    return Gaussian(before.mean + change.to(before.mean.dtype), 0.5 * (spread + spread.mT))
