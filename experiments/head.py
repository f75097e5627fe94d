"""``apmodels head check``: does each motor of a head move what its camera sees?"""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from experiments import cli
from experiments.head_figure import draw
from hardware import (
    Dynamixel,
    Feetech,
    Maestro,
    OpenCVCamera,
    PanoramaHead,
    PanTiltCamera,
    VideoCamera,
)

SERVOS = {"dynamixel": Dynamixel, "maestro": Maestro, "feetech": Feetech}
# Rows and columns of the images.
SIZE = (240, 320)
# Pixels: what moves less has not moved; noise alone gives 0.7. What comes back to less is back, or to this share of the
# way.
STILL, BACK = 1.5, 0.1
# The peak of the phase correlation, below which two images have nothing in common. Measured in a photograph: where the
# movement is found it is 0.12 to 1, where it is not, or where all is noise, -0.04 to 0.08.
ALIKE = 0.1


class Movement(NamedTuple):
    """What was seen of a motor that moved to and fro; pixels are (right, down)."""

    command: float
    images: tuple[np.ndarray, np.ndarray, np.ndarray]
    pixels: np.ndarray
    left: float
    verdict: str
    good: bool


def main() -> int:
    """Check a head; 1 if something is amiss with a motor."""
    options = _parser().parse_args(sys.argv[1:])
    try:
        with _head(options) as head:
            names = list(head.drive.bus.ids) if not options.simulated else [1, 2]
            head.reset(0)
            movements = [move_to_and_fro(head, motor, options.step) for motor in range(head.motors)]
    except (ValueError, OSError) as error:
        if not cli.is_users(error):
            raise
        cli.fail(str(error))
    # Lines that a program reads are not broken.
    _tell(Console(highlight=False, width=None if sys.stdout.isatty() else 140), movements, names)
    try:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        draw(movements, names).savefig(options.out, dpi=120, format="png")
    except OSError as error:
        cli.fail(f"the figure cannot be written: {error}")
    print(f"wrote {options.out}")
    return 0 if all(movement.good for movement in movements) else 1


def move_to_and_fro(head: Any, motor: int, step: float) -> Movement:
    """Move one motor of a body by ``step`` units and back; return what was seen."""
    command = step * np.eye(head.motors)[motor]
    # In this order: before, after, and back again.
    before, after, again = (np.asarray(head.step(u)) for u in (0 * command, command, -command))
    pixels, alike = shift(before, after)
    rest, alike_again = shift(before, again)
    left = float(np.hypot(*rest))
    verdict, good = _verdict(pixels, left, min(alike, alike_again))
    return Movement(step, (before, after, again), pixels, left, verdict, good)


def shift(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float]:
    """Return by how many pixels, (right, down), an image (rows, columns) has moved, and how alike both are, 0 to 1."""
    window = cv2.createHanningWindow(before.shape[::-1], cv2.CV_32F)
    # OpenCV multiplies the window into what it is given.
    first, second = (np.array(image, np.float32) - np.float32(image.mean()) for image in (before, after))
    if not first.any() or not second.any():
        return np.zeros(2), 0.0
    moved, peak = cv2.phaseCorrelate(first, second, window)
    return np.array(moved), float(peak)


def _verdict(pixels: np.ndarray, left: float, alike: float) -> tuple[str, bool]:
    """Say what a movement did, and whether that is what a motor should do."""
    if alike < ALIKE:
        return "sees something else each time: is it dark, or is --step too large?", False
    far = float(np.hypot(*pixels))
    if far < STILL:
        return "moves nothing: is it plugged in, and the camera on it?", False
    # Within 22 degrees of an axis is along it.
    words = [
        word
        for part, word in zip((*pixels, *-pixels), ("right", "down", "left", "up"), strict=True)
        if part > far * np.sin(np.pi / 8)
    ]
    where = f"moves the image {' and '.join(words)}"
    if left > max(STILL, BACK * far):
        return f"{where}, and does not come back", False
    return where, True


