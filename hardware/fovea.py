"""A simulated fovea: fine where it looks, coarse all around (thesis ch. 5, section 5.6.1 and figure 5.10).

A grid of cells covers an image.  Around the cell that is fixated lie windows, one inside the other, so many
cells wide and high; one that would stick out at a border slides inside.  Every window is shrunk to a *patch*
of about the same size, so that the widest shows everything coarsely and the narrowest a little of it finely.
What a look costs is then the cost of a few small patches, however large the image.

This is geometry alone: a pixel (i, j) covers [i, i+1) x [j, j+1); a box is (row, column, height, width).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np

__all__ = ["PUBLISHED_WINDOWS", "Box", "Fovea", "Patch", "halvings", "shrink"]

# Windows and patches that need the least time for what they find, on photographs of 0.3 to 2.8 megapixels
# with a face of 2-50 % of the width pasted in.  The thesis has PUBLISHED_WINDOWS, and another rule for
# patches.
WINDOWS = (21, 9, 3)
PATCH_PIXELS = 144 * 108
PUBLISHED_WINDOWS = (21, 15, 9, 3)
PUBLISHED_LEAST = (45, 60)  # pixels (height, width); section 5.6.5
MOST_ENLARGED = 2.0  # times; more shows a detector nothing new, and costs


class Box(NamedTuple):
    """A part of an image, in whole pixels."""

    row: int
    column: int
    height: int
    width: int


class Patch(NamedTuple):
    """What a window shows, `pixels`, and the part of the image that these really are, `region`."""

    pixels: np.ndarray
    region: Box

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Map boxes (n, 4) in pixels of the patch to pixels of the image."""
        height, width = self.pixels.shape[:2]
        scale = np.array([self.region.height / height, self.region.width / width] * 2)
        return boxes * scale + [*self.region[:2], 0, 0]


def halvings(image: np.ndarray) -> list[np.ndarray]:
    """The image, its half, its quarter, and so on down to a pixel, each the mean of 2x2 of the one before.

    Patches cut from these cost next to nothing (0.1 ms a megapixel, once) and do not alias.  `cv2.resize`
    from the full image takes as long as the detector if by area; if linear, it loses faces in noisy photos.
    """
    levels = [image]
    while min(levels[-1].shape[:2]) > 1:
        height, width = (side // 2 for side in levels[-1].shape[:2])
        even = levels[-1][: 2 * height, : 2 * width]  # an odd last row is less than a pixel of any patch
        levels.append(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA))
    return levels


def shrink(levels: Sequence[np.ndarray], box: Box, shape: tuple[int, int]) -> Patch:
    """Cut `box` (pixels of `levels[0]`) out of the level next above `shape`, and resize it to `shape`.

    The cut is at whole pixels of that level; `Patch.region` says where it was.
    """
    shrinkage = min(box.height / shape[0], box.width / shape[1])
    depth = min(max(int(math.log2(shrinkage)), 0), len(levels) - 1) if shrinkage > 1 else 0
    level, size = levels[depth], 2**depth
    top, bottom = _cut(box.row, box.height, size, level.shape[0])
    left, right = _cut(box.column, box.width, size, level.shape[1])
    pixels = cv2.resize(level[top:bottom, left:right], shape[::-1], interpolation=cv2.INTER_LINEAR)
    return Patch(pixels, Box(top * size, left * size, (bottom - top) * size, (right - left) * size))


