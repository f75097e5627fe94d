"""Seeing a piece of an image as it is: only that piece is touched, however large the image."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Pixels' numbers begin here, so that what comes in from outside is told from what has a place.
FAR = 10_000.0
APART = 6


@dataclass(frozen=True)
class Piece:
    """Which pixel of an image each pixel that is seen shows, in each world, (rows, worlds, h, w)."""

    # By its number, row by row; 0 where it shows none.
    number: Tensor
    inside: Tensor
    # What is seen where no pixel is shown, and the variance of what is seen.
    fill: Tensor
    noise: Tensor


class Cut:
    """Finds out whether a law only shows a piece of an image, and which: by images of pixels' own numbers."""

    def __init__(self) -> None:
        self.is_one, self.known = True, False
        self.numbers: Tensor | None = None

    def find(self, law: Callable[[Tensor], tuple[Tensor, Tensor]], image: Tensor) -> Piece | None:
        """Return the piece that a law shows of an image (rows, worlds, H, W); None if it does anything else.

        Args:
            law: mean and variance of what is seen of an image, (rows, worlds, h, w) each.
            image: any image, which tells how large they are.
        """
        if image.dim() != 4 or not self.is_one:
            return None
        if self.numbers is None:
            self.numbers = torch.arange(image[0, 0].numel(), dtype=image.dtype).reshape(1, 1, *image.shape[2:]) + FAR
            self.is_one = image[0, 0].numel() + FAR < 1 / torch.finfo(image.dtype).eps
        seen, noise = law(self.numbers)
        self.is_one = self.is_one and seen.dim() == 4 and self._all_of_a_piece(seen, image.shape[3])
        if not self.is_one:
            return None
        inside = seen >= FAR - 0.5
        return Piece(torch.where(inside, seen - FAR, 0.0).round().long(), inside, seen, noise)

    def _all_of_a_piece(self, seen: Tensor, columns: int) -> bool:
        """Whether neighbours show neighbours. All pixels are looked at when a law is new, then some."""
        apart = APART if self.known else 1
        seen = seen[..., ::apart, ::apart]
        inside, number = seen >= FAR - 0.5, (seen - FAR).round()
        if not torch.equal(number[inside], (seen - FAR)[inside]):
            return False
        for axis, place in enumerate((torch.div(number, columns, rounding_mode="floor"), number % columns)):
            line = apart * torch.arange(seen.shape[2 + axis], dtype=seen.dtype)
            origin = place - (line[:, None] if axis == 0 else line)
            least = torch.where(inside, origin, torch.inf).amin((-2, -1))
            most = torch.where(inside, origin, -torch.inf).amax((-2, -1))
            if bool((least < most).any()):
                return False
        # Where nothing is shown, nothing is learned of how.
        self.known = self.known or bool(inside.any())
        return True


def see_cut(
    piece: Piece, image: tuple[Tensor, Tensor], value: Tensor, own: bool = False
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Condition an image's mean and variance (rows, worlds, H, W) on what is seen of a piece of it.

    Args:
        piece: which pixels are seen.
        image: mean and variance.
        value: what is seen, (rows or 1, worlds or 1, h, w); NaN is missing.
        own: whether the variance may be written upon.

    Returns:
        Mean and variance; log p(value), nats, (rows, worlds).
    """
    mean, variance = image
    lead = torch.broadcast_shapes(piece.fill.shape[:2], value.shape[:2], mean.shape[:2], variance.shape[:2])
    flat = [part.expand(*lead, *mean.shape[2:]).flatten(2) for part in (mean, variance)]
    wide = (*lead, *piece.fill.shape[2:])
    number, inside = piece.number.expand(wide).flatten(2), piece.inside.expand(wide).flatten(2)
    m, v = (part.gather(2, number).reshape(wide) for part in flat)
    centre = torch.where(piece.inside, m, piece.fill)
    spread = torch.where(piece.inside, v, 0.0) + piece.noise
    missing = torch.isnan(value)
    surprise = torch.where(missing, 0.0, value - centre)
    weight = torch.where(missing, 0.0, 1 / spread)
    after = m + v * surprise * weight, (v - v * v * weight).clamp(min=0)
    found = []
    everywhere = bool(inside.all())
    own = own and variance.shape[:2] == lead and variance.is_contiguous() and not variance.requires_grad
    for old, new, ours in zip(flat, after, (False, own and not after[1].requires_grad), strict=True):
        if everywhere and ours:
            put = old.scatter_(2, number, new.flatten(2))
        elif everywhere:
            put = old.scatter(2, number, new.flatten(2))
        else:
            put = old.clone(memory_format=torch.contiguous_format)
            begin = torch.arange(lead[0] * lead[1]).reshape(*lead, 1) * old.shape[2]
            put.view(-1)[(number + begin)[inside]] = new.flatten(2)[inside]
        found.append(put.reshape(*lead, *mean.shape[2:]))
    return (found[0], found[1]), log_density(surprise, weight, spread, missing)


def log_density(surprise: Tensor, weight: Tensor, spread: Tensor, missing: Tensor) -> Tensor:
    """Return the log density of what is seen, summed over pixels that are not missing, nats, (rows, worlds)."""
    score = -0.5 * (surprise**2 * weight + spread.log() + math.log(2 * math.pi))
    return torch.where(missing, 0.0, score).flatten(2).sum(-1)
