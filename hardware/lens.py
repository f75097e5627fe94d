"""What a camera's lens does to directions: perspective, barrel distortion, and a camera that is mounted askew."""

from __future__ import annotations

import math

import cv2
import numpy as np


class Lens:
    """Directions (right, up, ahead) to pixels and back.

    Args:
        size: rows and columns of the image.
        view: how wide the image is, degrees.
        roll: how much the camera is turned about its axis, degrees.
        distortion: how much of the radius is lost at the corners of the image: barrel, if above 0.
    """

    def __init__(self, size: tuple[int, int], view: float = 50.0, roll: float = 0.0, distortion: float = 0.0):
        if not 0 < view < 150 or not -0.5 < distortion < 0.5 or not math.isfinite(roll) or min(size) < 1:
            raise ValueError(
                "a view is above 0 and below 150 degrees, distortion is within 0.5, and an image has rows and columns, "
                f"not {view}, {distortion} and {tuple(size)}."
            )
        self.size = int(size[0]), int(size[1])
        # Pixels a radian in the middle of the image.
        self.focal = self.size[1] / 2 / math.tan(math.radians(view) / 2)
        self.roll, self.distortion = math.radians(roll), distortion
        self.rays = self._rays()

    @property
    def middle(self) -> np.ndarray:
        """The (horizontal, vertical) pixel in the middle of the image."""
        return (np.array(self.size[::-1]) - 1) / 2

    def pixels(self, directions: np.ndarray) -> np.ndarray:
        """Return where directions (..., 3) are seen, (right, down) of the image's middle, pixels, (..., 2)."""
        flat = directions[..., :2].astype(float) / directions[..., 2:] * self.focal
        c, s = math.cos(self.roll), math.sin(self.roll)
        x, y = flat[..., 0] * c + flat[..., 1] * s, flat[..., 1] * c - flat[..., 0] * s
        # From the radius r without distortion to p = r (1 - d p² / corner).
        bent = 4 * self.distortion * (x**2 + y**2) / ((self.size[0] ** 2 + self.size[1] ** 2) / 4)
        shrunk = 2 / (1 + np.sqrt(np.maximum(1 + bent, 0)))
        return np.stack([x * shrunk, -y * shrunk], -1)

    def ray(self, pixel: np.ndarray) -> np.ndarray:
        """Return the direction, (3,), that is seen at the pixel nearest to (right, down) of the image's middle."""
        row, column = (np.asarray(pixel)[::-1] + self.middle[::-1]).round().astype(int)
        if not (0 <= row < self.size[0] and 0 <= column < self.size[1]):
            raise ValueError(f"there is no pixel {tuple(pixel)} from the middle in an image of {self.size}.")
        return self.rays[row, column]

    def seen(self, directions: np.ndarray) -> np.ndarray:
        """Tell which directions (..., 3) are in the image, (...)."""
        there = self.pixels(directions) + self.middle
        return ((there >= 0) & (there <= 2 * self.middle)).all(-1) & (directions[..., 2] > 0)

    def pinhole(self) -> tuple[int, int]:
        """Return rows and columns of the undistorted image, as fine as this one, that shows all that this one does."""
        flat = np.abs(self.rays[..., :2] / self.rays[..., 2:]) * self.focal
        # Rays are rounded.
        columns, rows = 2 * np.ceil(flat.reshape(-1, 2).max(0) + 0.499).astype(int)
        return int(rows), int(columns)

    def bend(self, image: np.ndarray) -> np.ndarray:
        """Return what this lens shows of a pinhole image, (rows, columns) as ``pinhole`` says."""
        if image.shape == self.size and not self.roll and not self.distortion:
            return image
        flat = self.rays[..., :2] / self.rays[..., 2:] * self.focal
        across = flat[..., 0] + (image.shape[1] - 1) / 2
        down = (image.shape[0] - 1) / 2 - flat[..., 1]
        return cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _rays(self) -> np.ndarray:
        """Directions of all pixels, (rows, columns, 3)."""
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


def mean_flow(lens: Lens, directions: np.ndarray) -> np.ndarray:
    """Return how far what is seen moves, (horizontal, vertical) pixels: the mean over the pixels that see it still.

    Args:
        lens: what is looked through before and after.
        directions: where what each pixel saw is afterwards, (rows, columns, 3).

    Returns:
        (2,); NaN if nothing of it is seen any more.
    """
    still = lens.seen(directions)
    if not still.any():
        return np.full(2, np.nan)
    return (lens.pixels(directions[still]) - lens.pixels(lens.rays[still])).mean(0)
