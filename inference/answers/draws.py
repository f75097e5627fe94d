"""Drawing worlds, and what is integrated in them, from a belief that a bank holds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels.simulation import Values, seeded
from inference.worlds.frame import Frame
from inference.worlds.step import drawn, even, pick

# How many draws stand for the law of a function of continuous variables.
DRAWS = 4096


def draw_values(engine: Any, belief: Any, count: int, seed: int = 0) -> Values:
    """Draw every hidden variable jointly, name -> (rows or 1, count or 1, *shape)."""
    with seeded(seed):
        index = even(belief.log_weights, count)
        lead = (len(index), count)
        values = {name: pick(value, index) for name, value in belief.values.items()}
        for block, gaussian in zip(engine.gaussians, belief.gaussian, strict=True):
            layout = block.layout(belief.time)
            chosen = type(gaussian)(pick(gaussian.mean, index), pick(gaussian.covariance, index))
            vector = drawn(chosen, lead)
            for (name, _), width in zip(layout, block._width(layout), strict=True):
                part, vector = vector[..., :width], vector[..., width:]
                values[name] = part.reshape(*lead, *engine.structure.nodes[name].shape)
        for images in belief.fields:
            for name, (mean, variance) in images.items():
                mean, spread = pick(mean, index), pick(variance, index).sqrt()
                values[name] = mean + spread * torch.randn(*lead, *mean.shape[2:], dtype=mean.dtype)
        for block, counts in zip(engine.tallies, belief.counts, strict=True):
            found = block.sample(pick(counts, index), lead)
            values |= {name: value.to(engine.dtype) for name, value in found.items()}
        if belief.finite is not None:
            values |= _summed(engine, pick(belief.finite, index), lead)
    return values


def _summed(engine: Any, logs: Tensor, lead: tuple[int, int]) -> Values:
    block = engine.summed
    flat = logs.expand(*lead, *logs.shape[2:]).flatten(2)
    cell = (flat - torch.log(-torch.log(torch.rand(flat.shape, dtype=flat.dtype)))).argmax(-1)
    values = {}
    for axis, at in zip(block.axes, torch.unravel_index(cell, block.sizes), strict=True):
        values[axis.name] = axis.values[at]
    return values


def function_draws(engine: Any, belief: Any, count: int = DRAWS, seed: int = 0) -> Tensor:
    """Draw the interest, where it is a function of variables, (rows, count, *shape)."""
    values = draw_values(engine, belief, count, seed)
    return interest_of(engine, values, (len(belief.log_weights), count))


def interest_of(engine: Any, values: Values, lead: tuple[int, int]) -> Tensor:
    """Return the interest, a function of variables, at values (rows or 1, n or 1, *shape)."""
    frame = Frame({(name, 0): value for name, value in values.items()})
    law = frame.in_all(engine.laws, "interest", lead)
    assert isinstance(law, Tensor)
    return law
