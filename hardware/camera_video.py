"""A video file in place of a camera."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hardware.camera import CameraError, as_grey, check_size, quietly


class VideoCamera:
    """A video, a frame each time it is asked.

    Args:
        path: the file, of any format that OpenCV's FFmpeg knows.
        size: rows and columns of the images; see ``as_grey``. None is the video's.
        loop: begin again where it ends; otherwise its end is a CameraError.

    Raises:
        CameraError: there is no such file, or it is no video.
    """

    def __init__(self, path: str | os.PathLike[str], size: tuple[int, int] | None = None, loop: bool = False):
        check_size(size)
        self.path, self.size, self.loop = Path(path).expanduser(), size, loop
        self.frames = 0
        self.capture: Any = None
        if not self.path.is_file():
            raise CameraError(f"'{self.path}' is not there; give the path of a video.")
        self._open()

    def read(self) -> np.ndarray:
        """Return the next frame, (rows, columns) float32 in [0, 1]."""
        if self.capture is None:
            raise CameraError(f"The video '{self.path}' is closed; make it anew.")
        good, frame = self.capture.read()
        if not good and self.frames and self.loop:
            # Going back to the first frame is not exact in every format; opening it again is.
            self._open()
            good, frame = self.capture.read()
        if not good and self.frames:
            raise CameraError(f"The video '{self.path}' has ended, after {self.frames} frames; loop=True begins again.")
        if not good:
            raise CameraError(f"'{self.path}' holds no image that OpenCV can read; is it a video?")
        self.frames += 1
        return as_grey(frame, self.size)

    def close(self) -> None:
        """Let go of the file."""
        if self.capture is not None:
            self.capture.release()
            self.capture = None

    def _open(self) -> None:
        self.close()
        with quietly():
            self.capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not self.capture.isOpened():
            self.close()
            raise CameraError(f"'{self.path}' is not a video that OpenCV can read.")
