"""Looking at a face that moves, with and without knowing how one's own eyes move (thesis section 6.6.1, Fig. 6.10)."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
import xarray as xr
from omegaconf import OmegaConf
from rich.console import Console

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from controllers.gaze_shift import gaze_shift
from experiments import data
from experiments.looking import make_head
from experiments.looking_dynamics import RATE, watched
from experiments.study import Result, remembered
from hardware import CascadeDetector, Person, read_photo

# A quick look: how often the face moves.
QUICK = 4
# Seconds for which a face that goes to and fro is followed.
FOLLOWED = 20.0


def track(config: Any, folder: Path, console: Console) -> Result:
    """Follow a face; see ``conf/experiment/learning_to_look/track.yaml``."""
    moves = QUICK if config.quick else config.moves
    if moves < 1 or config.look_every < 1 or config.rest * RATE < 2 * config.look_every:
        raise ValueOutOfRange(
            f"the face moves once or more, is looked for every frame or less often, and rests for two looks or more, "
            f"not {moves}, {config.look_every} and {config.rest}"
        )
    portraits = data.files("tabler", "avatars/*.jpg")
    if not 0 <= config.face < len(portraits):
        raise ValueOutOfRange(f"portraits are 0 to {len(portraits) - 1}; there is no {config.face}")
    face = _face(portraits[config.face])
    head = make_head(config.head)
    learned = watched(config, folder, head, 0).actuation.values
    found = {}
    for name, knows in (("with", True), ("without", False)):
        setting = [OmegaConf.to_yaml(config.head), OmegaConf.to_yaml(config.model), config.movements, config.seed]
        setting += [moves, config.look_every, config.rest, config.face, config.quick]
        make = lambda k=knows: _tracked(config, head, face, learned, k, moves)  # noqa: E731
        found[name] = remembered(folder, f"track_{name}", setting, make)
    summary = {}
    for name, part in found.items():
        over = overshoots(part, int(config.rest * RATE))
        summary |= {
            f"overshoot.{name}": float(np.median(over)),
            f"overshoot_mean.{name}": float(np.mean(over)),
            f"following_error.{name}": float(part.follow.median()) / head.size[1],
            f"seen.{name}": float(part.seen.mean()),
        }
        console.print(
            f"{name} knowing its dynamics it looks {summary[f'overshoot.{name}']:.0%} too far (median of {moves}); "
            f"a face that goes to and fro is {summary[f'following_error.{name}']:.1%} of the width from the middle "
            "(median)"
        )
    return Result(summary, found, {"track": _draw(found, config.rest)})


def _face(portrait: Path) -> np.ndarray:
    """The face of a portrait, in the middle of a picture twice its size."""
    image = read_photo(portrait)
    boxes = CascadeDetector(min_neighbors=3)(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    if not len(boxes):
        raise ValueOutOfRange(f"no face is found in portrait {portrait.name}; choose another")
    row, column, high, wide = max(boxes, key=lambda box: box[2])
    edge = int(high)
    around = cv2.copyMakeBorder(image, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    top, left = int(row + high / 2), int(column + wide / 2)
    return around[top : top + 2 * int(high), left : left + 2 * int(high)]


def _tracked(config: Any, head: Any, face: np.ndarray, learned: np.ndarray, knows: bool, moves: int) -> xr.Dataset:
    """Where the face is, (right, down) pixels of the image's middle, frame by frame: as it jumps, and to and fro."""
    random = np.random.default_rng(config.seed)
    person = Person(face, distance=2.0, height=0.7, up=0.0)
    head.reset(config.seed)
    head.gather([person])
    eye = Tracker(head, learned, knows, config.look_every)
    jumps, side = [], 1.0
    for _ in tracked(range(moves), "the face moves"):
        # From one side to the other, so that every jump is a large one.
        person.bearing, person.up = side * random.uniform(6, 14), random.uniform(-0.2, 0.2)
        side = -side
        jumps += [eye.frame() for _ in range(int(config.rest * RATE))]
    person.bearing, follow = 0.0, []
    for frame in range(int(FOLLOWED * RATE)):
        person.bearing = 12 * np.sin(2 * np.pi * frame / RATE / 6)
        follow.append(float(np.hypot(*eye.frame())))
    head.gather([])
    return xr.Dataset(
        {
            "place": (("time", "direction"), np.stack(jumps)),
            "follow": ("later", follow),
            "seen": ((), float(np.mean(eye.looks))),
        },
        coords={"time": np.arange(len(jumps)) / RATE, "direction": ["horizontal", "vertical"]},
    )


