"""Words for laws: choices, and the moves of images.

``shift`` and ``window`` are linear in the image, and they move means and variances alike; an engine that knows
this keeps a field of independent pixels as two images instead of a covariance matrix.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor, ones, where, zeros

__all__ = ["ones", "recording_moves", "shift", "where", "window", "zeros"]

# While a law is probed, every move notes its input and its output here.
_moves: ContextVar[list[tuple[Tensor, Tensor]] | None] = ContextVar("moves", default=None)


@contextmanager
def recording_moves() -> Iterator[list[tuple[Tensor, Tensor]]]:
    """Note (input, output) of every move made inside; for the reader of structure."""
    moves: list[tuple[Tensor, Tensor]] = []
    token = _moves.set(moves)
    try:
        yield moves
    finally:
        _moves.reset(token)


def _noted(image: Tensor, moved: Tensor) -> Tensor:
    moves = _moves.get()
    if moves is not None:
        moves.append((image, moved))
    return moved


def shift(image: Tensor, displacement: Tensor, fill: float = 0.0) -> Tensor:
    """Move an image by a displacement rounded to whole pixels.

    Args:
        image: (height, width).
        displacement: (2,), (horizontal, vertical) in pixels; positive is to the right and down.
        fill: the value of pixels that come in from outside.
    """
    columns, rows = torch.round(displacement).to(torch.int64).unbind(-1)
    moved = _gather(image, torch.arange(image.shape[-2]) - rows, torch.arange(image.shape[-1]) - columns, fill)
    return _noted(image, moved)


def window(image: Tensor, corner: Tensor, size: tuple[int, int], fill: float = 0.0) -> Tensor:
    """Cut a window of ``size`` (height, width) out of an image.

    ``corner`` (2,) is the (horizontal, vertical) position of its upper left pixel, rounded to whole pixels;
    what lies outside the image is ``fill``.
    """
    column, row = torch.round(corner).to(torch.int64).unbind(-1)
    cut = _gather(image, torch.arange(size[0]) + row, torch.arange(size[1]) + column, fill)
    return _noted(image, cut)


def _gather(image: Tensor, rows: Tensor, columns: Tensor, fill: float) -> Tensor:
    height, width = image.shape[-2:]
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    # Rows first, which lie in one piece: quicker than both together.
    picked = image[rows.clamp(0, height - 1)][:, columns.clamp(0, width - 1)]
    return torch.where(inside, picked, fill)
