"""Servos end to end: the real libraries, over a pseudo-terminal, to servos that speak the real protocols."""

import gc
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import Dynamixel, Feetech, Maestro, MotorError, Motors
from tests.hardware.fake_servos import FakeDynamixel, FakeFeetech, FakeMaestro, FakePort, crc16

# A busy machine answers late.
PATIENT = {"patience": 0.2}
KINDS = {
    "dynamixel": (FakeDynamixel, Dynamixel),
    "feetech": (FakeFeetech, Feetech),
    "maestro": (FakeMaestro, Maestro),
}


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def start():
    """Makes a fake port and the motors on it, and closes both."""
    made = []

    def start(kind, fake=None, **given):
        fakes, motors = KINDS[kind]
        port = fakes(**(fake or {}))
        made.append(port)
        quick = {"speed": 8000.0} if kind == "maestro" else {}
        made.insert(0, motors(port.name, **(PATIENT | quick | given)))
        return port, made[0]

    yield start
    for thing in made:
        thing.close()


def units(kind, servo):
    """Where a servo really is, in the default units from the default middle."""
    if kind == "maestro":
        return (servo.position / 4 - 1500) / 400
    return (servo.position - 2048) * 360 / 4096 / 60


def test_the_fakes_agree_with_the_makers_examples():
    # emanual.robotis.com, protocol 2: the ping of servo 1, and its answer.
    assert crc16(bytes.fromhex("fffffd00010300 01")) == 0x4E19
    assert crc16(bytes.fromhex("fffffd00010700 5500060426")) == 0x5D65
    # Pololu's guide to the Maestro, section 5.d.
    assert not FakeMaestro.remainder(b"\x83\x01\x17") and FakeMaestro.remainder(b"\x83\x02\x17")
    # Feetech's protocol manual: the ping of servo 1, and its answer.
    with FakeFeetech() as port:
        assert port.answer(bytes.fromhex("ffff010201fb")) == bytes.fromhex("ffff010200fc")
        assert not port.answer(bytes.fromhex("ffff010201fa"))


def test_motors_go_where_they_are_told(kind, start):
    port, motors = start(kind)
    servos = [port.servos[i] for i in motors.bus.ids]
    assert isinstance(motors, Motors) and motors.count == 2
    assert not any(servo.torque for servo in servos)
    told = motors.move([0.5, -0.25])
    assert told == pytest.approx([0.5, -0.25], abs=1e-3)
    assert [units(kind, servo) for servo in servos] == pytest.approx(motors.where(), abs=0.05)
    assert motors.where() == pytest.approx([0.5, -0.25], abs=0.06)
    motors.move([-0.5, 0.25])
    assert [servo.goal for servo in servos] == ([6000] * 2 if kind == "maestro" else [2048] * 2)
    motors.move([0.3, 0.3])
    motors.home()
    assert motors.where() == pytest.approx(0, abs=0.06)
    assert [servo.torques for servo in servos] == [[1], [1]]
    motors.relax()
    assert [servo.torques for servo in servos] == [[1, 0], [1, 0]]
    motors.move([0, 0])
    motors.close()
    motors.close()
    assert [servo.torques for servo in servos] == [[1, 0, 1, 0], [1, 0, 1, 0]]
    with pytest.raises(MotorError, match="closed"):
        motors.move([0, 0])


def test_a_motor_stops_at_its_limit_and_says_so(kind, start):
    port, motors = start(kind, limits=[(-20, 30), (-90, 90)] if kind != "maestro" else [(-100, 200), (-500, 500)])
    low, high = motors.limits
    assert motors.move([5, 0.1]) == pytest.approx([high[0], 0.1], abs=2e-3)
    assert motors.where() == pytest.approx([high[0], 0.1], abs=0.06)
    assert motors.move([5, 0]) == pytest.approx([0, 0])
    assert motors.move([-5, 0]) == pytest.approx([low[0] - high[0], 0])
    servo = port.servos[motors.bus.ids[0]]
    ends = (2048 - 228, 2048 + 342) if kind != "maestro" else (5600, 6800)
    assert min(servo.goals) >= ends[0] and max(servo.goals) <= ends[1]


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_the_servos_own_limits_count(kind, start):
    port, motors = start(kind, {"low": 1900, "high": 2200})
    assert motors.limits == pytest.approx(np.array([[-148, -148], [152, 152]]) * 360 / 4096 / 60)
    motors.move([1, -1])
    assert port.servos[1].position == pytest.approx(2200, abs=35)
    assert max(port.servos[1].goals) == 2200 and min(port.servos[2].goals) == 1900
    with pytest.raises(MotorError, match="leave it no room"):
        start(kind, {"low": 100, "high": 200})


