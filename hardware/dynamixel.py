"""Dynamixel X servos (XL330, XL430 and kin) by protocol 2."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hardware.motors import MotorError
from hardware.servo_bus import Garbled, ServoBus, library, open_port, pace
from hardware.servos import Servos

# The control table: address, bytes (emanual.robotis.com, XL330-M288-T).
OPERATING_MODE = 11, 1
MAX_POSITION = 48, 4
MIN_POSITION = 52, 4
TORQUE_ENABLE = 64, 1
HARDWARE_ERROR = 70, 1
PROFILE_VELOCITY = 112, 4
GOAL_POSITION = 116, 4
# Moving, moving status, PWM, current, velocity and position, at once.
STATE = 122, 14

STEPS = 4096
# Degrees a second in a step of profile velocity, 0.229 revolutions a minute.
VELOCITY = 0.229 * 6
# The mode that goes to positions within one turn. In others a servo's own limits do not count.
POSITION_MODE = 3
ALERT, BAD_CRC = 128, 3
FAULTS = {0: "a wrong voltage", 2: "overheating", 3: "an encoder fault", 4: "an electrical shock", 5: "overload"}


class Dynamixel(Servos):
    """Dynamixel X servos on a port.

    Args:
        port: such as ``/dev/ttyUSB0``.
        ids: of the servos: (horizontal, vertical) for a head.
        unit: degrees that a unit of a command turns a motor; below 0 the other way; one for all, or one each.
        limits: the least and the greatest angle from the middle, degrees; one pair for all, or one each.
        middle: the angle that is the middle, degrees; one for all, or one each.
        speed: degrees a second at most; 0 is as fast as it can.
        baud: what the servos are set to; 57600 when they are new.
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
        middle: Any = 180.0,
        speed: float = 180.0,
        baud: int = 57_600,
        tolerance: float = 3.0,
        timeout: float = 1.0,
        retries: int = 3,
        patience: float = 0.05,
    ):
        bus = DynamixelBus(port, ids, speed, baud, retries, patience)
        super().__init__(bus, STEPS / 360, unit, middle, limits, tolerance, timeout)


class DynamixelBus(ServoBus):
    """What ``Dynamixel`` says on the wire, by ROBOTIS's own SDK."""

    def __init__(self, port: str, ids: Sequence[int], speed: float, baud: int, retries: int, patience: float):
        super().__init__(port, ids, retries)
        self.sdk = library("dynamixel_sdk")
        self.packets = self.sdk.PacketHandler(2.0)
        self.velocity = pace(speed, VELOCITY, 0x7FFF)
        self.line = _line(self.sdk, self.port, patience)
        if not open_port(self.port, lambda: self.line.setBaudRate(baud)):
            raise MotorError(f"The port {self.port} has no baud rate {baud}; new servos have 57600.")
        # As other ports: a write must not wait for ever, and nobody else may use it.
        self.line.ser.write_timeout = 1.0
        try:
            open_port(self.port, lambda: setattr(self.line.ser, "exclusive", True))
        except MotorError:
            self._shut()
            raise

    def _range(self, motor: int) -> tuple[int, int]:
        mode = self._read(motor, OPERATING_MODE)[0]
        if mode != POSITION_MODE:
            raise MotorError(
                f"Motor {motor} on {self.port} is in mode {mode}, and is needed in mode 3, position control; set it "
                "with the Dynamixel Wizard."
            )
        return _number(self._read(motor, MIN_POSITION)), _number(self._read(motor, MAX_POSITION))

    def _state(self, motor: int) -> tuple[int, bool]:
        state = self._read(motor, STATE)
        return _number(state[10:]), state[0] == 1

    def _pace(self, motor: int) -> None:
        self._write(motor, PROFILE_VELOCITY, self.velocity)

    def _aim(self, motor: int, position: int) -> None:
        self._write(motor, GOAL_POSITION, position)

    def _torque(self, motor: int, on: bool) -> None:
        self._write(motor, TORQUE_ENABLE, int(on), whatever=not on)

    def _shut(self) -> None:
        self.line.closePort()

    def _read(self, motor: int, item: tuple[int, int], whatever: bool = False) -> list[int]:
        self._begin()
        data, result, error = self.packets.readTxRx(self.line, motor, *item)
        self._heed(motor, result, error, whatever)
        if len(data) != item[1]:
            raise Garbled("answers too little")
        return data

    def _write(self, motor: int, item: tuple[int, int], value: int, whatever: bool = False) -> None:
        self._begin()
        data = list(value.to_bytes(item[1], "little", signed=value < 0))
        result, error = self.packets.writeTxRx(self.line, motor, *item, data)
        self._heed(motor, result, error, whatever)

    def _begin(self) -> None:
        # An interrupt in the middle of a packet leaves the SDK in the belief that the port is in use.
        self.line.is_using = False

    def _heed(self, motor: int, result: int, error: int, whatever: bool) -> None:
        """Raise what an answer calls for; whatever: a hardware error does not."""
        if result != self.sdk.COMM_SUCCESS:
            said = {
                self.sdk.COMM_RX_TIMEOUT: "does not answer",
                self.sdk.COMM_RX_CORRUPT: "answers with a wrong checksum",
            }
            raise Garbled(said.get(result, "cannot be written to"))
        if error & ~ALERT == BAD_CRC:
            raise Garbled("was sent a wrong checksum")
        if error & ~ALERT:
            said = self.packets.getRxPacketError(error & ~ALERT).partition("] ")[2].rstrip("!.")
            raise MotorError(f"Motor {motor} on {self.port} refuses: {said[:1].lower()}{said[1:]}.")
        if error & ALERT and not whatever:
            bits = self._read(motor, HARDWARE_ERROR, whatever=True)[0]
            faults = [fault for bit, fault in FAULTS.items() if bits >> bit & 1] or ["an error"]
            raise MotorError(
                f"Motor {motor} on {self.port} reports {' and '.join(faults)}, and lets go: take its load off, let it "
                "cool, and switch its power off and on."
            )


def _line(sdk: Any, port: str, patience: float) -> Any:
    class Line(sdk.PortHandler):
        def setPacketTimeout(self, packet_length: int) -> None:
            # The SDK's own 34 ms are too few for a busy machine.
            self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + 1000 * patience)

    return Line(port)


def _number(data: list[int]) -> int:
    return int.from_bytes(bytes(data), "little", signed=True)
