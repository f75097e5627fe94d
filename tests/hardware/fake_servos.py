"""Servos that speak the real protocols over a pseudo-terminal, move in time, and fail when they are told to.

Written from the makers' documents alone; nothing here is shared with what drives them.
"""

import contextlib
import os
import select
import threading
import time
import tty


class Servo:
    """A motor: it moves toward its goal at its speed while its torque is on.

    ``stop`` is where something is in its way; one that ``trembles`` never stands still. ``torques`` are all values that
    its torque was set to, ``goals`` all its goals, and ``written`` all addresses that were written to.
    """

    def __init__(self, position, low, high, speed):
        self.position, self.goal, self.low, self.high, self.speed = position, position, low, high, speed
        self.torque, self.torques, self.stop, self.overloaded = 0, [], None, False
        self.trembles = False
        self.since = time.monotonic()
        self.goals, self.written = [], []

    def update(self):
        now = time.monotonic()
        reach = self.speed * (now - self.since)
        self.since = now
        if self.torque:
            self.position += min(max(self.goal - self.position, -reach), reach)
            if self.stop is not None:
                self.position = min(self.position, self.stop)

    @property
    def moving(self):
        return bool(self.torque) and (self.trembles or self.position not in (self.goal, self.stop))

    def set_torque(self, on):
        self.update()
        self.torque = int(on)
        self.torques.append(self.torque)

    def set_goal(self, goal):
        self.update()
        self.goal = goal
        self.goals.append(goal)

    def overload(self):
        """As servos do: let go, and say so until the power is off."""
        self.overloaded, self.torque = True, 0


class FakePort:
    """A pseudo-terminal with servos at its other end.

    Faults: ``deaf`` requests are not heard, ``bent`` ones are heard with a wrong bit, ``mute`` answers are not sent,
    ``garbled`` ones have a wrong checksum, each so many times, after ``skip`` requests that are well. ``pull()`` pulls
    the cable, and ``pull_past`` does when a servo is past that position.
    """

    def __init__(self, servos):
        self.servos = servos
        self.deaf = self.bent = self.mute = self.garbled = 0
        self.skip, self.pull_past, self.requests = 0, None, []
        self.buffer = b""
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.name = os.ttyname(self.slave)
        self.pulled = threading.Event()
        self.ending = False
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self):
        with contextlib.suppress(OSError):
            while not self.ending:
                if select.select([self.master], [], [], 0.01)[0]:
                    self.buffer += os.read(self.master, 1024)
                    self.answer_all()
                for servo in self.servos.values():
                    servo.update()
                    if self.pull_past is not None and servo.position > self.pull_past:
                        self.ending = True
        os.close(self.master)
        self.pulled.set()

    def answer_all(self):
        while (found := self.packet()) is not None:
            self.requests.append(found)
            if self.skip:
                self.skip -= 1
                if answer := self.answer(found):
                    os.write(self.master, answer)
                continue
            if self.deaf:
                self.deaf -= 1
                continue
            if self.bent:
                self.bent -= 1
                found = found[:-1] + bytes([found[-1] ^ 0x10])
            answer = self.answer(found)
            if not answer:
                continue
            if self.mute:
                self.mute -= 1
                continue
            if self.garbled:
                self.garbled -= 1
                answer = answer[:-1] + bytes([answer[-1] ^ 0x40])
            os.write(self.master, answer)

    def pull(self):
        """Pull the cable."""
        self.ending = True
        assert self.pulled.wait(5)

    def close(self):
        self.pull()
        os.close(self.slave)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


