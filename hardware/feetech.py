"""Feetech servos (STS3215 and kin; SCS) by their serial protocol."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from hardware.motors import MotorError
from hardware.servo_bus import Garbled, ServoBus, pace, serial_port
from hardware.servos import Servos

# The memory table: address, bytes (Feetech's manual of the STS3215).
MIN_POSITION = 9, 2
MAX_POSITION = 11, 2
MODE = 33, 1
TORQUE = 40, 1
GOAL_POSITION = 42, 2
SPEED = 46, 2
# Position, speed, load, voltage, temperature, two of flags, and moving, at once.
STATE = 56, 11

READ, WRITE = 2, 3
FAULTS = {0: "a wrong voltage", 1: "a sensor fault", 2: "overheating", 3: "too high a current", 5: "overload"}
# What differs: order of bytes, steps in a turn, and degrees of it.
SERIES: dict[str, tuple[Literal["little", "big"], int, float]] = {
    "STS": ("little", 4096, 360.0),
    "SCS": ("big", 1024, 300.0),
}


class Feetech(Servos):
    """Feetech servos on a port.

    Args:
        port: such as ``/dev/ttyACM0``.
        ids: of the servos: (horizontal, vertical) for a head.
        unit: degrees that a unit of a command turns a motor; below 0 the other way; one for all, or one each.
        limits: the least and the greatest angle from the middle, degrees; one pair for all, or one each.
        middle: the angle that is the middle, degrees; None is the middle of the turn; one for all, or one each.
        speed: degrees a second at most; 0 is as fast as it can.
        baud: what the servos are set to.
        series: "STS" (also SMS), or "SCS".
        tolerance: degrees that a motor may stand beside where it should.
        timeout: seconds without getting nearer, after which a motor is taken to be stuck.
        retries: how often a packet that does not come through is sent again.
        patience: seconds to wait for an answer.

    Raises:
        MotorError: the port or a motor is not there, is not set to position control, or reports an error.
    """

    def __init__(
        self,
        port: str,
        ids: Sequence[int] = (1, 2),
        unit: Any = 60.0,
        limits: Any = (-90.0, 90.0),
        middle: Any = None,
        speed: float = 180.0,
        baud: int = 1_000_000,
        series: str = "STS",
        tolerance: float = 3.0,
        timeout: float = 1.0,
        retries: int = 3,
        patience: float = 0.05,
    ):
        if series not in SERIES:
            raise MotorError(f"Feetech servos are of the series {' or '.join(SERIES)}, not {series}.")
        _, steps, turn = SERIES[series]
        bus = FeetechBus(port, ids, series, speed * steps / turn, baud, retries, patience)
        super().__init__(bus, steps / turn, unit, turn / 2 if middle is None else middle, limits, tolerance, timeout)


class FeetechBus(ServoBus):
    """What ``Feetech`` says on the wire; speed in steps a second."""

    def __init__(
        self, port: str, ids: Sequence[int], series: str, speed: float, baud: int, retries: int, patience: float
    ):
        super().__init__(port, ids, retries)
        self.series, self.speed = series, pace(speed, 1.0, 0x7FFF)
        self.order: Literal["little", "big"] = SERIES[series][0]
        self.steps = SERIES[series][1]
        self.line = serial_port(self.port, baud, patience)

    def _range(self, motor: int) -> tuple[int, int]:
        if self.series == "STS" and (mode := self._read(motor, MODE)[0]) != 0:
            raise MotorError(
                f"Motor {motor} on {self.port} is in mode {mode}, and is needed in mode 0, position control; set it "
                "with Feetech's debugging program."
            )
        low, high = self._number(self._read(motor, MIN_POSITION)), self._number(self._read(motor, MAX_POSITION))
        # Both 0 is no limit.
        return (0, self.steps - 1) if low == high == 0 else (low, high)

    def _state(self, motor: int) -> tuple[int, bool]:
        state = self._read(motor, STATE)
        return self._number(state[:2]), state[10] == 1

    def _pace(self, motor: int) -> None:
        self._write(motor, SPEED, self.speed)

    def _aim(self, motor: int, position: int) -> None:
        self._write(motor, GOAL_POSITION, position)

    def _torque(self, motor: int, on: bool) -> None:
        self._write(motor, TORQUE, int(on), whatever=not on)

    def _shut(self) -> None:
        self.line.close()

    def _read(self, motor: int, item: tuple[int, int]) -> bytes:
        return self._ask(motor, READ, bytes(item), item[1])

    def _write(self, motor: int, item: tuple[int, int], value: int, whatever: bool = False) -> None:
        self._ask(motor, WRITE, bytes([item[0]]) + value.to_bytes(item[1], self.order), 0, whatever)

    def _ask(self, motor: int, instruction: int, data: bytes, length: int, whatever: bool = False) -> bytes:
        """Send a packet; return the so many bytes that are answered. whatever: an error does not matter."""
        body = bytes([motor, len(data) + 2, instruction]) + data
        # What came too late for the last packet is no answer to this one.
        self.line.reset_input_buffer()
        self.line.write(b"\xff\xff" + body + bytes([_checksum(body)]))
        answer = self.line.read(6 + length)
        if not answer:
            raise Garbled("does not answer")
        if len(answer) < 6 + length or answer[:2] != b"\xff\xff" or answer[2:4] != bytes([motor, length + 2]):
            raise Garbled("answers with something else")
        if _checksum(answer[2:-1]) != answer[-1]:
            raise Garbled("answers with a wrong checksum")
        faults = [fault for bit, fault in FAULTS.items() if answer[4] >> bit & 1]
        if faults and not whatever:
            raise MotorError(
                f"Motor {motor} on {self.port} reports {' and '.join(faults)}: take its load off, let it cool, and "
                "check its power."
            )
        return answer[5:-1]

    def _number(self, data: bytes) -> int:
        """A position: fifteen bits and a sign."""
        number = int.from_bytes(data, self.order)
        return number if number < 0x8000 else 0x8000 - number


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF
