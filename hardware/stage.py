"""PyBullet, as far as a head needs it: surfaces with pictures, a chain of joints, and what a camera sees."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

# Seconds.
TICK = 1 / 240


def pybullet() -> Any:
    """Return the physics engine."""
    try:
        with _quiet():
            return import_module("pybullet")
    except ImportError:
        raise ImportError("Heads in physics need the extra 'physics': pip install 'apmodels[physics]'.") from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Let nothing be written to standard error, by C code either: the engine tells when it was built."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class Stage:
    """A world of its own; ``close`` lets go of it."""

    def __init__(self) -> None:
        self.engine = pybullet()
        self.client = self.engine.connect(self.engine.DIRECT)
        self.engine.setTimeStep(TICK, physicsClientId=self.client)

    def close(self) -> None:
        """Let go of the world."""
        if self.client >= 0:
            self.engine.disconnect(physicsClientId=self.client)
            self.client = -1

    def __del__(self) -> None:
        # The interpreter may be going, and the engine before it.
        with suppress(Exception):
            self.close()

    def hang(self, corner: np.ndarray, across: np.ndarray, down: np.ndarray, picture: np.ndarray) -> int:
        """Put up a rectangle with a picture, seen from the side where across is to the right; return its number.

        It is not cut into smaller ones: a corner that is exactly beside the camera takes the renderer a second.
        """
        points = [list(corner + u * across + v * down) for v in (0, 1) for u in (0, 1)]
        normal = np.cross(down, across)
        shape = self.engine.createVisualShape(
            self.engine.GEOM_MESH,
            vertices=points,
            # Both ways round: it is seen from either side.
            indices=[0, 1, 2, 1, 3, 2, 0, 2, 1, 1, 2, 3],
            uvs=[[0, 1], [1, 1], [0, 0], [1, 0]],
            normals=[list(normal / np.linalg.norm(normal))] * len(points),
            physicsClientId=self.client,
        )
        body = self.engine.createMultiBody(0, -1, shape, physicsClientId=self.client)
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "picture.png")
            cv2.imwrite(path, cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
            texture = self.engine.loadTexture(path, physicsClientId=self.client)
        self.engine.changeVisualShape(
            body, -1, textureUniqueId=texture, rgbaColor=[1, 1, 1, 1], physicsClientId=self.client
        )
        return body

    def take_down(self, body: int) -> None:
        """Remove what was put up."""
        self.engine.removeBody(body, physicsClientId=self.client)

    def put(self, body: int, place: np.ndarray, bearing: float) -> None:
        """Move something to a place, turned to the right by degrees."""
        turn = self.engine.getQuaternionFromEuler([0, 0, -np.radians(bearing)])
        self.engine.resetBasePositionAndOrientation(body, list(place), turn, physicsClientId=self.client)

    def chain(self, axes: list[list[float]], offsets: list[np.ndarray], masses: list[float]) -> int:
        """Build a chain of hinges, each part balanced about its own; return its number."""
        count = len(axes)
        body = self.engine.createMultiBody(
            0,
            linkMasses=masses,
            linkCollisionShapeIndices=[-1] * count,
            linkVisualShapeIndices=[-1] * count,
            linkPositions=[list(offset) for offset in offsets],
            linkOrientations=[[0, 0, 0, 1]] * count,
            linkInertialFramePositions=[[0, 0, 0]] * count,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * count,
            linkParentIndices=list(range(count)),
            linkJointTypes=[self.engine.JOINT_REVOLUTE] * count,
            linkJointAxis=axes,
            physicsClientId=self.client,
        )
        for link in range(count):
            self.engine.changeDynamics(
                body,
                link,
                localInertiaDiagonal=[0.004 * masses[link]] * 3,
                linearDamping=0,
                angularDamping=0,
                jointDamping=0,
                physicsClientId=self.client,
            )
        # Without this its joints are held still by a motor that nobody asked for.
        self.engine.setJointMotorControlArray(
            body, range(count), self.engine.VELOCITY_CONTROL, forces=[0] * count, physicsClientId=self.client
        )
        return body

    def inertia(self, body: int, joints: int) -> np.ndarray:
        """What each joint has to turn, (joints,), in the pose in which the chain was built."""
        matrix = self.engine.calculateMassMatrix(body, [0.0] * joints, physicsClientId=self.client)
        return np.diag(np.asarray(matrix))

    def joints(self, body: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return angles and speeds of joints, radians and radians a second, (joints,) each."""
        states = self.engine.getJointStates(body, range(count), physicsClientId=self.client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def pose(self, body: int, angles: np.ndarray) -> None:
        """Put joints at angles, radians, at rest."""
        for joint, angle in enumerate(angles):
            self.engine.resetJointState(body, joint, float(angle), 0.0, physicsClientId=self.client)

    def tick(self, body: int, torques: np.ndarray) -> None:
        """Let ``TICK`` seconds go by with torques at the joints, (joints,), N m."""
        control = self.engine.TORQUE_CONTROL
        self.engine.setJointMotorControlArray(
            body, range(len(torques)), control, forces=torques.tolist(), physicsClientId=self.client
        )
        self.engine.stepSimulation(physicsClientId=self.client)

    def photograph(self, place: np.ndarray, turn: np.ndarray, size: tuple[int, int], focal: float) -> np.ndarray:
        """Return what a pinhole camera sees, (rows, columns), uint8.

        Args:
            place: where it is, (3,).
            turn: the directions (right, ahead, up) of the camera, a column each, (3, 3).
            size: rows and columns.
            focal: pixels a radian in the middle of the image.
        """
        rows, columns = size
        view = self.engine.computeViewMatrix(list(place), list(place + turn[:, 1]), list(turn[:, 2]))
        upright = 2 * np.degrees(np.arctan(rows / 2 / focal))
        lens = self.engine.computeProjectionMatrixFOV(upright, columns / rows, 0.05, 60.0)
        seen = self.engine.getCameraImage(
            columns,
            rows,
            view,
            lens,
            shadow=0,
            lightAmbientCoeff=1,
            lightDiffuseCoeff=0,
            lightSpecularCoeff=0,
            renderer=self.engine.ER_TINY_RENDERER,
            flags=self.engine.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.client,
        )
        return np.reshape(np.asarray(seen[2], np.uint8), (rows, columns, 4))[..., 0]
