"""Motors that do nothing to the eye: a tongue, toes, elbows (thesis section 6.5.4)."""

from __future__ import annotations

from typing import Any

import numpy as np


class PhantomLimbs:
    """A head whose commands have numbers more than it has motors.

    Args:
        head: a body; all but its commands is its own.
        phantoms: how many numbers more, the last of a command.
    """

    def __init__(self, head: Any, phantoms: int = 3):
        if phantoms < 0:
            raise ValueError(f"there are 0 phantoms or more, not {phantoms}.")
        self.head, self.phantoms = head, phantoms

    @property
    def motors(self) -> int:
        """How many numbers a command has."""
        return self.head.motors + self.phantoms

    @property
    def angles(self) -> np.ndarray:
        """Where the head's joints are, degrees."""
        return self.head.angles

    @angles.setter
    def angles(self, degrees: np.ndarray) -> None:
        self.head.angles = degrees

    def step(self, action: Any) -> Any:
        """Turn by a command (motors,), and return the image."""
        return self.head.step(self._own(action))

    def turn(self, action: Any) -> None:
        """Turn by a command (motors,)."""
        self.head.turn(self._own(action))

    def _own(self, action: Any) -> np.ndarray:
        command = np.asarray(action, dtype=float).reshape(-1)
        if command.shape != (self.motors,):
            raise ValueError(f"a command is {self.motors} numbers, one a motor, not {command.tolist()}.")
        return command[: self.head.motors]

    def __getattr__(self, name: str) -> Any:
        if name == "head":  # not there yet, while it is copied or unpickled
            raise AttributeError(name)
        return getattr(self.head, name)
