"""People who stand about, gesture and walk by: pictures on cards that turn to the head."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass
class Person:
    """Somebody in the room; where, as time goes by.

    Args:
        picture: a path or an array.
        distance: of the head, metres.
        bearing: degrees to the right of straight ahead.
        height: how high the picture is, metres; it is as wide as its pixels say.
        up: where its middle is, metres above the eyes.
        sway: how far it moves to and fro, up and down, as people do who talk, metres.
        pace: how fast it goes to the right, degrees a second; at ``turn`` it comes back.
        turn: how far to either side of its bearing it goes, degrees.
        phase: seconds that its swaying is ahead of the clock.
    """

    picture: Any
    distance: float = 1.5
    bearing: float = 0.0
    height: float = 1.2
    up: float = -0.2
    sway: float = 0.0
    pace: float = 0.0
    turn: float = 60.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        if self.distance <= 0 or self.height <= 0 or self.turn <= 0 or min(self.sway, self.pace) < 0:
            raise ValueError(
                f"a person is at a distance above 0 and has a height, not {self.distance} and {self.height}; turn is "
                f"above 0, sway and pace are not below it, not {self.turn}, {self.sway} and {self.pace}."
            )

    def place(self, time: float) -> tuple[np.ndarray, float]:
        """Return where they are, (right, ahead, up) metres, and in which direction, degrees to the right."""
        # To and fro between bearing - turn and bearing + turn.
        gone = (self.pace * time + self.turn) % (4 * self.turn)
        bearing = self.bearing + (gone if gone <= 2 * self.turn else 4 * self.turn - gone) - self.turn
        # Two speeds that do not repeat each other soon.
        clock = 2 * math.pi * (time + self.phase)
        aside = self.sway * (math.sin(0.7 * clock) + 0.5 * math.sin(1.63 * clock)) / 1.5
        rise = self.sway * 0.5 * math.sin(1.13 * clock)
        angle = math.radians(bearing)
        ahead, right = (
            np.array([math.sin(angle), math.cos(angle), 0.0]),
            np.array([math.cos(angle), -math.sin(angle), 0.0]),
        )
        return self.distance * ahead + aside * right + np.array([0.0, 0.0, self.up + rise]), bearing
