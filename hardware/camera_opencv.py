"""A camera of this machine or of the network, by OpenCV."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from hardware.camera import CameraError, as_grey, check_size, quietly

# Frames that may wait in a driver, at the most; more is a camera faster than we can read it.
WAITING = 30
# Frames a second, where a camera does not say.
USUAL = 30.0


class OpenCVCamera:
    """A camera that shows what is seen now: frames that waited for somebody to read them are thrown away.

    Args:
        source: its number, 0 for the first, or the address of a stream.
        size: rows and columns of the images; the middle of what the camera gives, made smaller. None is the camera's.
        patience: seconds to wait for a stream, or for an image of it.

    Raises:
        CameraError: there is no such camera, or it gives no images.
    """

    def __init__(self, source: int | str = 0, size: tuple[int, int] | None = None, patience: float = 5.0):
        check_size(size)
        self.source, self.size = source, size
        self.capture: Any = _opened(source, patience)
        if not self.capture.isOpened():
            self.close()
            raise CameraError(f"There is no camera {source} that can be used here; is it plugged in, and free?")
        self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        rate = self.capture.get(cv2.CAP_PROP_FPS)
        self.period = 1 / rate if 1 <= rate <= 1000 else 1 / USUAL
        try:
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> np.ndarray:
        """Return what is seen now, (rows, columns) float32 in [0, 1]."""
        if self.capture is None:
            raise CameraError(f"The camera {self.source} is closed; make it anew.")
        for _ in range(WAITING):
            begin = time.monotonic()
            self._grab()
            # What had to be waited for was not there before.
            if time.monotonic() - begin > self.period / 2:
                break
        # The shutter of that frame may have opened before it was asked for.
        self._grab()
        good, frame = self.capture.retrieve()
        if not good or frame is None:
            raise CameraError(self._gone())
        return as_grey(frame, self.size)

    def close(self) -> None:
        """Let go of the camera."""
        if self.capture is not None:
            self.capture.release()
            self.capture = None

    def _grab(self) -> None:
        if not self.capture.grab():
            raise CameraError(self._gone())

    def _gone(self) -> str:
        return f"The camera {self.source} gives no images; is it plugged in?"


def _opened(source: int | str, patience: float) -> Any:
    with quietly():
        if isinstance(source, int):
            return cv2.VideoCapture(source)
        wait = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * patience)]
        wait += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * patience)]
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, wait)
