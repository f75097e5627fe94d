"""How well a target is seen away from the fixation: the foveal-peripheral operating characteristic, d'(e)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Acuity(Protocol):
    """Any function from eccentricity to discriminability."""

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        ...


@dataclass(frozen=True)
class Calibrated:
    """d'(e) = peak · exp(-(e / width)^steepness), e in cells.

    The thesis's own curve is lost with its figure; this one was calibrated to the fixations that its controllers
    need (thesis ch. 5, Table 5.1), and is not Najemnik and Geisler's.
    """

    peak: float = 1.9
    width: float = 4.0
    steepness: float = 3.0

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        return self.peak * torch.exp(-((eccentricity / self.width) ** self.steepness))