def crc16(data):
    """ROBOTIS: polynomial x¹⁶ + x¹⁵ + x² + 1, from 0, the greatest bit first."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x8005 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


class FakeDynamixel(FakePort):
    """XL330s by protocol 2, ids from 1."""

    def __init__(self, count=2, speed=20000.0, low=0, high=4095, mode=3, position=2048):
        self.mode, self.velocity = mode, {}
        super().__init__({i + 1: Servo(position, low, high, speed) for i in range(count)})

    def packet(self):
        start = self.buffer.find(b"\xff\xff\xfd\x00")
        if start < 0 or len(self.buffer) < start + 7:
            return None
        length = int.from_bytes(self.buffer[start + 5 : start + 7], "little")
        if len(self.buffer) < start + 7 + length:
            return None
        found, self.buffer = self.buffer[start : start + 7 + length], self.buffer[start + 7 + length :]
        return found

    def answer(self, packet):
        body = packet[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        servo = self.servos.get(packet[4])
        if servo is None:
            return b""
        if crc16(packet[:-2]) != int.from_bytes(packet[-2:], "little"):
            return self.status(packet[4], servo, 3)
        servo.update()
        instruction, data = body[0], body[1:]
        if instruction == 1:
            return self.status(packet[4], servo, 0, (1200).to_bytes(2, "little") + b"\x30")
        address = int.from_bytes(data[:2], "little")
        if instruction == 2:
            length = int.from_bytes(data[2:4], "little")
            return self.status(packet[4], servo, 0, self.table(packet[4], servo)[address : address + length])
        if instruction == 3:
            return self.status(packet[4], servo, self.write(packet[4], servo, address, data[2:]))
        return self.status(packet[4], servo, 2)

    def status(self, name, servo, error, data=b""):
        body = bytes([0x55, error | (0x80 if servo.overloaded else 0)]) + data
        body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = b"\xff\xff\xfd\x00" + bytes([name]) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc16(packet).to_bytes(2, "little")

    def table(self, name, servo):
        table = bytearray(147)
        for address, size, value in (
            (11, 1, self.mode),
            (48, 4, servo.high),
            (52, 4, servo.low),
            (64, 1, servo.torque),
            (70, 1, 0x20 if servo.overloaded else 0),
            (112, 4, self.velocity.get(name, 0)),
            (116, 4, int(servo.goal)),
            (122, 1, int(servo.moving)),
            (132, 4, round(servo.position)),
        ):
            table[address : address + size] = value.to_bytes(size, "little", signed=value < 0)
        return bytes(table)

    def write(self, name, servo, address, data):
        value = int.from_bytes(data, "little", signed=True)
        servo.written.append(address)
        match address, len(data):
            case 64, 1:
                # In shutdown it does not take hold again before its power was off.
                servo.set_torque(value and not servo.overloaded)
            case 112, 4:
                self.velocity[name] = value
            case 116, 4:
                if not servo.low <= value <= servo.high:
                    return 6
                servo.set_goal(value)
            case _:
                return 7
        return 0


class FakeFeetech(FakePort):
    """STS3215s, or SCS servos, ids from 1."""

    def __init__(self, count=2, speed=20000.0, order="little", steps=4096, low=None, high=None, mode=0, position=None):
        self.order, self.mode, self.paces = order, mode, {}
        low, high = 0 if low is None else low, steps - 1 if high is None else high
        middle = steps // 2 if position is None else position
        super().__init__({i + 1: Servo(middle, low, high, speed) for i in range(count)})

    def packet(self):
        start = self.buffer.find(b"\xff\xff")
        if start < 0 or len(self.buffer) < start + 4 or len(self.buffer) < start + 4 + self.buffer[start + 3]:
            return None
        end = start + 4 + self.buffer[start + 3]
        found, self.buffer = self.buffer[start:end], self.buffer[end:]
        return found

    def answer(self, packet):
        name, data, servo = packet[2], packet[5:-1], self.servos.get(packet[2])
        # A servo that hears nonsense says nothing.
        if servo is None or (sum(packet[2:]) & 0xFF) != 0xFF:
            return b""
        servo.update()
        if packet[4] == 1:
            return self.status(name, servo)
        if packet[4] == 2:
            return self.status(name, servo, self.table(servo)[data[0] : data[0] + data[1]])
        assert packet[4] == 3
        value = int.from_bytes(data[1:], self.order)
        servo.written.append(data[0])
        match data[0], len(data) - 1:
            case 40, 1:
                servo.set_torque(value and not servo.overloaded)
            case 42, 2:
                servo.set_goal(min(max(value, servo.low), servo.high))
            case 46, 2:
                self.paces[name] = value
            case other:
                raise AssertionError(other)
        return self.status(name, servo)

    def status(self, name, servo, data=b""):
        body = bytes([name, len(data) + 2, 0x20 if servo.overloaded else 0]) + data
        return b"\xff\xff" + body + bytes([0xFF - (sum(body) & 0xFF)])

    def table(self, servo):
        table = bytearray(71)
        position = round(servo.position)
        for address, size, value in (
            (9, 2, servo.low),
            (11, 2, servo.high),
            (33, 1, self.mode),
            (40, 1, servo.torque),
            (42, 2, int(servo.goal)),
            # Fifteen bits and a sign.
            (56, 2, position if position >= 0 else 0x8000 | -position),
            (66, 1, int(servo.moving)),
        ):
            table[address : address + size] = value.to_bytes(size, self.order)
        return bytes(table)


class FakeMaestro(FakePort):
    """A Mini Maestro with this many channels; positions in quarters of a microsecond, 0 without pulses."""

    LENGTHS = {0x84: 4, 0x87: 4, 0x89: 4, 0x90: 2, 0x93: 1, 0xA1: 1}

    def __init__(self, count=6, low=3968, high=8000, device=12, crc=False):
        self.errors, self.device, self.crc, self.accelerations = 0, device, crc, {}
        # Without a speed the pulse is what it should be at once.
        super().__init__({i: Servo(0, low, high, 1e9) for i in range(count)})

    def packet(self):
        while self.buffer:
            pololu = self.buffer[0] == 0xAA
            if pololu and len(self.buffer) < 3:
                return None
            command = self.buffer[2] | 0x80 if pololu else self.buffer[0]
            if command not in self.LENGTHS:
                self.errors |= 1 << 4
                self.buffer = self.buffer[1:]
                continue
            length = self.LENGTHS[command] + 2 * pololu + self.crc
            if len(self.buffer) < length:
                return None
            found, self.buffer = self.buffer[:length], self.buffer[length:]
            return found
        return None

    def answer(self, packet):
        if self.crc and self.remainder(packet):
            self.errors |= 1 << 3
            return b""
        packet = packet[:-1] if self.crc else packet
        if packet[0] == 0xAA:
            if packet[1] != self.device:
                return b""
            packet = bytes([packet[2] | 0x80]) + packet[3:]
        command, data = packet[0], packet[1:]
        if command == 0xA1:
            errors, self.errors = self.errors, 0
            return errors.to_bytes(2, "little")
        if command == 0x93:
            return bytes([any(servo.moving for servo in self.servos.values())])
        servo = self.servos.get(data[0])
        if servo is None:
            self.errors |= 1 << 4
            return b""
        servo.update()
        if command == 0x90:
            return round(servo.position if servo.torque else 0).to_bytes(2, "little")
        self.set(command, data[0], servo, data[1] | data[2] << 7)
        return b""

    def set(self, command, channel, servo, value):
        if command == 0x87:
            servo.speed = value * 25 * 4 if value else 1e9
        elif command == 0x89:
            self.accelerations[channel] = value
        elif value == 0:
            servo.set_torque(False)
        else:
            servo.set_goal(min(max(value, servo.low), servo.high))
            if not servo.torque:
                # Nothing is known of before: the pulse is there at once.
                servo.position = servo.goal
                servo.set_torque(True)

    @staticmethod
    def remainder(packet):
        """Of the packet with its CRC, as a polynomial, the least bit of every byte first; 0 if all is well."""
        bits = [byte >> i & 1 for byte in packet for i in range(8)][:-1]
        for i in range(len(bits) - 7):
            if bits[i]:
                bits[i : i + 8] = [a ^ b for a, b in zip(bits[i : i + 8], (1, 0, 0, 0, 1, 0, 0, 1), strict=True)]
        return any(bits)