class Tracker:
    """Looks for a face now and then, and moves to where it is.

    Args:
        head: what moves.
        learned: what a unit of each motor's command has moved what is seen by a frame, (frames, 2, motors), pixels.
        knows: whether it knows how its movements go on: then what is still to come of those under way is counted in,
            and a face that keeps moving by itself is met where it will be.
        every: how many frames pass from look to look.
    """

    def __init__(self, head: Any, learned: np.ndarray, knows: bool, every: int):
        self.head, self.learned, self.knows, self.every = head, learned, knows, every
        self.detector = CascadeDetector(min_neighbors=3)
        self.frames, self.sent, self.looks = 0, [], []
        self.places: list[tuple[int, np.ndarray]] = []
        # Frames until half of the way is gone, of all motors together.
        size = np.linalg.norm(learned, axis=(1, 2))
        self.half = int(np.argmax(size > size[-1] / 2)) + 1

    def frame(self) -> np.ndarray:
        """Let a frame go by; return where the face is before it, (right, down) pixels."""
        person = self.head.people[0]
        place = self.head.spot(person.place(self.head.time)[0], self.head.angles)
        if self.frames % self.every == 0:
            self.look()
        self.head.wait(1 / RATE)
        self.frames += 1
        return place

    def look(self) -> None:
        """Look for the face and send a command."""
        boxes = self.detector((self.head.look().numpy() * 255).astype(np.uint8))
        self.looks.append(len(boxes) > 0)
        if not len(boxes):
            return
        row, column, high, wide = max(boxes, key=lambda box: box[2])
        face = np.array([column + wide / 2, row + high / 2]) - (np.array(self.head.size[::-1]) - 1) / 2
        if self.knows:
            face = face + self.moved(len(self.learned)) - self.moved() + self.ahead(face - self.moved())
        last = torch.as_tensor(self.learned[-1])
        command = gaze_shift(last, torch.zeros(last.shape), torch.as_tensor(-face), -1.0, 1.0).numpy()
        self.head.send(command)
        self.sent.append((self.frames, command))

    def moved(self, later: int = 0) -> np.ndarray:
        """By how much commands have moved what is seen, or will have some frames later, (right, down) pixels."""
        total = np.zeros(2)
        for sent, command in self.sent:
            gone = min(self.frames + later - sent - 1, len(self.learned) - 1)
            if gone >= 0:
                total = total + self.learned[gone] @ command
        return total

    def ahead(self, place: np.ndarray) -> np.ndarray:
        """By how much a face will have moved by itself when a command has gone half its way, (right, down) pixels.

        Args:
            place: where it is now, had the head never moved.
        """
        self.places = [*self.places, (self.frames, place)][-3:]
        if len(self.places) < 3:
            return np.zeros(2)
        speeds = [(q - p) / (b - a) for (a, p), (b, q) in pairwise(self.places)]
        # What jumps does not go on: the lesser of two speeds of the same direction.
        steady = np.sign(speeds[0]) == np.sign(speeds[1])
        return np.where(steady, np.sign(speeds[0]) * np.minimum(*np.abs(speeds)), 0.0) * self.half


def overshoots(part: xr.Dataset, rest: int) -> np.ndarray:
    """Return how far past the face the gaze goes after each of its jumps, as a share of the jump, 0 or more."""
    places = part.place.values.reshape(-1, rest, 2)
    first = places[:, :1]
    gone = ((first - places) * first).sum(-1) / (first**2).sum(-1)
    return np.maximum(gone.max(1) - 1, 0)


def _draw(found: dict[str, xr.Dataset], rest: float) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
    for axis, direction in zip(axes, ("horizontal", "vertical"), strict=True):
        for name, part in found.items():
            shown = part.sel(time=slice(0, 4 * rest))
            axis.plot(shown.time, shown.place.sel(direction=direction), label=f"{name} dynamics")
        axis.axhline(0, color="grey", ls=":")
        axis.set(xlabel="seconds", ylabel="the face, from the middle (pixels)", title=direction)
        axis.legend(fontsize=8)
    return figure
