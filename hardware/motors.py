"""What is said of motors, once: what they do, and what may go wrong."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np


class MotorError(ValueError):
    """Motors that cannot be used; the message is one sentence that names the port and the motor."""


@runtime_checkable
class Motors(Protocol):
    """What turns a head. A unit is what its maker says: a command of 1 moves a motor by one unit."""

    @property
    def count(self) -> int:
        """How many motors there are."""
        ...

    @property
    def limits(self) -> np.ndarray:
        """The least and the greatest place of each motor, (2, count), units from its middle."""
        ...

    def where(self) -> np.ndarray:
        """Return where each motor is, (count,), units from its middle."""
        ...

    def move(self, command: Any) -> np.ndarray:
        """Move each motor from where it is, by (count,) units; wait until all are there.

        Returns:
            By how much each was really told to move, (count,): less than the command at a limit.

        Raises:
            MotorError: the command is none, or a motor does not do what it is told. Its torque is off then.
        """
        ...

    def home(self) -> None:
        """Move each motor to its middle, and wait until all are there; raises as ``move`` does."""
        ...

    def relax(self) -> None:
        """Torque off; the next move turns it on again."""
        ...

    def close(self) -> None:
        """Torque off, and let go of the port; a second time does nothing."""
        ...
