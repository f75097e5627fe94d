"""A camera on motors in the middle of a panorama: a head in a real place, without a physics engine.

What a pinhole camera sees of an equirectangular photograph, whichever way it is turned, with lens distortion, a camera
that is mounted askew, and noise of sensor and motors (thesis ch. 6: what learning to look must cope with).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from hardware.lens import Lens, mean_flow
from hardware.photo import as_photo

__all__ = ["PanoramaHead"]


class PanoramaHead:
    """A body: a command turns the camera from where it is, and the image that follows is what it then sees.

    Args:
        panorama: a path or an array, equirectangular: as wide as 360 degrees, as high as 180.
        gains: degrees that a unit of each motor turns the camera to the right and up, (2, motors).
        size: rows and columns of the image.
        view: how wide the image is, degrees.
        slip: standard deviation of where a movement ends, pixels in the middle of the image.
        sensor: of a pixel's noise; pixels are 0 to 1.
        roll: how much the camera is turned about its axis, degrees.
        distortion: how much of the radius is lost at the corners of the image: barrel, if above 0.
        limits: degrees to the right and up that the camera can turn at most, either way.
    """

    def __init__(
        self,
        panorama: Any,
        gains: Sequence[Sequence[float]] = ((60.0, 0.0), (0.0, 40.0)),
        size: tuple[int, int] = (240, 320),
        view: float = 50.0,
        slip: float = 5.0,
        sensor: float = 0.02,
        roll: float = 0.0,
        distortion: float = 0.0,
        limits: tuple[float, float] = (60.0, 35.0),
    ):
        image = as_photo(panorama)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        self.gains = np.asarray(gains, dtype=float)
        if self.gains.ndim != 2 or len(self.gains) != 2 or not np.isfinite(self.gains).all():
            raise ValueError(f"gains are (2, motors), to the right and up, not of shape {self.gains.shape}.")
        if min(slip, sensor) < 0 or min(limits) <= 0:
            raise ValueError(f"noise is 0 or more and limits are above 0, not {slip}, {sensor} and {limits}.")
        self.lens = Lens(size, view, roll, distortion)
        self.size, self.focal = self.lens.size, self.lens.focal
        self.slip, self.sensor, self.limits = slip, sensor, np.asarray(limits, dtype=float)
        # As fine as the image and no finer, or what is seen would flicker as it moves.
        wanted = 360 / math.degrees(1 / self.focal)
        share = min(1.0, 1.2 * wanted / grey.shape[1])
        self.panorama = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        self.reset(0)

    @property
    def motors(self) -> int:
        """How many motors there are."""
        return self.gains.shape[1]

    def reset(self, seed: int | None = None) -> None:
        """Look straight ahead; the same seed draws the same noise."""
        self.random = np.random.default_rng(seed)
        self.angles, self.aimed = np.zeros(2), np.zeros(2)

    def step(self, action: Any) -> Tensor:
        """Turn by a command (motors,), and return the image, (rows, columns), 0 to 1."""
        self.turn(action)
        return self.look()

    def turn(self, action: Any) -> None:
        """Turn by a command (motors,); a motor stops at its limit."""
        command = np.asarray(action, dtype=float).reshape(-1)
        if command.shape != (self.motors,) or not np.isfinite(command).all():
            raise ValueError(f"a command is {self.motors} numbers, one a motor, not {command.tolist()}.")
        slip = self.random.normal(size=2) * math.degrees(self.slip / self.focal) if command.any() else 0.0
        self.angles = np.clip(self.angles + self.gains @ command + slip, -self.limits, self.limits)

    def look(self) -> Tensor:
        """Return what is seen now, (rows, columns), 0 to 1."""
        clean = self.render(self.angles)
        noisy = clean + self.sensor * self.random.normal(size=clean.shape).astype(np.float32)
        return torch.from_numpy(np.clip(noisy, 0, 1))

    def render(self, angles: np.ndarray) -> np.ndarray:
        """Return the image without noise at angles to the right and up, degrees."""
        world = self.lens.rays @ _turned(*np.radians(angles)).T.astype(np.float32)
        height, width = self.panorama.shape
        longitude, latitude = np.arctan2(world[..., 0], world[..., 2]), np.arcsin(np.clip(world[..., 1], -1, 1))
        across = (longitude / (2 * math.pi) + 0.5) * width - 0.5
        down = (0.5 - latitude / math.pi) * height - 0.5
        seen = cv2.remap(
            self.panorama,
            across.astype(np.float32),
            down.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        return seen.astype(np.float32) / 255

    @contextmanager
    def noiseless(self) -> Iterator[None]:
        """Let motors do exactly as they are told, for a while."""
        slip, self.slip = self.slip, 0.0
        try:
            yield
        finally:
            self.slip = slip

    def flow(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return how far what is seen moves between angles, (horizontal, vertical) pixels: the mean where both see."""
        # Where the rays of the image before are in the image after.
        turn = _turned(*np.radians(before)).T @ _turned(*np.radians(after))
        return mean_flow(self.lens, self.lens.rays @ turn.astype(np.float32))

    def follow(self, pixel: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return where what was seen at a pixel, (right, down) of the middle, is seen after a turn between angles."""
        turn = _turned(*np.radians(before)).T @ _turned(*np.radians(after))
        return self.lens.pixels(self.lens.ray(pixel) @ turn)


def _turned(right: float, up: float) -> np.ndarray:
    """The rotation that takes the camera's directions to the world's."""
    c, s, d, t = math.cos(right), math.sin(right), math.cos(up), math.sin(up)
    pan = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tilt = np.array([[1, 0, 0], [0, d, t], [0, -t, d]])
    return pan @ tilt
