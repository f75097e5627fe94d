"""The digital eye: a detector behind a simulated fovea, looking at a photograph (thesis ch. 5, section 5.6).

A look costs a few small patches.  What it tells is a count per cell of the grid: how many of the detector's
boxes are centred there, over all windows (figure 5.11).  Where to look next is not the eye's affair: it is a
body, and a controller moves it.
"""

from __future__ import annotations

import os
import time
from typing import Literal

import cv2
import numpy as np
import torch

from hardware.detectors import CascadeDetector, Detector, detect, group, prepare
from hardware.fovea import MOST_ENLARGED, PATCH_PIXELS, WINDOWS, Box, Fovea, Patch, halvings, shrink
from hardware.photo import PhotoError, as_photo

__all__ = ["PhotoEye", "whole_image"]

# 2.5 times as fast as 1.1, and on composite photographs (see `hardware.fovea`) it found as many faces of
# 5-50 % of the width once fixated; of those of 2-5 %, .95 (and .97 with 1.2).
LOOK = CascadeDetector(scale_factor=1.3)
FACE = 64  # pixels: the size at which a verification look shows a face


class PhotoEye:
    """A body that looks at one photograph through a fovea; an action is a cell to fixate.

    Args:
        photo: a path, or an array, uint8 or in [0, 1], (height, width) or (height, width, 3).
        detector: any callable from a uint8 grey image to boxes (n, 4): row, column, height, width in pixels.
        grid: rows and columns of cells; cell i is at row i // columns and column i % columns.
        windows: how many cells each window is wide and high; see `Fovea`.
        max_count: counts above it are cut to it.
        support: how many raw boxes must agree for `confirm`; 1 for a detector that groups its own.
        patch_rule, patch_pixels: how windows shrink to patches; see `Fovea`.

    Raises:
        PhotoError: the photo cannot be read, or is smaller than the grid.
        ValueError: a number is out of its range, or the detector's answer is not boxes.
    """

    def __init__(
        self,
        photo: str | os.PathLike[str] | np.ndarray,
        detector: Detector = LOOK,
        grid: tuple[int, int] = (21, 21),
        windows: tuple[int, ...] = WINDOWS,
        max_count: int = 9,
        support: int = 3,
        patch_rule: Literal["fixed", "published"] = "fixed",
        patch_pixels: int = PATCH_PIXELS,
    ):
        if max_count < 1 or support < 1:
            raise ValueError(f"max_count and support must be 1 or more, not {max_count} and {support}.")
        self.image = as_photo(photo)
        self.detector, self.max_count, self.support = detector, max_count, support
        height, width = self.image.shape[:2]
        if height < grid[0] or width < grid[1]:
            name = "The photo" if isinstance(photo, np.ndarray) else f"'{photo}'"
            raise PhotoError(
                f"{name} is {width}x{height} pixels, smaller than the {grid[1]}x{grid[0]} grid; "
                "use a larger photo or a coarser grid."
            )
        self.fovea = Fovea((height, width), (grid[0], grid[1]), tuple(windows), patch_rule, patch_pixels)
        prepare(detector)
        self._grey = cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forget what was seen.  Nothing here is random; `seed` is there because every body has one."""
        self.fixations: list[int] = []
        self.milliseconds: list[float] = []  # what each look took
        self._levels: list[np.ndarray] = []
        self._seen: dict[Box, np.ndarray] = {}  # window -> raw boxes found in it
        self._first: dict[Box, int] = {}  # window -> the fixation that first showed it

    def step(self, action: int | torch.Tensor) -> torch.Tensor:
        """Look at the cell `action`.

        Returns:
            float32 (rows * columns,): the number of boxes centred in each cell, all windows added, at most
            `max_count`.

        Raises:
            ValueError: there is no such cell.
        """
        fixation = self._cell(action)
        start = time.perf_counter()
        boxes = [self._search(box, fixation) for box in self.fovea.boxes(fixation)]
        counts = np.bincount(self.fovea.cells_of(np.concatenate(boxes)), minlength=self.fovea.cells)
        observation = torch.from_numpy(np.minimum(counts, self.max_count).astype(np.float32))
        self.milliseconds.append((time.perf_counter() - start) * 1e3)
        self.fixations.append(fixation)
        return observation

    def close(self) -> None:
        """Let go of what was seen; the photograph can be looked at again."""
        self.reset()

    @property
    def boxes(self) -> np.ndarray:
        """All raw boxes seen so far, float (n, 4): row, column, height, width in pixels of the photograph."""
        return np.concatenate([np.zeros((0, 4)), *self._seen.values()])

    @property
    def box_fixations(self) -> np.ndarray:
        """For each of `boxes`, the fixation it came from, (n,); windows seen again count for the first."""
        fixations = [np.full(len(boxes), self._first[box]) for box, boxes in self._seen.items()]
        return np.concatenate([np.zeros(0, dtype=int), *fixations])

    def reconstruct(self, fixation: int | torch.Tensor) -> np.ndarray:
        """What the eye sees of the photograph from `fixation`: uint8 RGB, its shape (figure 5.10)."""
        return self.fovea.reconstruct(self.image, self._cell(fixation))

    def confirm(self, cell: int | torch.Tensor) -> np.ndarray | None:
        """Look once more, at what was found around `cell`, at the size that suits the detector best.

        The crop is twice the median of the raw boxes centred in the 3x3 cells around `cell`, shrunk so that
        the face is 64 pixels high.  This is an extension: the thesis stops without another look.

        Returns:
            The box (4,) that most raw boxes agree on, in pixels of the photograph, or None if fewer than
            `support` do, or if nothing was found there.
        """
        boxes = self.boxes
        near = boxes[np.isin(self.fovea.cells_of(boxes), self.fovea.around(self._cell(cell)))]
        if not len(near):
            return None
        patch = self._closer(np.median(near, axis=0))
        groups, _ = group(patch.to_image(detect(self.detector, patch.pixels)), self.support)
        return groups[0] if len(groups) else None

    def _closer(self, box: np.ndarray) -> Patch:
        """The patch that shows twice `box` (4,), as far as it lies in the photograph, at the best size."""
        (row, column, height, width), (most_rows, most_columns) = box, self._grey.shape
        top = min(max(0, round(row - height / 2)), most_rows - 1)
        left = min(max(0, round(column - width / 2)), most_columns - 1)
        bottom = min(max(top + 1, round(row + 1.5 * height)), most_rows)
        right = min(max(left + 1, round(column + 1.5 * width)), most_columns)
        scale = min(FACE / max(height, 1), MOST_ENLARGED)
        shape = max(1, round((bottom - top) * scale)), max(1, round((right - left) * scale))
        return shrink(self._levels, Box(top, left, bottom - top, right - left), shape)

    def _search(self, box: Box, fixation: int) -> np.ndarray:
        """Raw boxes (n, 4) in the window, in pixels of the photograph.

        A window is searched once: the widest is the same from everywhere, and so are some at the borders.
        """
        if not self._levels:
            self._levels = halvings(self._grey)
        if box not in self._seen:
            patch = self.fovea.patch(self._levels, box)
            self._seen[box] = patch.to_image(detect(self.detector, patch.pixels))
            self._first[box] = fixation
        return self._seen[box]

    def _cell(self, action: int | torch.Tensor) -> int:
        """The action as a cell's index."""
        try:
            cell = action.item() if isinstance(action, torch.Tensor) else action
            if 0 <= cell < self.fovea.cells and cell == int(cell):  # false for NaN
                return int(cell)
        except (TypeError, ValueError, RuntimeError):  # not one number
            pass
        raise ValueError(f"An action is one cell, 0 to {self.fovea.cells - 1}, and this is {action!r}.")


def whole_image(
    photo: str | os.PathLike[str] | np.ndarray, detector: Detector | None = None, support: int = 4
) -> tuple[np.ndarray | None, float]:
    """The eye's rival: search the whole photograph at full resolution (thesis ch. 5, section 5.6.6).

    Args:
        photo: as for `PhotoEye`.
        detector: by default the cascade at scale factor 1.1.
        support: raw boxes that must agree; 4 is what OpenCV calls minNeighbors 3.

    Returns:
        The box (4,) that most raw boxes agree on, or None, and the milliseconds of searching and grouping.
    """
    detector = CascadeDetector() if detector is None else detector
    prepare(detector)
    grey = cv2.cvtColor(as_photo(photo), cv2.COLOR_RGB2GRAY)
    start = time.perf_counter()
    groups, _ = group(detect(detector, grey), support)
    return (groups[0] if len(groups) else None), (time.perf_counter() - start) * 1e3
