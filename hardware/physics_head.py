"""A head with a camera, made of hinges and servos, that stands in a room: physics by PyBullet (thesis ch. 6)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from hardware.lens import Lens, mean_flow
from hardware.people import Person
from hardware.photo import as_photo
from hardware.room import Room
from hardware.stage import TICK, Stage

# The axis of a hinge that turns the camera to the right, or up; (right, ahead, up).
AXES = {"right": (0.0, 0.0, -1.0), "up": (1.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Joint:
    """A hinge and its servo, which is sprung and damped.

    Args:
        name: what it is called.
        turns: where it turns the camera: "right" or "up".
        gain: degrees that a unit of command is.
        limit: degrees to either side at which it stops.
        offset: from the hinge before it, (right, ahead, up), metres.
        latency: how long a command takes to reach it, seconds.
        quickness: of its servo, radians a second: the natural frequency.
        damping: as a share of what just keeps it from swinging past.
        noise: standard deviation of where it goes, as a share of the way.
        mass: of what it carries, kg.
    """

    name: str
    turns: str
    gain: float
    limit: float = 60.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    latency: float = 0.0
    quickness: float = 30.0
    damping: float = 1.0
    noise: float = 0.0
    mass: float = 0.1

    def __post_init__(self) -> None:
        if self.turns not in AXES or min(self.limit, self.mass, self.quickness) <= 0 or not math.isfinite(self.gain):
            raise ValueError(
                f"a joint turns right or up and its limit, quickness and mass are above 0, not {self.turns}, "
                f"{self.limit}, {self.quickness} and {self.mass}."
            )
        # Quicker than half a tick and the servo would swing ever more.
        if min(self.latency, self.damping, self.noise) < 0 or self.quickness * TICK > 0.5:
            raise ValueError(
                f"a joint's latency, damping and noise are not below 0 and its quickness not above {0.5 / TICK:g}, "
                f"not {self.latency}, {self.damping}, {self.noise} and {self.quickness}."
            )


class PhysicsHead:
    """A body: a command tells every servo how much farther to go; the image is what is seen when it has gone there.

    Args:
        joints: in the order of a command's numbers.
        scene: what is around it: a ``Room``, or what a ``Room`` is made of.
        people: who is there.
        size: rows and columns of the image.
        view: how wide the image is, degrees.
        roll: how much the camera is turned about its axis, degrees.
        distortion: how much of the radius is lost at the corners of the image.
        camera: where it is from the last hinge, (right, ahead, up), metres.
        slip: standard deviation of where a movement ends, pixels in the middle of the image.
        sensor: of a pixel's noise; pixels are 0 to 1.
        period: seconds from a command to the image that ``step`` returns.
        chain: the numbers of the joints from the foot to the camera; by default as they are given.
        unsteady: how much of their own noise the joints have: 0 none, 1 all.
    """

    def __init__(
        self,
        joints: Sequence[Joint],
        scene: Any,
        people: Sequence[Person] = (),
        size: tuple[int, int] = (240, 320),
        view: float = 50.0,
        roll: float = 0.0,
        distortion: float = 0.0,
        camera: tuple[float, float, float] = (0.0, 0.0, 0.0),
        slip: float = 5.0,
        sensor: float = 0.02,
        period: float = 1.0,
        chain: Sequence[int] | None = None,
        unsteady: float = 1.0,
    ):
        if not joints or min(slip, sensor, unsteady) < 0 or period < TICK:
            raise ValueError(
                "a head has joints, noise of 0 or more and a period above 0, not "
                f"{slip}, {sensor}, {unsteady} and {period}."
            )
        self.joints, self.camera = list(joints), np.array(camera, dtype=float)
        self.chain = list(range(len(joints)) if chain is None else chain)
        if sorted(self.chain) != list(range(len(joints))):
            raise ValueError(f"a chain names each of {len(joints)} joints once, not {self.chain}.")
        links = [self.joints[j] for j in self.chain]
        self.lens = Lens(size, view, roll, distortion)
        self.size, self.slip, self.sensor, self.period = self.lens.size, slip, sensor, period
        self.gains = np.array([joint.gain for joint in self.joints])
        self.limits = np.array([joint.limit for joint in self.joints])
        self.noise = unsteady * np.array([joint.noise for joint in self.joints])
        self.stiffness = np.array([joint.quickness for joint in self.joints]) ** 2
        self.damping = 2 * np.array([joint.damping * joint.quickness for joint in self.joints])
        # What jogs the camera itself, in each direction: the last joint that turns it so.
        self.last = {self.joints[j].turns: j for j in self.chain}
        self.stage = Stage()
        offsets = [np.array(link.offset, dtype=float) for link in links]
        # With all joints in the middle, the camera is where a room's places are counted from.
        self.foot = -sum(offsets) - self.camera
        self.offsets = [self.foot + offsets[0], *offsets[1:]]
        axes = [list(AXES[link.turns]) for link in links]
        self.body = self.stage.chain(axes, self.offsets, [link.mass for link in links])
        self.inertia = self._by_joint(self.stage.inertia(self.body, len(links)))
        self._walls: list[int] = []
        self._cards: list[int] = []
        self.enter(scene)
        self.gather(people)
        self.reset(0)

    @property
    def motors(self) -> int:
        """How many motors there are."""
        return len(self.joints)

    @property
    def angles(self) -> np.ndarray:
        """Where the joints are, degrees, (motors,); set them, and they are there at rest."""
        return np.degrees(self._by_joint(self.stage.joints(self.body, self.motors)[0]))

    @angles.setter
    def angles(self, degrees: np.ndarray) -> None:
        self.target, self.sent = np.array(degrees, dtype=float), []
        self.stage.pose(self.body, np.radians(self.target)[self.chain])

    def reset(self, seed: int | None = None) -> None:
        """Look straight ahead, at rest, at time 0; the same seed draws the same noise."""
        self.random = np.random.default_rng(seed)
        self.angles, self.time = np.zeros(self.motors), 0.0

    def enter(self, scene: Any) -> None:
        """Be in another room from now on; nothing else is told of it."""
        for wall in self._walls:
            self.stage.take_down(wall)
        self.room = scene if isinstance(scene, Room) else Room(scene)
        self._walls = [self.stage.hang(s.corner, s.across, s.down, s.picture) for s in self.room.surfaces]

    def gather(self, people: Sequence[Person]) -> None:
        """Have these people about, and no others."""
        for card in self._cards:
            self.stage.take_down(card)
        self.people = list(people)
        self._cards = [self._card(person) for person in self.people]

    def step(self, action: Any) -> Tensor:
        """Turn by a command (motors,), and return the image, (rows, columns), 0 to 1."""
        self.turn(action)
        return self.look()

    def turn(self, action: Any) -> None:
        """Turn by a command (motors,), and let a period go by."""
        self.send(action)
        self.wait(self.period)

    def send(self, action: Any) -> None:
        """Tell the servos how much farther to go, (motors,), units; a motor stops at its limit."""
        command = np.asarray(action, dtype=float).reshape(-1)
        if command.shape != (self.motors,) or not np.isfinite(command).all():
            raise ValueError(f"a command is {self.motors} numbers, one a motor, not {command.tolist()}.")
        way = self.gains * command * (1 + self.noise * self.random.normal(size=self.motors))
        if command.any():
            for joint in self.last.values():
                way[joint] += math.degrees(self.slip / self.lens.focal) * self.random.normal()
        for joint in np.flatnonzero(way):
            self.sent.append((self.time + self.joints[joint].latency, joint, way[joint]))

    def wait(self, seconds: float) -> None:
        """Let time go by."""
        for _ in range(round(seconds / TICK)):
            for late in [sent for sent in self.sent if sent[0] <= self.time + TICK / 2]:
                self.sent.remove(late)
                _, joint, way = late
                limit = self.limits[joint]
                self.target[joint] = np.clip(self.target[joint] + way, -limit, limit)
            angles, speeds = map(self._by_joint, self.stage.joints(self.body, self.motors))
            pull = self.stiffness * (np.radians(self.target) - angles) - self.damping * speeds
            self.stage.tick(self.body, (self.inertia * pull)[self.chain])
            self.time += TICK

    def frames(self, action: Any, count: int, rate: float = 30.0) -> Tensor:
        """Turn by a command and return what is seen on the way, (count, rows, columns), at ``rate`` images a second."""
        self.send(action)
        begin, seen = self.time, []
        for frame in range(count):
            # Ticks are whole: what one frame is too long by, the next is not.
            self.wait(begin + (frame + 1) / rate - self.time)
            seen.append(self.look())
        return torch.stack(seen)

    def look(self) -> Tensor:
        """Return what is seen now, (rows, columns), 0 to 1."""
        clean = self.render(self.angles)
        noisy = clean + self.sensor * self.random.normal(size=clean.shape).astype(np.float32)
        return torch.from_numpy(np.clip(noisy, 0, 1))

    def render(self, angles: np.ndarray) -> np.ndarray:
        """Return the image without noise with joints at angles, degrees, and the people where they are now."""
        for card, person in zip(self._cards, self.people, strict=True):
            self.stage.put(card, *person.place(self.time))
        place, turn = self.pose(angles)
        flat = self.stage.photograph(place, turn, self.lens.pinhole(), self.lens.focal)
        return self.lens.bend(flat).astype(np.float32) / 255

    @contextmanager
    def noiseless(self) -> Iterator[None]:
        """Let motors do exactly as they are told, for a while."""
        slip, noise = self.slip, self.noise
        self.slip, self.noise = 0.0, np.zeros(self.motors)
        try:
            yield
        finally:
            self.slip, self.noise = slip, noise

    def pose(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the camera is (3,), and its directions (right, ahead, up), a column each (3, 3)."""
        place, turn = np.zeros(3), np.eye(3)
        for joint, offset in zip(self.chain, self.offsets, strict=True):
            place = place + turn @ offset
            turn = turn @ cv2.Rodrigues(np.array(AXES[self.joints[joint].turns]) * math.radians(angles[joint]))[0]
        return place + turn @ self.camera, turn

    def flow(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return how far what is seen moves between angles, (horizontal, vertical) pixels: the mean where both see.

        Of the room, not of the people.
        """
        return mean_flow(self.lens, self._then(self.lens.rays, before, after).astype(np.float32))

    def follow(self, pixel: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return where what was seen at a pixel, (right, down) of the middle, is seen after a turn between angles."""
        return self.lens.pixels(self._then(self.lens.ray(pixel), before, after))

    def spot(self, place: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return where a place in the room (3,), is seen, (right, down) of the image's middle, pixels."""
        camera, turn = self.pose(angles)
        return self.lens.pixels(((place - camera) @ turn)[[0, 2, 1]])

    def close(self) -> None:
        """Let go of the world."""
        self.stage.close()

    def _by_joint(self, linked: np.ndarray) -> np.ndarray:
        """Numbers in the order of the joints, of those in the order of the chain."""
        ordered = np.empty_like(linked)
        ordered[self.chain] = linked
        return ordered

    def _then(self, rays: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Directions (right, up, ahead) after a turn of what was seen along others before it."""
        (here, was), (there, now) = self.pose(before), self.pose(after)
        points = self.room.hit(here, rays[..., [0, 2, 1]].astype(float) @ was.T)
        return ((points - there) @ now)[..., [0, 2, 1]]

    def _card(self, person: Person) -> int:
        image = as_photo(person.picture)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        wide = person.height * grey.shape[1] / grey.shape[0]
        corner = np.array([-wide / 2, 0.0, person.height / 2])
        return self.stage.hang(corner, np.array([wide, 0, 0]), np.array([0, 0, -person.height]), grey)
