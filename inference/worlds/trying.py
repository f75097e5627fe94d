"""Trying every value of what has few, where one world is to be kept and the best is wanted."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from apmodels.structure import Structure
from inference.worlds.step import Step


def combinations(structure: Structure, sampled: tuple[str, ...], most: int) -> dict[str, Tensor]:
    """Return, for each sampled state with few values, the value of each world, (worlds, *shape).

    Worlds are all combinations; there are none if they would be more than ``most``.
    """
    nodes = structure.nodes
    names = [name for name in sampled if nodes[name].role == "state" and nodes[name].values is not None]
    values: list[Any] = [nodes[name].values for name in names]
    if not names or math.prod(map(len, values)) > most:
        return {}
    picks = torch.cartesian_prod(*(torch.arange(len(value)) for value in values)).reshape(-1, len(names))
    return {name: value[picks[:, i]] for i, (name, value) in enumerate(zip(names, values, strict=True))}


def give(bank: Any, step: Step, name: str, values: Tensor) -> None:
    """Give each world a value (worlds, *shape) of its own, as if all had been equally likely to be drawn."""
    values = values.to(bank.dtype) if values.is_floating_point() else values
    score = step.frame.score(bank.laws, name, values[None], step.lead)
    step.score = step.score + score + math.log(len(bank.structure.nodes[name].values))
    step.frame.values[name, 0] = values[None].expand(step.lead[0], *values.shape)