def test_a_unit_below_0_turns_the_other_way(kind, start):
    port, motors = start(kind, unit=[-30.0, 40.0])
    motors.move([0.5, 0.5])
    first, second = (port.servos[i].position - port.servos[i].goals[0] for i in motors.bus.ids)
    assert first < 0 < second
    assert (motors.limits[0] < motors.limits[1]).all()
    assert motors.where() == pytest.approx([0.5, 0.5], abs=0.15)


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_torque_does_not_make_a_motor_jump(kind, start):
    port, motors = start(kind)
    servo = port.servos[1]
    servo.position, servo.goal = 1500, 3000
    motors.move([0, 0])
    assert servo.position == 1500 and servo.goals == [1500, 1500]
    # One that was turned past its limit by hand comes back to it, and no further.
    motors.relax()
    servo.position = 200
    motors.move([0, 0])
    assert servo.goal == 1024


def test_speeds(start):
    port, motors = start("dynamixel", speed=100.0)
    motors.move([0, 0])
    assert port.velocity == {1: 73, 2: 73}
    port, motors = start("feetech", speed=90.0)
    motors.move([0, 0])
    assert port.paces == {1: 1024, 2: 1024}
    port, motors = start("maestro", speed=500.0, acceleration=7)
    motors.move([0, 0])
    assert port.servos[0].speed == 2000 and port.accelerations == {0: 7, 1: 7}
    with pytest.raises(MotorError, match="speed"):
        start("feetech", speed=-1.0)


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_speed_comes_before_the_first_goal_and_torque_after_it(kind, start):
    port, motors = start(kind)
    motors.move([0, 0])
    assert port.servos[1].written == ([112, 116, 64, 116] if kind == "dynamixel" else [46, 42, 40, 42])


def test_scs_servos_put_the_greater_byte_first(start):
    port, motors = start("feetech", {"order": "big", "steps": 1024}, series="SCS")
    motors.move([0.5, 0])
    assert port.servos[1].goal == 512 + round(30 * 1024 / 300)
    assert motors.where() == pytest.approx([0.5, 0], abs=0.06)


@pytest.mark.parametrize("given", [{"device": 12}, {"device": 12, "crc": True}, {"crc": True}])
def test_the_maestros_other_protocols(start, given):
    port, motors = start("maestro", {"crc": "crc" in given}, **given)
    motors.move([0.5, 0])
    assert port.servos[0].position == 6800
    firsts = {packet[0] for packet in port.requests}
    assert firsts == ({0xAA} if "device" in given else {0x84, 0x87, 0x89, 0x90, 0x93, 0xA1})
    with pytest.raises(MotorError, match="does not answer"):
        start("maestro", {"device": 3}, device=4, patience=0.01)


@pytest.fixture(scope="module", params=KINDS)
def wide(request):
    """Servos that let every position pass."""
    fakes, motors = KINDS[request.param]
    span = {"low": -(2**31), "high": 2**31 - 1} if request.param == "dynamixel" else {"low": 0, "high": 0x7FFF}
    crc = {"crc": True} if request.param == "maestro" else {}
    port = fakes(**crc) if request.param == "feetech" else fakes(**span, **crc)
    with motors(port.name, **PATIENT, **crc) as motors:
        yield request.param, port, motors.bus
    port.close()


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_position_comes_through_unharmed(wide, data):
    kind, port, bus = wide
    motor = bus.ids[1]
    # Headers within a packet are what stuffing is for.
    inside = st.sampled_from([-131073, -2, -1, 0, 0x00FDFFFF, 0x7DFFFF00])
    goals = {"dynamixel": st.integers(-(2**31), 2**31 - 1) | inside, "feetech": st.integers(0, 4095)}
    goal = data.draw(goals.get(kind, st.integers(1, 0x3FFF)))
    bus.aim(motor, goal)
    assert port.servos[motor].goal == goal
    seen = {"dynamixel": goal, "feetech": data.draw(st.integers(-0x7FFF, 0x7FFF))}.get(kind)
    if seen is not None:
        port.servos[motor].position = seen
        assert bus.state(motor)[0] == seen


@settings(max_examples=20, deadline=None)
@given(commands=st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 2), min_size=1, max_size=5))
def test_what_was_told_adds_up(commands):
    with FakeDynamixel(speed=1e9) as port, Dynamixel(port.name, **PATIENT) as motors:
        place = np.zeros(2)
        for command in commands:
            told = motors.move(command)
            assert (np.abs(told) <= np.abs(command) + 1e-3).all()
            place = place + told
            assert motors.where() == pytest.approx(place, abs=1e-6)
            assert (np.abs(place) <= 1.5).all()


