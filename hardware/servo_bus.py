"""Servos on a serial port, below their protocols: tries again, notices a pulled cable, and leaves torque off."""

from __future__ import annotations

import contextlib
import errno
import signal
import sys
import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, TypeVar

from hardware.motors import MotorError

T = TypeVar("T")

try:
    # Flushing a port whose cable is gone raises this, which is no OSError; Windows has no such module.
    _LINK_ERRORS: tuple[type[Exception], ...] = (OSError, import_module("termios").error)
except ImportError:
    _LINK_ERRORS = (OSError,)


class Garbled(Exception):
    """A packet that did not come through, and is worth another try; says what the motor did."""


class ServoBus(ABC):
    """Servos on one port, by id; positions are in the servo's own steps.

    Args:
        port: its name, as the system calls it.
        ids: of the servos.
        retries: how often a packet that does not come through is sent again.

    Attributes:
        on: the ids whose torque is on, or may be.
        lost: whether the cable is gone.
    """

    def __init__(self, port: str, ids: Sequence[int], retries: int):
        self.port, self.ids, self.retries = str(port), tuple(ids), retries
        if not self.ids or len({*self.ids}) < len(self.ids) or retries < 0:
            raise MotorError(f"Motors need ids, all different, and 0 retries or more, not {self.ids} and {retries}.")
        self.on: set[int] = set()
        self.lost = self.closed = False

    @abstractmethod
    def _range(self, motor: int) -> tuple[int, int]:
        """The servo's own limits; also the first that is asked of it."""

    @abstractmethod
    def _state(self, motor: int) -> tuple[int, bool]:
        """Where it is, and whether it moves."""

    @abstractmethod
    def _pace(self, motor: int) -> None:
        """Set how fast it goes."""

    @abstractmethod
    def _aim(self, motor: int, position: int) -> None:
        """Say where to go."""

    @abstractmethod
    def _torque(self, motor: int, on: bool) -> None:
        """Hold, or let go; to let go must work while the servo reports an error."""

    @abstractmethod
    def _shut(self) -> None:
        """Let go of the port."""

    def range(self, motor: int) -> tuple[int, int]:
        """Return a servo's own limits, steps."""
        return self._again(motor, lambda: self._range(motor))

    def state(self, motor: int) -> tuple[int, bool]:
        """Return where a servo is, steps, and whether it moves."""
        return self._again(motor, lambda: self._state(motor))

    def aim(self, motor: int, position: int) -> None:
        """Tell a servo where to go, steps; do not wait."""
        self._again(motor, lambda: self._aim(motor, position))

    def engage(self, motor: int, position: int) -> None:
        """Torque on, at a position."""
        leave_by_exit()
        # First, for an interrupt may come between any two lines.
        self.on.add(motor)
        # Whatever it was told long ago must not make it jump; nor must it hurry, if it is past a limit.
        self._again(motor, lambda: self._pace(motor))
        self.aim(motor, position)
        self._again(motor, lambda: self._torque(motor, True))

    def relax(self) -> None:
        """Torque off wherever it may be on; warns where that is not confirmed, and raises what interrupts it."""
        interrupted: BaseException | None = None
        for motor in sorted(self.on):
            # Somebody who presses Ctrl-C twice wants torque off more than anybody.
            for _ in range(3):
                try:
                    if not self.lost:
                        self._again(motor, lambda m=motor: self._torque(m, False))
                    self.on.discard(motor)
                    break
                except MotorError as error:
                    if not self.lost:
                        warnings.warn(f"{error} Its torque may still be on: cut its power.", stacklevel=3)
                    break
                except (KeyboardInterrupt, SystemExit) as error:
                    interrupted = error
        if interrupted is not None:
            raise interrupted

    def close(self) -> None:
        """Torque off, and let go of the port; a second time does nothing, and a pulled cable does no harm."""
        if self.closed:
            return
        try:
            self.relax()
        finally:
            self.closed = True
            with contextlib.suppress(*_LINK_ERRORS):
                self._shut()

    def _again(self, motor: int, do: Callable[[], T]) -> T:
        """Do something, again if a packet does not come through."""
        if self.closed or self.lost:
            raise MotorError(f"The port {self.port} is closed; make the motors anew.")
        reason: Any = None
        for _ in range(1 + self.retries):
            try:
                return do()
            except Garbled as error:
                reason = error
            except _LINK_ERRORS as error:
                self.lost = True
                raise MotorError(
                    f"The port {self.port} is gone ({_plain(error)}): is its cable plugged in? If motors still hold, "
                    "cut their power."
                ) from None
        raise MotorError(
            f"Motor {motor} on {self.port} {reason}, {1 + self.retries} times in a row: are its power, its id, its "
            "cable and the baud rate right?"
        )


def library(name: str) -> Any:
    """Import an optional library; MotorError says how to install it."""
    try:
        return import_module(name)
    except ImportError:
        raise MotorError("Motors need the extra 'hardware': pip install 'apmodels[hardware]'.") from None


def open_port(port: str, opens: Callable[[], T]) -> T:
    """Open a port; MotorError says why it cannot be opened."""
    try:
        return opens()
    except (*_LINK_ERRORS, ValueError) as error:
        number = getattr(error, "errno", None)
        if number == errno.ENOENT:
            said = "is not there; 'python -m serial.tools.list_ports' lists those that are"
        elif number == errno.EACCES:
            said = "may not be used by this user; on Linux, join its group, which is often dialout"
        elif number == errno.EAGAIN:
            said = "is used by another program"
        else:
            said = f"cannot be used: {_plain(error)}"
        raise MotorError(f"The port {port} {said}.") from None


def serial_port(port: str, baud: int, patience: float) -> Any:
    """Open a port by pyserial; nobody else may use it."""
    serial = library("serial")
    return open_port(port, lambda: serial.Serial(port, baud, timeout=patience, write_timeout=1.0, exclusive=True))


def pace(speed: float, step: float, most: int) -> int:
    """Return a speed in a servo's steps; 0 is as fast as it can, and nothing above 0 becomes that."""
    if not speed >= 0:
        raise MotorError(f"A speed is 0 (as fast as it can) or more, not {speed}.")
    return min(max(1, round(speed / step)), most) if speed > 0 else 0


def leave_by_exit() -> None:
    """Let a SIGTERM or SIGHUP that nobody handles end Python as ``sys.exit`` does, so that torque goes off."""
    if threading.current_thread() is not threading.main_thread():
        return
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda number, frame: sys.exit(128 + number))


def _plain(error: Exception) -> str:
    return str(error.args[-1]).rstrip(".") if error.args else type(error).__name__
