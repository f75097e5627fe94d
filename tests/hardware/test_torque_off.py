"""Torque is off after a program ends, however it ends: programs in processes of their own, on servos in this one."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.hardware.fake_servos import FakeDynamixel, FakeFeetech, FakeMaestro

# Ctrl-C reaches the program, whatever the tests were started by.
PROGRAM = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
import hardware
motors = hardware.{kind}({port!r}, patience=0.3)
{program}
"""
# Says when it is in the middle of a long movement, or waits after one.
MOVING = "motors.move([0, 0]); print('ready', flush=True); motors.move([1, 1])"
WAITING = "motors.move([0.01, 0.01]); print('ready', flush=True); time.sleep(30)"
KINDS = {"Dynamixel": FakeDynamixel, "Feetech": FakeFeetech, "Maestro": FakeMaestro}


def slow(kind):
    # A unit, 60 degrees or 400 microseconds, takes many seconds.
    return KINDS[kind]() if kind == "Maestro" else KINDS[kind](speed=30.0)


def ended(kind, program, stop=None):
    """Run a program that moves motors; return its exit code, what it complained of, and the fake port."""
    with slow(kind) as port:
        given = "motors.bus.speed = 1\n" if kind == "Maestro" else ""
        text = PROGRAM.format(kind=kind, port=port.name, program=given + program)
        command = [sys.executable, "-c", text]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
        if stop is not None:
            assert process.stdout.readline() == "ready\n", process.communicate()[1]
            time.sleep(0.1)
            assert [servo.torque for servo in port.servos.values()][:2] == [1, 1]
            for number in stop:
                process.send_signal(number)
                time.sleep(0.01)
        _, complaint = process.communicate(timeout=60)
        time.sleep(0.05)
        return process.returncode, complaint, port


@pytest.mark.parametrize("program", [MOVING, WAITING], ids=["moving", "waiting"])
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("kind", KINDS)
def test_signals(kind, stop, program):
    code, complaint, port = ended(kind, program, [stop])
    assert [servo.torques for servo in port.servos.values()][:2] == [[1, 0], [1, 0]]
    # What Python itself does after Ctrl-C, and what a shell makes of the others.
    assert code in (-stop, 128 + stop)
    if stop != signal.SIGINT:
        assert not complaint
    # It was in the middle, indeed.
    assert all(abs(servo.position - servo.goals[0]) < 300 for servo in list(port.servos.values())[:2])


def test_ctrl_c_again_and_again():
    _, _, port = ended("Dynamixel", MOVING, [signal.SIGINT] * 2)
    assert [servo.torque for servo in port.servos.values()] == [0, 0]


@pytest.mark.parametrize(
    ("program", "code"),
    [
        ("motors.move([0, 0])", 0),
        ("motors.move([0, 0]); 1 / 0", 1),
        ("motors.move([0, 0]); sys.exit(7)", 7),
        ("motors.move([0, 0]); motors.move([0, 0, 0])", 1),
        ("with motors:\n    motors.move([0, 0])\n    1 / 0", 1),
    ],
    ids=["end", "exception", "exit", "no_command", "with"],
)
def test_ends(program, code):
    found, _, port = ended("Dynamixel", program)
    assert found == code and [servo.torques for servo in port.servos.values()] == [[1, 0], [1, 0]]


def test_a_program_that_looks_after_signals_itself_is_let_be():
    mine = "signal.signal(signal.SIGTERM, lambda *_: print('mine', file=sys.stderr))\n"
    code, complaint, port = ended("Dynamixel", mine + WAITING.replace("30", "0.3"), [signal.SIGTERM])
    assert code == 0 and complaint == "mine\n"
    assert [servo.torque for servo in port.servos.values()] == [0, 0]
