"""A camera on motors in the middle of a panorama: a head in a real place, without a physics engine.

What a pinhole camera sees of an equirectangular photograph, whichever way it is turned, with lens distortion, a camera
that is mounted askew, and noise of sensor and motors (thesis ch. 6: what learning to look must cope with).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

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
        if not 0 < view < 150 or min(slip, sensor) < 0 or min(limits) <= 0 or not -0.5 < distortion < 0.5:
            raise ValueError(
                "a view is less than 150 degrees, noise is 0 or more, limits are above 0 and distortion is within 0.5, "
                f"not {view}, {slip}, {sensor}, {limits} and {distortion}."
            )
        self.size, self.focal = tuple(size), size[1] / 2 / math.tan(math.radians(view) / 2)
        self.slip, self.sensor, self.limits = slip, sensor, np.asarray(limits, dtype=float)
        # As fine as the image and no finer, or what is seen would flicker as it moves.
        wanted = 360 / math.degrees(1 / self.focal)
        share = min(1.0, 1.2 * wanted / grey.shape[1])
        self.panorama = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        self.roll, self.distortion = math.radians(roll), distortion
        self.rays = self._rays()
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
        world = self.rays @ _turned(*np.radians(angles)).T.astype(np.float32)
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

    def flow(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return how far what is seen moves between angles, (horizontal, vertical) pixels: the mean where both see."""
        # Where the rays of the image before are in the image after.
        camera = self.rays @ (_turned(*np.radians(before)).T @ _turned(*np.radians(after))).astype(np.float32)
        moved = self._pixels(camera) - self._pixels(self.rays)
        there = self._pixels(camera) + (np.array(self.size[::-1]) - 1) / 2
        inside = ((there >= 0) & (there <= np.array(self.size[::-1]) - 1)).all(-1) & (camera[..., 2] > 0)
        return moved[inside].mean(0) if inside.any() else np.full(2, np.nan)

    def follow(self, pixel: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return where what was seen at a pixel, (right, down) of the middle, is seen after a turn between angles."""
        row, column = (np.asarray(pixel)[::-1] + (np.array(self.size) - 1) / 2).round().astype(int)
        turn = _turned(*np.radians(before)).T @ _turned(*np.radians(after))
        return self._pixels(self.rays[row, column] @ turn)

    def _pixels(self, directions: np.ndarray) -> np.ndarray:
        """Where directions (right, up, ahead) are seen, (right, down) of the image's middle, pixels."""
        flat = directions[..., :2].astype(float) / directions[..., 2:] * self.focal
        c, s = math.cos(self.roll), math.sin(self.roll)
        x, y = flat[..., 0] * c + flat[..., 1] * s, flat[..., 1] * c - flat[..., 0] * s
        corner, shrunk = (self.size[0] ** 2 + self.size[1] ** 2) / 4, np.ones_like(x)
        for _ in range(20):
            shrunk = 1 - self.distortion * np.minimum((x**2 + y**2) * shrunk**2 / corner, 1.5)
        return np.stack([x * shrunk, -y * shrunk], -1)

    def _rays(self) -> np.ndarray:
        """Directions (right, up, ahead) of all pixels, (rows, columns, 3)."""
        rows, columns = self.size
        y, x = np.mgrid[:rows, :columns].astype(float)
        x, y = x - (columns - 1) / 2, (rows - 1) / 2 - y
        corner = (columns**2 + rows**2) / 4
        stretch = 1 / (1 - self.distortion * (x**2 + y**2) / corner)
        x, y = x * stretch, y * stretch
        c, s = math.cos(self.roll), math.sin(self.roll)
        x, y = x * c - y * s, x * s + y * c
        rays = np.stack([x, y, np.full_like(x, self.focal)], -1)
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def _turned(right: float, up: float) -> np.ndarray:
    """The rotation that takes the camera's directions to the world's."""
    c, s, d, t = math.cos(right), math.sin(right), math.cos(up), math.sin(up)
    pan = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tilt = np.array([[1, 0, 0], [0, d, t], [0, -t, d]])
    return pan @ tilt
