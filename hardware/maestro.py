"""Hobby servos on a Pololu Maestro, by its compact or its Pololu protocol."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hardware.motors import MotorError
from hardware.servo_bus import Garbled, ServoBus, pace, serial_port
from hardware.servos import Servos

# Commands (Pololu's guide to the Maestro, section 5.e).
SET_TARGET, SET_SPEED, SET_ACCELERATION = 0x84, 0x87, 0x89
GET_POSITION, GET_MOVING, GET_ERRORS = 0x90, 0x93, 0xA1
# Targets are quarters of a microsecond.
QUARTERS = 4
# A step of speed is a quarter of a microsecond in 10 ms.
SPEED = 25.0
# Of the errors, those of a packet that did not come through, and what they are called.
UNHEARD = {0: "a broken byte", 1: "too many bytes", 2: "too many bytes", 3: "a wrong checksum", 4: "an unknown command"}


class Maestro(Servos):
    """Hobby servos on a Maestro's channels.

    A hobby servo does not say where it is: the first move sends it to its middle, as fast as it can. Later ones obey
    ``speed``, and end when the pulse is what it should be; the servo may be a little behind, so let the camera settle.

    Args:
        port: such as ``/dev/ttyACM0``; of a Maestro's two, the command port.
        ids: channels, from 0: (horizontal, vertical) for a head.
        unit: microseconds of pulse for a unit of a command; below 0 the other way; one for all, or one each.
        limits: the least and the greatest pulse from the middle, microseconds; one pair for all, or one each. The
            channel's own limits, set in Maestro Control Center, should be no narrower.
        middle: the pulse that is the middle, microseconds; one for all, or one each.
        speed: microseconds a second at most; 0 is as fast as it can. 1000 is about 90 degrees a second.
        acceleration: 0 (none) to 255, in quarters of a microsecond per 10 ms per 80 ms.
        baud: any by USB; by wire, what the Maestro is set to.
        device: its number (12 when it is new) for the Pololu protocol, where several share a wire; None is the compact
            protocol.
        crc: end each packet with a CRC-7, as the Maestro must be set to expect.
        timeout: seconds without getting nearer, after which a channel is taken to be stuck.
        retries: how often a packet that does not come through is sent again.
        patience: seconds to wait for an answer.

    Raises:
        MotorError: the port, the Maestro or the channel is not there.
    """

    def __init__(
        self,
        port: str,
        ids: Sequence[int] = (0, 1),
        unit: Any = 400.0,
        limits: Any = (-500.0, 500.0),
        middle: Any = 1500.0,
        speed: float = 1000.0,
        acceleration: int = 0,
        baud: int = 115_200,
        device: int | None = None,
        crc: bool = False,
        timeout: float = 1.0,
        retries: int = 3,
        patience: float = 0.05,
    ):
        if not 0 <= acceleration <= 255 or not 0 <= (device or 0) < 128:
            raise MotorError(
                f"A Maestro's acceleration is 0 to 255, its device number 0 to 127, not {acceleration} and {device}."
            )
        bus = MaestroBus(port, ids, speed, acceleration, baud, device, crc, retries, patience)
        super().__init__(bus, QUARTERS, unit, middle, limits, 1.0, timeout, "microseconds")
        # Where a servo is taken to be that has had no pulse.
        bus.told = {motor: int(middle) for motor, middle in zip(bus.ids, self.middle, strict=True)}


class MaestroBus(ServoBus):
    """What ``Maestro`` says on the wire; positions in quarters of a microsecond."""

    def __init__(
        self,
        port: str,
        ids: Sequence[int],
        speed: float,
        acceleration: int,
        baud: int,
        device: int | None,
        crc: bool,
        retries: int,
        patience: float,
    ):
        super().__init__(port, ids, retries)
        self.speed, self.acceleration = pace(speed, SPEED, 0x3FFF), acceleration
        self.device, self.crc = device, crc
        self.told: dict[int, int] = {}
        self.seen: dict[int, int] = {}
        # Whether an answer may still be on its way, for waiting for it was given up or interrupted.
        self.late = False
        self.line = serial_port(self.port, baud, patience)

    def _range(self, motor: int) -> tuple[int, int]:
        # A Maestro does not say a channel's limits. What it remembers from before is not our mistake.
        self._ask(GET_ERRORS, length=2)
        self._ask(GET_POSITION, motor, length=2)
        return QUARTERS * 64, QUARTERS * 3280

    def _state(self, motor: int) -> tuple[int, bool]:
        position = int.from_bytes(self._ask(GET_POSITION, motor, length=2), "little")
        if motor not in self.on:
            return self.told[motor], False
        # Nothing says that a target was heard, but that the pulse changes, and to say it twice does no harm.
        if position != self.told[motor] and position == self.seen.get(motor):
            self._aim(motor, self.told[motor])
        self.seen[motor] = position
        return position, self._ask(GET_MOVING, length=1) != b"\0" and position != self.told[motor]

    def _pace(self, motor: int) -> None:
        self._tell(SET_SPEED, motor, self.speed)
        self._tell(SET_ACCELERATION, motor, self.acceleration)

    def _aim(self, motor: int, position: int) -> None:
        self._tell(SET_TARGET, motor, position)
        self.told[motor] = position

    def _torque(self, motor: int, on: bool) -> None:
        if on:
            # A target is enough.
            return
        self._tell(SET_TARGET, motor, 0)
        if self._ask(GET_POSITION, motor, length=2) != b"\0\0":
            raise Garbled("still has pulses")

    def _shut(self) -> None:
        self.line.close()

    def _tell(self, command: int, motor: int, number: int) -> None:
        """Send a number to a channel, and see that the packet came through."""
        self._send(command, motor, number & 0x7F, number >> 7)
        errors = int.from_bytes(self._ask(GET_ERRORS, length=2), "little")
        heard = [said for bit, said in UNHEARD.items() if errors >> bit & 1]
        if heard:
            raise Garbled(f"heard {heard[0]}")

    def _ask(self, command: int, *data: int, length: int) -> bytes:
        # Answers do not say what they answer: one that comes late must not be taken for the next.
        while self.late and self.line.read(64):
            pass
        self.line.reset_input_buffer()
        self.late = True
        self._send(command, *data)
        answer = self.line.read(length)
        self.late = len(answer) < length
        if len(answer) < length:
            raise Garbled("does not answer")
        return answer

    def _send(self, command: int, *data: int) -> None:
        start = [command] if self.device is None else [0xAA, self.device, command & 0x7F]
        packet = bytes([*start, *data])
        self.line.write(packet + bytes([crc7(packet)]) if self.crc else packet)


def crc7(packet: bytes) -> int:
    """Return the Maestro's checksum of a packet: x⁷ + x³ + 1, the least bit first."""
    crc = 0
    for byte in packet:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x91 >> 1 if crc & 1 else 0)
    return crc
