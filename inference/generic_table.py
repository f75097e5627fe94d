"""Tables of any family that can be scored."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.distributions import base_of, picked, tensors, with_tensors
from apmodels.simulation import seeded
from inference.table import Rows, Table


class GenericTable(Table):
    """Any other family: its own ``log_prob``, on all elements."""

    def __init__(self, law: Any):
        self.law = law

    def append(self, other: Table) -> None:
        """Add the contexts of another table of the same observation."""
        assert isinstance(other, GenericTable)
        parts = [torch.cat(pair) for pair in zip(tensors(self.law), tensors(other.law), strict=True)]
        self.law = with_tensors(self.law, parts, parts[0].shape[:2], 2)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h), (B, H)."""
        base, _ = base_of(picked(self.law, rows, (len(y), self.hypotheses), 2))
        y = y.reshape(len(y), 1, *self.event_shape)
        missing = torch.isnan(y) if y.is_floating_point() else torch.zeros_like(y, dtype=torch.bool)
        if not len(base.event_shape):
            scores = torch.where(missing, 0.0, base.log_prob(torch.where(missing, 1.0, y).to(y.dtype)))
            return scores.reshape(*scores.shape[:2], -1).sum(-1)
        gone = missing.reshape(len(y), -1)
        if not bool((gone.all(-1) == gone.any(-1)).all()):
            raise ValueOutOfRange(f"elements of a {type(base).__name__} cannot be missing one by one")
        scores = base.log_prob(torch.where(missing, 0.0, y).to(y.dtype))
        return torch.where(gone.any(-1, keepdim=True), 0.0, scores.reshape(*scores.shape[:2], -1).sum(-1))

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements); every context draws from the same seed."""
        drawn = []
        for row, hypotheses in zip(rows.tolist(), chosen, strict=True):
            law = picked(self.law, (row, hypotheses), (len(hypotheses),), 2)
            with seeded(seed):
                drawn.append(law.sample().reshape(len(hypotheses), -1))
        return torch.stack(drawn)
