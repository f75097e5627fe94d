"""A room with pictures for walls, in which a head may stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from hardware.photo import as_photo

# How many pixels of what is on a wall are as long as it is far away: as fine as 320 pixels over 50 degrees see it.
FINE = 360


@dataclass(frozen=True)
class Surface:
    """One side of a room: a rectangle in space and what is on it."""

    # Its upper left corner, and the way along its upper and its left edge, seen from inside, metres, (3,) each.
    corner: np.ndarray
    across: np.ndarray
    down: np.ndarray
    # (rows, columns), uint8.
    picture: np.ndarray


class Room:
    """Four walls, a floor and a ceiling; places are (right, ahead, up) of where the eyes are, metres.

    Args:
        scene: what is on the walls: an equirectangular panorama (a path or an array, twice as wide as high), which is
            seen as it was photographed from where the eyes are; or a list of photographs, one after the other for the
            walls, the floor and the ceiling.
        size: width, depth and height of the room, metres.
        eyes: how high the eyes are above the floor, metres.
        turned: by how much a panorama is turned to the left, degrees.
    """

    def __init__(
        self, scene: Any, size: tuple[float, float, float] = (6.0, 6.0, 3.0), eyes: float = 1.3, turned: float = 0.0
    ):
        if min(size) <= 0 or not 0 < eyes < size[2]:
            raise ValueError(f"a room has a size, and eyes are below its ceiling, not {tuple(size)} and {eyes}.")
        wide, deep, high = size
        self.low = np.array([-wide / 2, -deep / 2, -eyes])
        self.high = np.array([wide / 2, deep / 2, high - eyes])
        # Pixels a metre.
        self.fine = FINE / (min(wide, deep) / 2)
        if isinstance(scene, Sequence) and not isinstance(scene, str):
            if not scene:
                raise ValueError("a room needs a picture.")
            photos = [_grey(photo) for photo in scene]
            paint = lambda i, rows, columns, points: cv2.resize(  # noqa: E731
                photos[i % len(photos)], (columns, rows), interpolation=cv2.INTER_AREA
            )
        else:
            panorama = _grey(scene)
            # As coarse as the walls are, or what is seen would flicker.
            share = min(1.0, 2 * math.pi * FINE / panorama.shape[1])
            panorama = cv2.resize(panorama, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
            paint = lambda i, rows, columns, points: _seen(panorama, points, turned)  # noqa: E731
        self.paint = paint

    @cached_property
    def surfaces(self) -> list[Surface]:
        """Its six sides, painted when they are first looked at."""
        return [self._surface(i, *edges) for i, edges in enumerate(self._edges())]

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return where rays from a place (3,) inside along directions (..., 3) meet a wall, (..., 3)."""
        with np.errstate(divide="ignore", over="ignore"):
            far = np.where(directions > 0, self.high - origin, self.low - origin) / directions
        far = np.where(directions == 0, np.inf, far)
        return origin + far.min(-1, keepdims=True) * directions

    def _edges(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        (left, back, floor), (right, front, top) = self.low, self.high
        x, y, z = np.diag(self.high - self.low)
        corner = lambda *place: np.array(place)  # noqa: E731
        return [
            (corner(left, front, top), x, -z),
            (corner(right, front, top), -y, -z),
            (corner(right, back, top), -x, -z),
            (corner(left, back, top), y, -z),
            (corner(left, front, floor), x, -y),
            (corner(left, back, top), x, y),
        ]

    def _surface(self, i: int, corner: np.ndarray, across: np.ndarray, down: np.ndarray) -> Surface:
        columns, rows = (max(1, round(float(np.linalg.norm(edge)) * self.fine)) for edge in (across, down))
        u, v = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
        points = corner + u[None, :, None] * across + v[:, None, None] * down
        return Surface(corner, across, down, self.paint(i, rows, columns, points))


def _grey(picture: Any) -> np.ndarray:
    image = as_photo(picture)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def _seen(panorama: np.ndarray, points: np.ndarray, turned: float) -> np.ndarray:
    """What a panorama shows where points (..., 3) are, seen from the origin."""
    height, width = panorama.shape
    right, ahead, up = np.moveaxis(points / np.linalg.norm(points, axis=-1, keepdims=True), -1, 0)
    across = ((np.arctan2(right, ahead) / (2 * math.pi) + 0.5 + turned / 360) % 1) * width - 0.5
    down = (0.5 - np.arcsin(np.clip(up, -1, 1)) / math.pi) * height - 0.5
    return cv2.remap(
        panorama, across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
