"""Beliefs as rows: choosing some, and putting batches of them under each other, whatever an engine keeps in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from inference.beliefs import Belief


def rows(belief: Any) -> Any:
    """Return a belief as a batch: a single one is a batch of one."""
    if belief.batch is not None:
        return belief
    return replace(belief, batch=1, log_evidence=belief.log_evidence[None])


def taken(belief: Any, index: Tensor) -> Any:
    """Return the beliefs (n,) of a batch at ``index`` (n,)."""
    count = belief.batch

    def take(value: Tensor) -> Tensor:
        return value[index] if _held(value, count) == count else value

    return replace(mapped(take, belief), batch=len(index))


def stacked(beliefs: Sequence[Any]) -> Any:
    """Return batches of beliefs as one batch; their steps are the last one's."""
    total, last = sum(belief.batch for belief in beliefs), beliefs[-1]
    counts = [belief.batch for belief in beliefs]

    def join(*values: Tensor) -> Tensor:
        shape = torch.broadcast_shapes(*(value.shape[1:] for value in values))
        wide = [value.expand(count, *shape) for value, count in zip(values, counts, strict=True)]
        return torch.cat(wide)

    return replace(mapped(join, *beliefs), batch=total, time=last.time)


def alike(one: Any, other: Any, tolerance: float = 1e-4) -> Tensor:
    """Tell which beliefs of two batches of the same size are equal but for rounding, (n,)."""
    same = torch.ones(one.batch, dtype=torch.bool)

    def compare(first: Tensor, second: Tensor) -> Tensor:
        near = torch.isclose(first, second.to(first.dtype), rtol=tolerance, atol=tolerance, equal_nan=True)
        same.logical_and_(near.flatten(1).all(1) if near.dim() > 1 else near)
        return first

    mapped(compare, one, other)
    return same


def mapped(function: Callable[..., Tensor], first: Any, *others: Any) -> Any:
    """Return a value with every tensor in it replaced by a function of it, and of those at the same place in others."""
    if isinstance(first, Tensor):
        return function(first, *others)
    if isinstance(first, dict):
        return {key: mapped(function, value, *(other[key] for other in others)) for key, value in first.items()}
    if isinstance(first, tuple | list):
        parts = [mapped(function, *values) for values in zip(first, *others, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    if is_dataclass(first) and isinstance(first, Belief):
        parts = {f.name: mapped(function, *(getattr(b, f.name) for b in (first, *others))) for f in fields(first)}
        return replace(first, **parts)
    return first


def _held(value: Tensor, count: int) -> int:
    """How many rows a tensor has: all of them, or one that they share."""
    if value.dim() and value.shape[0] in (1, count):
        return value.shape[0]
    raise ValueOutOfRange(f"a batch of {count} beliefs holds a tensor of shape {tuple(value.shape)}, which has no rows")
