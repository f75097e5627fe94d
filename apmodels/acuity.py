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


@dataclass(frozen=True)
class Exponential:
    """d'(e) = peak · exp(-e / width), e in cells: sharper than a human eye's, and longer (thesis Fig. 5.9b)."""

    peak: float = 3.0
    width: float = 1.5

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        return self.peak * torch.exp(-eccentricity / self.width)


@dataclass(frozen=True)
class Camera:
    """d'(e) = peak within a radius, in cells, and 0 beyond: a sensor that is alike everywhere (thesis Fig. 5.9c)."""

    peak: float = 1.0
    radius: float = 3.0

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        return self.peak * (eccentricity <= self.radius).to(torch.get_default_dtype())


@dataclass(frozen=True)
class Human:
    """d'(e) = 4.09 · exp(-(e / 7.9)^1.8), e in degrees: the mean of four observers (Zhang and Geisler).

    Attributes:
        cells_per_degree: how many cells of the grid a degree of the visual field has.
    """

    cells_per_degree: float = 1.0
    peak: float = 4.09
    width: float = 7.9
    steepness: float = 1.8

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        degrees = eccentricity / self.cells_per_degree
        return self.peak * torch.exp(-((degrees / self.width) ** self.steepness))


@dataclass(frozen=True)
class HumanContrast:
    """d' of a target of some contrast, from thresholds 0.0598 · exp(0.132 e), e in degrees (Semizer and Michel).

    Of two places the right one is found with probability 1 - exp(-(contrast / threshold)^slope) / 2 (Weibull), which is
    Φ(d' / √2).

    Attributes:
        contrast: of the target.
        cells_per_degree: how many cells of the grid a degree of the visual field has.
    """

    contrast: float = 0.1
    cells_per_degree: float = 1.0
    threshold: float = 0.0598
    growth: float = 0.132
    slope: float = 2.35

    def __call__(self, eccentricity: Tensor) -> Tensor:
        """Return d' at an eccentricity in cells."""
        degrees = eccentricity / self.cells_per_degree
        relative = self.contrast / (self.threshold * torch.exp(self.growth * degrees))
        # Chances of an error below 1e-6 are beyond what was measured, and a d' must be finite.
        error = (torch.exp(-(relative**self.slope)) / 2).clamp(min=1e-6)
        return -(2**0.5) * torch.special.ndtri(error)