class _Simulated(PanoramaHead):
    """A head in a photograph that is always there, for those who have none."""

    def __init__(self) -> None:
        from skimage.data import coffee

        super().__init__(np.tile(coffee(), (3, 5, 1)), size=SIZE, slip=0.2)

    def __enter__(self) -> _Simulated:
        return self

    def __exit__(self, *error: Any) -> None:
        pass


def _head(options: argparse.Namespace) -> Any:
    if options.simulated:
        return _Simulated()
    kind = next(kind for kind in SERVOS if getattr(options, kind) is not None)
    given = {key: value for key in ("ids", "unit", "baud") if (value := getattr(options, key)) is not None}
    # The camera first: without one there is no need to trouble a motor.
    camera = _camera(options.camera)
    try:
        motors = SERVOS[kind](getattr(options, kind), **given)
    except BaseException:
        camera.close()
        raise
    return PanTiltCamera(camera, motors, options.settle)


def _camera(word: str) -> Any:
    device = re.fullmatch(r"(?:/dev/video)?(\d+)", word)
    if device:
        return OpenCVCamera(int(device[1]), SIZE)
    return OpenCVCamera(word, SIZE) if "://" in word else VideoCamera(word, SIZE, loop=True)


def _tell(console: Console, movements: list[Movement], names: list[int]) -> None:
    table = Table("motor", "command", "pixels right", "pixels down", "back within", "verdict", box=None)
    for name, movement in zip(names, movements, strict=True):
        right, down = movement.pixels
        row = f"{movement.command:+.2f}", f"{right:+.1f}", f"{down:+.1f}", f"{movement.left:.1f}", movement.verdict
        table.add_row(str(name), *row)
    console.print(table)


class _Parser(argparse.ArgumentParser):
    """Complains in one sentence, as everything else here."""

    def error(self, message: str) -> NoReturn:
        cli.fail(f"{message}; see apmodels head check --help")
        raise AssertionError


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="apmodels head", description="Heads: a camera on motors.")
    checks = parser.add_subparsers(required=True, metavar="check", dest="what").add_parser(
        "check",
        help="move each motor a little, and show what the camera saw",
        description="Go to the middle, move each motor a little to and fro, and show what the camera saw of it. "
        "Torque is off afterwards, also after Ctrl-C. The exit code is 1 if a motor does not do what it should.",
    )
    motors = checks.add_mutually_exclusive_group(required=True)
    motors.add_argument("--dynamixel", metavar="PORT", help="Dynamixel X servos on this port, such as /dev/ttyUSB0")
    motors.add_argument("--maestro", metavar="PORT", help="hobby servos on a Pololu Maestro, such as /dev/ttyACM0")
    motors.add_argument("--feetech", metavar="PORT", help="Feetech STS servos on this port")
    motors.add_argument("--simulated", action="store_true", help="a simulated head; nothing needs to be plugged in")
    checks.add_argument("--ids", type=_ids, help="of the servos, or channels: 1,2 (0,1 on a Maestro)")
    checks.add_argument("--baud", type=int, help="the servos' baud rate, if it is not what new ones have")
    checks.add_argument("--unit", type=float, help="degrees (microseconds on a Maestro) of a unit [60; 400]")
    checks.add_argument("--camera", default="0", help="a number, a video file, or the address of a stream [0]")
    checks.add_argument("--step", type=_step, default=0.1, help="how far each motor moves, units [0.1]")
    checks.add_argument("--settle", type=float, default=0.3, help="seconds from a movement to its image [0.3]")
    out = Path("outputs/head/check.png")
    checks.add_argument("--out", type=lambda word: Path(os.path.expanduser(word)), default=out, help=f"figure [{out}]")
    return parser


def _ids(word: str) -> list[int]:
    if not re.fullmatch(r"\d+(,\d+)*", word):
        raise argparse.ArgumentTypeError(f"ids are whole numbers with commas between them, not '{word}'")
    return [int(part) for part in word.split(",")]


def _step(word: str) -> float:
    try:
        step = float(word)
    except ValueError:
        step = np.nan
    if not 0 < abs(step) <= 0.5:
        raise argparse.ArgumentTypeError(f"a step is up to half a unit, either way, and not 0: not '{word}'")
    return step