@pytest.mark.parametrize("fault", ["deaf", "bent", "mute", "garbled"])
def test_packets_that_are_lost_are_sent_again(kind, start, fault):
    crc = {"crc": True} if kind == "maestro" else {}
    port, motors = start(kind, crc, patience=0.1, **crc)
    motors.move([0.1, 0])
    setattr(port, fault, 2)
    motors.move([0.2, 0.1])
    assert getattr(port, fault) == 0
    goals = [port.servos[i].goal for i in motors.bus.ids]
    assert goals == ([6480, 6160] if kind == "maestro" else [2048 + 205, 2048 + 68])
    assert [port.servos[i].torques for i in motors.bus.ids] == [[1], [1]]


@pytest.mark.parametrize("fault", ["deaf", "bent", "mute"])
def test_any_one_packet_may_be_lost(kind, start, fault):
    crc = {"crc": True} if kind == "maestro" else {}
    port, motors = start(kind, crc, patience=0.05, **crc)
    servos = [port.servos[i] for i in motors.bus.ids]
    middle = 6000 if kind == "maestro" else 2048
    # Of a first move and of torque off; 50 are more than those are.
    for skip in range(50):
        for servo in servos:
            servo.position, servo.goal, servo.speed = middle - 48, 0, 1e9
        port.skip = skip
        setattr(port, fault, 1)
        motors.home()
        assert [servo.goal for servo in servos] == [middle, middle]
        assert [servo.torque for servo in servos] == [1, 1]
        # A Maestro does not say what speed it was told: one that it did not hear at all is lost.
        if kind == "maestro" and fault != "deaf":
            assert [servo.speed for servo in servos] == [32_000, 32_000]
        motors.relax()
        assert [servo.torque for servo in servos] == [0, 0]
        if getattr(port, fault):
            break
    assert 10 < skip < 49


def test_a_target_that_a_maestro_does_not_hear_is_told_again(start):
    port, motors = start("maestro")
    motors.move([0, 0])
    # The first packet of a move is the target; the Maestro knows of no error then.
    port.deaf = 1
    motors.move([0.2, 0])
    assert port.deaf == 0 and port.servos[0].goal == 6320


def lasting(port, motors, fault):
    """Move with a fault that does not go away before the move has failed; return what was said."""
    relax = motors.bus.relax

    def healed():
        setattr(port, fault, 0)
        relax()

    setattr(port, fault, 10**6)
    motors.bus.relax = healed
    with pytest.raises(MotorError) as caught:
        motors.move([0.2, 0.1])
    return str(caught.value)


@pytest.mark.parametrize("fault", ["deaf", "mute", "garbled"])
def test_what_is_never_answered_is_one_sentence(kind, start, fault):
    port, motors = start(kind, patience=0.03, retries=2)
    motors.move([0.1, 0])
    said = lasting(port, motors, fault)
    first = motors.bus.ids[0]
    if kind == "maestro" and fault == "garbled":
        # What it sends has no checksum: an error is heard where there is none, or a wrong place.
        assert "Motor 0" in said
    else:
        reason = "a wrong checksum" if fault == "garbled" else "does not answer"
        assert f"Motor {first} on {port.name}" in said and reason in said and "3 times in a row" in said
    assert [port.servos[i].torque for i in motors.bus.ids] == [0, 0]
    motors.move([0.1, 0.1])
    assert [port.servos[i].torque for i in motors.bus.ids] == [1, 1]


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_overload(kind, start):
    port, motors = start(kind)
    motors.move([0.1, 0])
    port.servos[2].overload()
    with pytest.raises(MotorError, match=rf"Motor 2 on {port.name} reports overload"):
        motors.move([0, 0.1])
    assert [servo.torque for servo in port.servos.values()] == [0, 0] and not motors.bus.on
    with pytest.raises(MotorError, match="overload"):
        motors.where()
    # Its power was off.
    port.servos[2].overloaded = False
    assert motors.move([0, 0.1]) == pytest.approx([0, 0.1], abs=1e-3)


def test_something_in_its_way(kind, start):
    port, motors = start(kind, timeout=0.3)
    motors.move([0, 0])
    servo = port.servos[motors.bus.ids[0]]
    servo.stop = servo.position + 100
    with pytest.raises(MotorError, match=rf"Motor {motors.bus.ids[0]} on {port.name} stays .* in its way"):
        motors.move([0.5, 0])
    assert servo.torque == 0
    servo.stop = None
    motors.move([0.2, 0])
    assert servo.torque == 1


def test_a_slow_motor_is_not_stuck_and_one_that_trembles_is_there(start):
    port, motors = start("feetech", {"speed": 800.0}, timeout=0.2)
    begin = time.monotonic()
    motors.move([0.5, 0])
    assert time.monotonic() - begin > 0.35
    port.servos[2].trembles = True
    motors.move([0, 0])
    port.servos[2].stop = 2048
    with pytest.raises(MotorError, match="in its way"):
        motors.move([0, 0.5])


