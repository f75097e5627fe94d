"""When do my motors begin to move, and how do they go on?  Learning to look, frame by frame (thesis section 6.6.1)."""

from __future__ import annotations

import torch
from pyro.distributions import Normal
from torch import Tensor

from apmodels.errors import ValueOutOfRange
from apmodels.learning_to_look import LearningToLook
from apmodels.spaces import Binary
from apmodels.transforms import shift, where, zeros
from apmodels.variables import action, state, static


class MotorDynamics(LearningToLook):
    """A movement takes a while, and is watched frame by frame.  (thesis ch. 6, eqs 6.41 to 6.50)

    A step is a frame. ``begin`` is 1 in the frame in which a command is sent, and ``command`` stays the same while its
    movement is watched. How far a unit has moved what is seen is a matter of its own for each frame since the command
    was sent. Wear and change are what they are from command to command, and come frame by frame.

    Args:
        frames: how many frames a movement is watched for (ρ); after the last one it has ended.
    """

    frames: int = 30

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frames < 1:
            raise ValueOutOfRange(f"a movement is watched for 1 frame or more, not {self.frames}")

    begin = action(Binary())

    @static
    def first_actuation(self):
        """How far a unit of each feature of a command has moved what is seen, by frame, (frames, 2, causes), pixels."""
        return Normal(zeros(self.frames, 2, self.causes), self.gain).to_event(3)

    @state
    def actuation(self, prev_actuation=first_actuation):
        """Likewise, now (eq. 6.48)."""
        return Normal(prev_actuation, self.wear / self.frames**0.5).to_event(3)

    @state
    def frame(self, begin, prev_frame=lambda self: self.frames - 1):
        """How many frames ago a command was sent, 0 to frames - 1."""
        return where(begin == 1, 0, (prev_frame + 1).clamp(max=self.frames - 1))

    @state
    def origin(self, begin, prev_gaze=lambda self: zeros(2), prev_origin=lambda self: zeros(2)):
        """Where the gaze was when a command was last sent, (horizontal, vertical), pixels."""
        return where(begin == 1, prev_gaze, prev_origin)

    @state
    def motion(self, actuation, frame, command):
        """By how much what is seen has moved since the command was sent, pixels (eq. 6.47)."""
        return Normal(self.at(actuation, frame) @ self.features(command), self.slip).to_event(1)

    @state
    def gaze(self, motion, origin):
        """By how much all movements have moved what is seen."""
        return origin + motion

    @state
    def scene(self, prev_scene=LearningToLook.first_scene):
        """What is out there."""
        return Normal(shift(prev_scene, zeros(2), self.brightness), self.change / self.frames**0.5).to_event(2)

    def at(self, actuation: Tensor, frame: Tensor) -> Tensor:
        """Return what actuation (frames, 2, causes) says of one frame, (2, causes)."""
        now = torch.arange(self.frames) == frame
        return (actuation * now[:, None, None]).sum(0)
