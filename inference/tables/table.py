"""What a table of an observation's law answers, whatever its family."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from apmodels import ValueOutOfRange

# Up to so many outcomes an expectation over the observation is a sum.
FEW_OUTCOMES = 1024
# Which contexts a batch is in: (B,), or a slice of one.
Rows = Tensor | slice


class Misfit(Exception):
    """A later context needs another kind of table than the first ones did."""


class Table:
    """K contexts × H hypotheses of one observation. Subclasses are families."""

    # Tensors whose first dimension is the context.
    stacked: tuple[str, ...] = ()
    event_shape: torch.Size
    hypotheses: int
    # Sparse tables as ``ratio`` reads them; see ``settle``.
    flat_index: Tensor
    flat_table: Tensor
    flat_slope: Tensor
    flat_middle: Tensor
    # Hypotheses show in one element each, in order.
    in_order: bool = False

    def append(self, other: Table) -> None:
        """Add the contexts of another table of the same observation; Misfit if they are not of one kind."""
        if type(self) is not type(other) or self.stacked != other.stacked:
            raise Misfit
        for name in self.stacked:
            old, new = getattr(self, name), getattr(other, name)
            if old.shape[1:] != new.shape[1:]:
                raise Misfit
            same = alike(old) and alike(new) and torch.equal(old[:1], new[:1])
            both = old[:1].expand(len(old) + len(new), *old.shape[1:]) if same else torch.cat([old, new])
            setattr(self, name, both)

    def read(self, y: Tensor, name: str) -> Tensor:
        """Return y (B, elements) as the other methods want it; ValueOutOfRange where it cannot have been seen.

        Elements that are NaN are missing.
        """
        # One sum finds both the infinite and the missing.
        if not math.isfinite(float(y.sum())) and bool(torch.isinf(y).any()):
            raise ValueOutOfRange(f"{name} is infinite in some element; observe a number, or NaN where it is missing")
        return y

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H), for y (B, elements) in contexts rows (B,)."""
        raise NotImplementedError

    def base(self, rows: Rows, y: Tensor) -> Tensor | float:
        """Return log p(y | baseline), (B,)."""
        return 0.0

    def score(self, rows: Rows, y: Tensor) -> tuple[Tensor, Tensor | float]:
        """Return ``ratio`` and ``base``."""
        return self.ratio(rows, y), self.base(rows, y)

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements) under hypotheses chosen (R, S) in contexts rows (R,), with common random numbers."""
        raise NotImplementedError

    def divergence(self, rows: Tensor) -> Tensor | None:
        """Return KL(p(y | h) | p(y | baseline)) in contexts rows (R,), nats, (R, H); None without a common baseline."""
        return None

    def own(self, rows: Tensor) -> Tensor | None:
        """Return d' (R, H) in contexts rows (R,) where each hypothesis shows in Normal elements that no other does."""
        return None

    @property
    def outcomes(self) -> Tensor | None:
        """All values of the whole observation (outcomes, elements), where they are few."""
        return None

    def settle(self) -> None:
        """Lay out sparse tables with hypotheses and their elements in one dimension, as ``ratio`` reads them."""
        if getattr(self, "index", None) is not None:
            for name in ("index", "slope", "middle", "table"):
                if hasattr(self, name):
                    setattr(self, f"flat_{name}", getattr(self, name).flatten(1, 2))
            first = self.flat_index[0]
            self.in_order = alike(self.flat_index) and torch.equal(first, torch.arange(self.event_shape.numel()))

    def shown(self, rows: Rows, y: Tensor) -> Tensor:
        """Return the elements of y (B, elements) in which hypotheses show, (B, H * n)."""
        if self.in_order:
            return y
        return y.gather(1, of_rows(self.flat_index, rows).expand(len(y), -1))


def alike(values: Tensor) -> bool:
    """Whether values (K, ...) are one and the same in all contexts, and kept once."""
    return len(values) == 1 or values.stride(0) == 0


def of_rows(values: Tensor, rows: Rows) -> Tensor:
    """Return values (K, ...) of contexts, (B, ...); (1, ...), of which nothing is copied, where they are all alike."""
    return values[:1] if alike(values) else values[rows]


def summed(scores: Tensor, hypotheses: int) -> Tensor:
    """Scores (B, H * n) summed to (B, H)."""
    if scores.shape[1] == hypotheses:
        return scores
    return scores.reshape(len(scores), hypotheses, -1).sum(-1)


def generator(seed: int) -> torch.Generator:
    """Return a generator of its own."""
    return torch.Generator().manual_seed(seed)
