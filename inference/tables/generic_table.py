"""Tables of any family that can be scored."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels import Planted, ValueOutOfRange
from apmodels.distributions import base_of, family, log_prob_of, picked, tensors, unvalidated, with_tensors
from apmodels.simulation import seeded
from inference.tables.table import Misfit, Rows, Table


class GenericTable(Table):
    """Any other family: its own ``log_prob``, on all elements."""

    def __init__(self, law: Any):
        self.law = law

    def append(self, other: Table) -> None:
        """Add the contexts of another table of the same observation."""
        if not isinstance(other, GenericTable):
            raise Misfit
        parts = [torch.cat(pair) for pair in zip(tensors(self.law), tensors(other.law), strict=True)]
        self.law = with_tensors(self.law, parts, parts[0].shape[:2], 2)

    def read(self, y: Tensor, name: str) -> Tensor:
        """Return y; ValueOutOfRange where it is infinite, or no count where counts are seen."""
        y = super().read(y, name)
        base, _ = base_of(self.law)
        base = base.here if isinstance(base, Planted) else base
        if len(base.event_shape) or not base.support.is_discrete:  # type: ignore[union-attr]
            return y
        wrong = ~torch.isnan(y) & ((y < 0) | (y != y.round()))
        if bool(wrong.any()):
            value = y[wrong][0].item()
            raise ValueOutOfRange(f"{name} is {value:g} in some element; it must be a whole number from 0 up")
        return y

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h), (B, H)."""
        law = picked(self.law, rows, (len(y), self.hypotheses), 2)
        y = y.reshape(len(y), 1, *self.event_shape)
        if base_of(law)[0].event_shape and not isinstance(base_of(law)[0], Planted):
            missing = torch.isnan(y).flatten(2)
            if not torch.equal(missing.all(-1), missing.any(-1)):
                raise ValueOutOfRange(f"elements of a {family(law)} cannot be missing one by one")
        with unvalidated():
            return log_prob_of(law, y.expand(len(y), self.hypotheses, *self.event_shape))

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements); every context draws from the same seed."""
        drawn = []
        for row, hypotheses in zip(rows.tolist(), chosen, strict=True):
            law = picked(self.law, (row, hypotheses), (len(hypotheses),), 2)
            with seeded(seed):
                drawn.append(law.sample().reshape(len(hypotheses), -1))
        return torch.stack(drawn)
