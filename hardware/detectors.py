"""Object detectors, which the digital eye takes as they come.

"The proposed approach is plug-and-play" (thesis ch. 5, section 5.6): a detector is any callable that takes a
grey image and answers with boxes.  Two are given here.  The one that does not group its boxes serves the eye
better, because the number of boxes around a place is the evidence that the model of the eye works with.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

__all__ = ["CascadeDetector", "Detector", "LBPDetector", "detect", "group", "prepare"]


class Detector(Protocol):
    """Anything that finds objects in a grey image."""

    def __call__(self, image: np.ndarray, /) -> np.ndarray:
        """Boxes (n, 4): row, column, height, width in pixels of the uint8 grey `image` (height, width)."""
        ...


@dataclass(frozen=True)
class CascadeDetector:
    """A boosted cascade of OpenCV's (Viola & Jones 2004), the detector of the thesis (section 5.6.5).

    With `min_neighbors=0`, the default, the boxes come raw: many around a face, few around a false alarm.

    Raises:
        ValueError: OpenCV has no cascade of this name, or a number is out of its range.
    """

    name: str = "haarcascade_frontalface_alt2"
    scale_factor: float = 1.1  # each size searched is so many times the one before; > 1
    min_neighbors: int = 0  # boxes that must agree for one to be returned; 0: no grouping
    min_size: int | None = None  # pixels; smaller faces are not looked for.  None: the cascade's own (20)
    _classifier: Any = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        _check_name(self.name)
        _check_sizes(self.scale_factor, self.min_size)
        if self.min_neighbors < 0:
            raise ValueError(f"min_neighbors must be 0 or more, not {self.min_neighbors}.")

    def __call__(self, image: np.ndarray, /) -> np.ndarray:
        """Boxes (n, 4): row, column, height, width in pixels of the uint8 grey `image` (height, width)."""
        least = (0, 0) if self.min_size is None else (self.min_size, self.min_size)
        found = self.load().detectMultiScale(image, self.scale_factor, self.min_neighbors, 0, least)
        boxes = np.array(found, dtype=float).reshape(-1, 4)[:, [1, 0, 3, 2]]
        return boxes[np.lexsort(boxes.T)]  # OpenCV's threads find the same boxes in any order

    def load(self) -> Any:
        """Load the cascade, if that was not done: it takes about 10 ms, and the result does not pickle."""
        if self._classifier is None:
            classifier = cv2.CascadeClassifier(str(_cascades() / f"{self.name}.xml"))
            object.__setattr__(self, "_classifier", classifier)
        return self._classifier

    def __getstate__(self) -> dict[str, Any]:
        """All but the loaded cascade, so that a detector can go to another process."""
        return {**self.__dict__, "_classifier": None}


@dataclass(frozen=True)
class LBPDetector:
    """scikit-image's cascade of local binary patterns for frontal faces.

    It answers with grouped boxes only, so an eye behind it has less to count: where the Haar cascade gives
    ten raw boxes around a face, this one gives one or none.

    Raises:
        ValueError: a number is out of its range.
    """

    scale_factor: float = 1.2  # as for `CascadeDetector`
    step_ratio: float = 1.0  # 1: every place; more: faster, and misses more
    min_size: int = 24  # pixels
    min_neighbors: int = 1  # boxes that must agree for one to be returned
    _cascade: Any = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        _check_sizes(self.scale_factor, self.min_size)

    def __call__(self, image: np.ndarray, /) -> np.ndarray:
        """Boxes (n, 4): row, column, height, width in pixels of the uint8 grey `image` (height, width)."""
        if min(image.shape) < self.min_size:
            return np.zeros((0, 4))
        found = self.load().detect_multi_scale(
            img=image,
            scale_factor=self.scale_factor,
            step_ratio=self.step_ratio,
            min_size=(self.min_size, self.min_size),
            max_size=image.shape,
            min_neighbor_number=self.min_neighbors,
        )
        boxes = [(box["r"], box["c"], box["height"], box["width"]) for box in found]
        return np.array(boxes, dtype=float).reshape(-1, 4)

    def load(self) -> Any:
        """Import scikit-image and load the cascade, if that was not done."""
        if self._cascade is None:
            from skimage.data import lbp_frontal_face_cascade_filename
            from skimage.feature import Cascade

            object.__setattr__(self, "_cascade", Cascade(lbp_frontal_face_cascade_filename()))
        return self._cascade

    def __getstate__(self) -> dict[str, Any]:
        """All but the loaded cascade, so that a detector can go to another process."""
        return {**self.__dict__, "_cascade": None}


def prepare(detector: Detector) -> None:
    """Call the detector's `load`, if it has one, so that loading is not in the time of the first look."""
    load = getattr(detector, "load", None)
    if callable(load):
        load()


def detect(detector: Detector, image: np.ndarray) -> np.ndarray:
    """Ask any detector for boxes in `image`, and hold it to its promise.

    Returns:
        float (n, 4): row, column, height, width in pixels.

    Raises:
        ValueError: the answer is not an array of that shape, or not finite.
    """
    boxes = np.asarray(detector(image), dtype=float)
    if not boxes.size:
        return np.zeros((0, 4))
    if boxes.shape[1:] != (4,) or not np.isfinite(boxes).all():
        raise ValueError(
            f"{detector!r} must answer with finite boxes (n, 4): row, column, height, width; "
            f"its answer has shape {boxes.shape}."
        )
    return boxes


def group(boxes: np.ndarray, support: int = 1, tolerance: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Merge boxes that nearly coincide, by OpenCV's rule for `minNeighbors` (`minNeighbors + 1 == support`).

    Args:
        boxes: (n, 4): row, column, height, width in pixels.
        support: the least number of boxes that make a group; 1 or more.
        tolerance: sides may differ by this part of the smaller box.

    Returns:
        The groups' mean boxes (k, 4), those of most boxes first, and the number of boxes in each (k,).
    """
    repeats = 2 if support == 1 else 1  # OpenCV keeps groups of two or more: so show it each box twice
    rounded = np.rint(boxes).astype(int).tolist() * repeats
    merged, counts = cv2.groupRectangles(rounded, repeats * support - 1, tolerance)
    counts = np.array(counts, dtype=int).reshape(-1) // repeats
    order = np.argsort(-counts, kind="stable")
    return np.array(merged, dtype=float).reshape(-1, 4)[order], counts[order]


def _cascades() -> Path:
    """Where OpenCV keeps its cascades."""
    return Path(cv2.data.haarcascades)  # pyright: ignore[reportAttributeAccessIssue]


def _check_name(name: str) -> None:
    names = sorted(path.stem for path in _cascades().glob("*.xml"))
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.3) or names
        raise ValueError(f"OpenCV has no cascade '{name}'; the nearest are {', '.join(near)}.")


def _check_sizes(scale_factor: float, min_size: int | None) -> None:
    if not (scale_factor > 1 and math.isfinite(scale_factor)):
        raise ValueError(f"scale_factor must be more than 1, not {scale_factor}.")
    if min_size is not None and min_size < 1:
        raise ValueError(f"min_size must be 1 pixel or more, not {min_size}.")