@dataclass(frozen=True)
class Fovea:
    """Windows and patches for images of one shape (thesis ch. 5, sections 5.6.1 and 5.6.5).

    Two rules give the size of a patch.  "fixed": every patch has about `patch_pixels` pixels and the aspect
    of its window, enlarged at most twice.  "published", the thesis's: the size of the smallest window used,
    which grows with the image; the smallest window is not used where it is below 60x45 pixels.

    Raises:
        ValueError: the image has fewer pixels than the grid has cells along a side, or a number or rule is
            not one there is.
    """

    shape: tuple[int, int]  # of the image: height, width in pixels
    grid: tuple[int, int] = (21, 21)  # rows and columns of cells
    windows: tuple[int, ...] = WINDOWS  # cells wide and high
    patch_rule: Literal["fixed", "published"] = "fixed"
    patch_pixels: int = PATCH_PIXELS

    def __post_init__(self):
        (height, width), (rows, columns) = self.shape, self.grid
        if min(rows, columns) < 1 or not self.windows or min(self.windows) < 1:
            raise ValueError(f"A grid {self.grid} with windows {self.windows} has nothing to look at.")
        if height < rows or width < columns:
            raise ValueError(f"{width}x{height} pixels are fewer than the {columns}x{rows} cells of the grid.")
        if self.patch_rule not in ("fixed", "published"):
            raise ValueError(f"There is no patch rule '{self.patch_rule}'; there are 'fixed' and 'published'.")
        if self.patch_pixels < 1:
            raise ValueError(f"patch_pixels must be 1 or more, not {self.patch_pixels}.")

    @property
    def cells(self) -> int:
        """How many cells the grid has."""
        return self.grid[0] * self.grid[1]

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The windows in use, widest first, as (rows, columns) of cells; none is larger than the grid."""
        rows, columns = self.grid
        spans = sorted({(min(n, rows), min(n, columns)) for n in self.windows}, reverse=True)
        if self.patch_rule == "published" and len(spans) > 1:
            smallest = self._published(spans[-1])
            if any(side < least for side, least in zip(smallest, PUBLISHED_LEAST, strict=True)):
                return spans[:-1]
        return spans

    def boxes(self, fixation: int) -> list[Box]:
        """The windows around the cell `fixation`, in pixels, widest first, all inside the image."""
        row, column = divmod(fixation, self.grid[1])
        return [self._box(row, column, *span) for span in self.spans]

    def patch_shape(self, box: Box) -> tuple[int, int]:
        """Height and width in pixels of the patch that the window `box` is shrunk to."""
        if self.patch_rule == "published":
            return self._published(self.spans[-1])
        scale = min(math.sqrt(self.patch_pixels / (box.height * box.width)), MOST_ENLARGED)
        return max(1, round(box.height * scale)), max(1, round(box.width * scale))

    def patch(self, levels: Sequence[np.ndarray], box: Box) -> Patch:
        """Shrink the window `box` of an image, given by its `halvings`, to its patch."""
        return shrink(levels, box, self.patch_shape(box))

    def cells_of(self, boxes: np.ndarray) -> np.ndarray:
        """The cells (n,) in which the centres of boxes (n, 4) lie: row * columns + column."""
        places = (boxes[:, :2] + boxes[:, 2:] / 2) / self.shape * self.grid
        row, column = np.clip(np.floor(places).astype(int), 0, np.array(self.grid) - 1).T
        return row * self.grid[1] + column

    def cell_box(self, cell: int) -> np.ndarray:
        """The cell's own box (4,), in pixels, not rounded."""
        size = np.array(self.shape) / self.grid
        return np.concatenate([divmod(cell, self.grid[1]) * size, size])

    def around(self, cell: int) -> np.ndarray:
        """The cell and its neighbours, those of the 3x3 cells around it that are on the grid."""
        rows, columns = np.divmod(np.arange(self.cells), self.grid[1])
        row, column = divmod(cell, self.grid[1])
        return np.flatnonzero((abs(rows - row) <= 1) & (abs(columns - column) <= 1))

    def reconstruct(self, image: np.ndarray, fixation: int) -> np.ndarray:
        """Rebuild the image from its patches, coarse first and fine last (figure 5.10, bottom).

        `image` is (height, width) or (height, width, 3); what no window shows is black.
        """
        levels, rebuilt = halvings(image), np.zeros_like(image)
        for box in self.boxes(fixation):
            shown = cv2.resize(self.patch(levels, box).pixels, (box.width, box.height))
            rebuilt[box.row : box.row + box.height, box.column : box.column + box.width] = shown
        return rebuilt

    def _box(self, row: int, column: int, high: int, wide: int) -> Box:
        """The window of `high` x `wide` cells around a cell, in pixels."""
        top, bottom = _slide(row, high, self.grid[0], self.shape[0])
        left, right = _slide(column, wide, self.grid[1], self.shape[1])
        return Box(top, left, bottom - top, right - left)

    def _published(self, span: tuple[int, int]) -> tuple[int, int]:
        """The size in pixels of a window of so many cells; the thesis shrinks all windows to the smallest."""
        height, width = (
            max(1, pixels * cells // total) for pixels, cells, total in zip(self.shape, span, self.grid, strict=True)
        )
        return height, width


def _slide(cell: int, span: int, cells: int, pixels: int) -> tuple[int, int]:
    """First pixel, and the one after the last, of `span` cells around `cell`, slid inside the border."""
    first = min(max(cell - span // 2, 0), cells - span)
    return round(first * pixels / cells), round((first + span) * pixels / cells)


def _cut(start: int, length: int, size: int, limit: int) -> tuple[int, int]:
    """Where a stretch of the image begins and ends in pixels of a level, each `size` wide; at least one."""
    first = min(round(start / size), limit - 1)
    return first, max(min(round((start + length) / size), limit), first + 1)
