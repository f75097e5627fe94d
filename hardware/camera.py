"""What is said of cameras, once: an image is asked for, and shows what is seen now."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np


class CameraError(ValueError):
    """A camera that cannot be used; the message is one sentence that names it and says what to do."""


@runtime_checkable
class Camera(Protocol):
    """Where images come from."""

    def read(self) -> np.ndarray:
        """Return what is seen now, (rows, columns) float32 in [0, 1]. CameraError if there is nothing to see with."""
        ...

    def close(self) -> None:
        """Let go of the camera; a second time does nothing."""
        ...


def as_grey(frame: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return a frame of OpenCV's, grey or (rows, columns, blue green red), uint8, as (rows, columns) float32 in [0, 1].

    Args:
        frame: the image.
        size: rows and columns; what is too much of the frame's longer side is cut off at both ends. None is its own.
    """
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    if size is not None and grey.shape != tuple(size):
        rows, columns = grey.shape
        share = min(rows / size[0], columns / size[1])
        height, width = max(1, round(size[0] * share)), max(1, round(size[1] * share))
        top, left = (rows - height) // 2, (columns - width) // 2
        grey = grey[top : top + height, left : left + width]
        way = cv2.INTER_AREA if share >= 1 else cv2.INTER_LINEAR
        grey = cv2.resize(grey, (size[1], size[0]), interpolation=way)
    return grey.astype(np.float32) / 255


def check_size(size: tuple[int, int] | None) -> None:
    """Raise CameraError unless a size is None, or two whole numbers above 0."""
    if size is not None and (len(size) != 2 or any(int(n) != n or n < 1 for n in size)):
        raise CameraError(f"A camera's size is rows and columns, whole numbers above 0, not {size}.")


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Keep OpenCV and its FFmpeg from printing what is wrong with a camera, for that is our own to say."""
    log: Any = cv2.utils.logging
    level, key = log.getLogLevel(), "OPENCV_FFMPEG_LOGLEVEL"
    before = os.environ.get(key)
    log.setLogLevel(log.LOG_LEVEL_SILENT)
    os.environ[key] = before or "-8"
    try:
        yield
    finally:
        log.setLogLevel(level)
        if before is None:
            os.environ.pop(key, None)