def test_a_cable_that_is_pulled_in_a_movement(kind, start):
    port, motors = start(kind, **({"speed": 1000.0} if kind == "maestro" else {"fake": {"speed": 800.0}}))
    motors.move([0, 0])
    port.pull_past = port.servos[motors.bus.ids[0]].position + 100
    begin = time.monotonic()
    with pytest.raises(MotorError, match=rf"The port {port.name} is gone .*cut their power"):
        motors.move([1, 1])
    assert time.monotonic() - begin < 3 and port.pulled.wait(1)
    with pytest.raises(MotorError, match="closed"):
        motors.move([0, 0])
    begin = time.monotonic()
    motors.relax()
    motors.close()
    motors.close()
    assert time.monotonic() - begin < 1


def test_torque_that_cannot_be_turned_off_is_warned_of(kind, start):
    port, motors = start(kind, patience=0.02, retries=1)
    motors.move([0, 0])
    port.deaf = 10**6
    with pytest.warns(UserWarning, match="torque may still be on: cut its power"):
        motors.relax()
    port.deaf = 0
    motors.close()
    assert not any(servo.torque for servo in port.servos.values())


def test_motors_that_nobody_needs_any_more_let_go(kind, start):
    with KINDS[kind][0]() as port:
        motors = KINDS[kind][1](port.name, **PATIENT)
        motors.move([0, 0])
        assert any(servo.torque for servo in port.servos.values())
        del motors
        gc.collect()
        assert not any(servo.torque for servo in port.servos.values())


@pytest.mark.parametrize("way", ["read", "write"])
def test_an_interrupt_within_a_packet(kind, start, way, monkeypatch):
    port, motors = start(kind)
    motors.move([0, 0])
    line = motors.bus.line
    name = f"{way}Port" if kind == "dynamixel" else way
    works, left = getattr(line, name), [2]

    def interrupted(what):
        # The second finds torque being turned off.
        if left[0]:
            left[0] -= 1
            raise KeyboardInterrupt
        return works(what)

    monkeypatch.setattr(line, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        motors.move([0.1, 0])
    assert [port.servos[i].torque for i in motors.bus.ids] == [0, 0] and left == [0]
    motors.move([0.1, 0])


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_who_is_not_there_or_not_as_it_should_be(kind, start):
    with pytest.raises(MotorError, match=r"Motor 7 on \S+ does not answer"):
        start(kind, ids=(1, 7), patience=0.01)
    with pytest.raises(MotorError, match="in mode 1"):
        start(kind, {"mode": 1})


def test_ports_that_cannot_be_used(kind, start, tmp_path):
    motors = KINDS[kind][1]
    with pytest.raises(MotorError, match=r"/dev/no is not there; .*list_ports"):
        motors("/dev/no")
    (tmp_path / "file").touch()
    with pytest.raises(MotorError, match="cannot be used"):
        motors(str(tmp_path / "file"))
    port, first = start(kind)
    with pytest.raises(MotorError, match="used by another program"):
        motors(port.name)
    first.move([0, 0])
    first.close()
    motors(port.name, **PATIENT).close()


@pytest.mark.parametrize(
    "given",
    [
        {"ids": ()},
        {"ids": (1, 1)},
        {"retries": -1},
        {"unit": 0},
        {"unit": [1, 2, 3]},
        {"limits": (10, -10)},
        {"limits": "wide"},
        {"middle": np.nan},
        {"timeout": 0},
    ],
)
def test_what_makes_no_motors(kind, start, given):
    with pytest.raises(MotorError):
        start(kind, **given)


def test_what_else_makes_no_motors(start):
    for kind, wrong in (
        ("dynamixel", {"baud": 12345}),
        ("feetech", {"series": "XL"}),
        ("maestro", {"acceleration": 256}),
        ("maestro", {"device": 128}),
        ("maestro", {"ids": (0, 6), "patience": 0.01}),
    ):
        with pytest.raises(MotorError):
            start(kind, **wrong)


@pytest.mark.parametrize("command", [[0.1], [0, 0, 0], [np.nan, 0], [np.inf, 0]])
def test_what_is_no_command(start, command):
    port, motors = start("dynamixel")
    motors.move([0, 0])
    with pytest.raises(MotorError, match="2 numbers"):
        motors.move(command)
    assert port.servos[1].torque == 1


def test_without_the_libraries(monkeypatch):
    for library in ("serial", "dynamixel_sdk"):
        monkeypatch.setitem(sys.modules, library, None)
    for _, motors in KINDS.values():
        with pytest.raises(MotorError, match=r"extra 'hardware': pip install"):
            motors("/dev/null")


def test_a_port_forgets_nothing(start):
    # The fakes are what these tests lean on: they hear each packet once, and whole.
    port, motors = start("feetech")
    assert isinstance(port, FakePort) and len(port.requests) == 6
    motors.where()
    assert len(port.requests) == 8
