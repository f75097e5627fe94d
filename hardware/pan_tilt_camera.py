"""A camera on motors: a head in the real world."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hardware.camera import Camera, CameraError
from hardware.motors import Motors


class PanTiltCamera:
    """A body: a command turns the motors from where they are, and the image that follows is what is then seen.

    Motors and camera are closed by ``close()``, or at the end of ``with PanTiltCamera(...) as head:``. Whatever goes
    wrong in a step, torque is off afterwards.

    Args:
        camera: see ``Camera``.
        motors: see ``Motors``; (horizontal, vertical), if there are two.
        settle: seconds to wait after the motors have arrived, until the head no longer trembles.

    Raises:
        CameraError, MotorError: one of them cannot be used; both are closed then.
    """

    def __init__(self, camera: Camera, motors: Motors, settle: float = 0.2):
        self.camera, self.drive, self.settle = camera, motors, settle
        try:
            if not settle >= 0:
                raise CameraError(f"A head settles for 0 seconds or more, not {settle}.")
            self.size: tuple[int, int] = self._image().shape  # type: ignore[assignment]
        except BaseException:
            self.close()
            raise

    @property
    def motors(self) -> int:
        """How many motors there are."""
        return self.drive.count

    def reset(self, seed: int | None = None) -> None:
        """Return to the middle; the world has no seed."""
        self.drive.home()

    def step(self, action: Any) -> Tensor:
        """Turn by a command (motors,) of units, wait, and return the image, (rows, columns) float32, 0 to 1."""
        self.drive.move(action)
        try:
            time.sleep(self.settle)
            return torch.from_numpy(self._image())
        except BaseException:
            # A head that sees nothing should not go on pushing.
            self.drive.relax()
            raise

    def close(self) -> None:
        """Torque off, and let go of both."""
        # The motors first: a camera may be slow to let go.
        try:
            self.drive.close()
        finally:
            self.camera.close()

    def __enter__(self) -> PanTiltCamera:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def _image(self) -> np.ndarray:
        image = np.ascontiguousarray(self.camera.read(), dtype=np.float32)
        if image.ndim != 2 or not image.size:
            raise CameraError(f"A camera's image is (rows, columns), not of shape {image.shape}.")
        return image
