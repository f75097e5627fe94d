"""Position servos that are moved by units, whatever their protocol."""

from __future__ import annotations

import time
import weakref
from typing import Any

import numpy as np

from hardware.motors import MotorError
from hardware.servo_bus import ServoBus

# Seconds between two looks at servos that move.
POLL = 0.01


class Servos:
    """Motors on a bus. Torque is off until the first move, and after close, any exception in a move, and any exit.

    Args:
        bus: what talks to them.
        scale: servo's steps in a degree, or whatever ``measure`` names.
        unit: degrees that a unit of a command moves a motor; below 0 the other way; one for all, or (count,).
        middle: where the middle is, degrees; likewise.
        limits: the least and the greatest angle from the middle, degrees; one pair for all, or (count, 2). The servos'
            own limits narrow them.
        tolerance: degrees that a motor may stand beside where it should: a load bends it.
        timeout: seconds without getting nearer, after which a motor is taken to be stuck.
        measure: what degrees are called here.
    """

    def __init__(
        self,
        bus: ServoBus,
        scale: float,
        unit: Any,
        middle: Any,
        limits: Any,
        tolerance: float,
        timeout: float,
        measure: str = "degrees",
    ):
        self.bus, self.scale, self.measure = bus, scale, measure
        self.tolerance, self.timeout = tolerance, timeout
        # Closed with the object, and by Python's exit if that is sooner: exceptions and Ctrl-C come by here.
        self._finalizer = weakref.finalize(self, bus.close)
        try:
            self.unit = _each(unit, (self.count,), "unit") * scale
            self.middle = _each(middle, (self.count,), "middle") * scale
            ends = _each(limits, (self.count, 2), "limits").T * scale + self.middle
            own = np.array([bus.range(motor) for motor in bus.ids], dtype=float).T
            self.low, self.high = np.ceil(np.maximum(ends[0], own[0])), np.floor(np.minimum(ends[1], own[1]))
            self._check()
        except BaseException:
            self.close()
            raise
        # Where the motors are told to be; unknown while they are relaxed.
        self.goals: np.ndarray | None = None

    @property
    def count(self) -> int:
        """How many motors there are."""
        return len(self.bus.ids)

    @property
    def limits(self) -> np.ndarray:
        """The least and the greatest place of each motor, (2, count), units from its middle."""
        return np.sort((np.stack([self.low, self.high]) - self.middle) / self.unit, axis=0)

    def where(self) -> np.ndarray:
        """Return where each motor is, (count,), units from its middle."""
        positions = np.array([self.bus.state(motor)[0] for motor in self.bus.ids])
        return (positions - self.middle) / self.unit

    def move(self, command: Any) -> np.ndarray:
        """Move each motor from where it is, by (count,) units; see ``Motors.move``."""
        numbers = np.asarray(command, dtype=float).reshape(-1)
        if numbers.shape != (self.count,) or not np.isfinite(numbers).all():
            raise MotorError(f"A command is {self.count} numbers, one a motor, not {numbers.tolist()}.")
        return self._go(numbers * self.unit, relative=True)

    def home(self) -> None:
        """Move each motor to its middle, and wait until all are there."""
        self._go(self.middle, relative=False)

    def relax(self) -> None:
        """Torque off; the next move turns it on again."""
        self.goals = None
        self.bus.relax()

    def close(self) -> None:
        """Torque off, and let go of the port; a second time does nothing."""
        self.goals = None
        self._finalizer()

    def __enter__(self) -> Servos:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def _check(self) -> None:
        if not self.unit.all() or not self.tolerance >= 0 or not self.timeout > 0:
            raise MotorError("A unit is not 0, a tolerance is 0 or more, and a timeout is above 0.")
        for motor, low, high in zip(self.bus.ids, self.low, self.high, strict=True):
            if not low < high:
                raise MotorError(
                    f"The limits of motor {motor} on {self.bus.port} leave it no room: it is set to turn from "
                    f"{' to '.join(f'{end / self.scale:.0f}' for end in self.bus.range(motor))} {self.measure}."
                )

    def _go(self, steps: np.ndarray, relative: bool) -> np.ndarray:
        try:
            before = self._engaged()
            # Whole steps, or commands to and fro would not end where they began.
            goals = np.clip(steps + before if relative else steps, self.low, self.high).round()
            for motor, goal in zip(self.bus.ids, goals, strict=True):
                self.bus.aim(motor, int(goal))
            self._wait(goals)
        except BaseException:
            self.relax()
            raise
        self.goals = goals
        return (goals - before) / self.unit

    def _engaged(self) -> np.ndarray:
        """Where the motors are told to be, torque on."""
        if self.goals is None:
            goals = np.array([self.bus.state(motor)[0] for motor in self.bus.ids], dtype=float)
            self.goals = np.clip(goals, self.low, self.high)
            for motor, goal in zip(self.bus.ids, self.goals, strict=True):
                self.bus.engage(motor, int(goal))
        return self.goals

    def _wait(self, goals: np.ndarray) -> None:
        """Wait until all motors stand where they should, or one gets no nearer."""
        nearest, since = np.full(self.count, np.inf), np.full(self.count, time.monotonic())
        while True:
            states = [self.bus.state(motor) for motor in self.bus.ids]
            away = np.abs(np.array([position for position, _ in states]) - goals)
            near, moves = away <= max(self.tolerance * self.scale, 1), np.array([moves for _, moves in states])
            since = np.where((near & ~moves) | (away < nearest), time.monotonic(), since)
            nearest, late = np.minimum(nearest, away), time.monotonic() - since > self.timeout
            # One that trembles about its goal is there, sooner or later.
            if (near & (~moves | late)).all():
                return
            stuck = np.flatnonzero(late & ~near)
            if len(stuck):
                raise MotorError(
                    f"Motor {self.bus.ids[stuck[0]]} on {self.bus.port} stays {away[stuck[0]] / self.scale:.0f} "
                    f"{self.measure} from where it was told to go: is something in its way?"
                )
            time.sleep(POLL)


def _each(numbers: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    try:
        found = np.broadcast_to(np.asarray(numbers, dtype=float), shape)
    except ValueError:
        found = np.full(shape, np.nan)
    if not np.isfinite(found).all():
        raise MotorError(f"The motors' {name} must be of shape {shape}, or one for all, not {numbers}.")
    return found.copy()
