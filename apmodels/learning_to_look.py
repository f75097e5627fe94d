"""How do my commands move my eye, and what is out there?  Learning to look (thesis ch. 6)."""

from __future__ import annotations

import torch
from pyro.distributions import Normal
from torch import Tensor

from apmodels.errors import ValueOutOfRange
from apmodels.model import Model
from apmodels.spaces import Box
from apmodels.transforms import ones, shift, where, window, zeros
from apmodels.variables import action, observation, state, static


class LearningToLook(Model):
    """A camera on motors that nobody has measured, in a scene that nobody has seen.  (thesis ch. 6, eqs 6.16 to 6.25)

    The scene keeps still, and the camera's window moves over it: the thesis's scene in retinal coordinates, without
    moving all of it at every step. Images are of brightness 0 to 1.

    Args:
        motors: how many there are; a command is a number from -1 to 1 for each.
        view: rows and columns of the camera's image, pixels.
        field: rows and columns of the scene; the first look is at its middle.
        gain: standard deviation of what a unit of a command may move, pixels (Table 6.3, Σ_0,A).
        wear: of how that changes from command to command, pixels a unit (Σ_A).
        slip: of how a movement strays, pixels (Σ_M).
        brightness: mean of the scene before it is seen (µ_0,L).
        contrast: its standard deviation (σ_0,L).
        change: of how the scene changes from command to command (σ_L).
        noise: of the camera's pixels, and of all that turning does to them but shift them (σ_Y).
        bias: whether there may also be a movement that is the same whatever the command (eq. 6.7).
    """

    motors: int = 2
    view: tuple[int, int] = (60, 80)
    field: tuple[int, int] = (180, 240)
    gain: float = 500.0
    wear: float = 5.0
    slip: float = 20.0
    brightness: float = 0.5
    contrast: float = 0.5
    change: float = 0.01
    noise: float = 0.1
    bias: bool = False

    def __post_init__(self) -> None:
        if self.motors < 1 or not all(0 < small <= large for small, large in zip(self.view, self.field, strict=True)):
            raise ValueOutOfRange(
                f"there must be a motor or more, and a view no larger than the field, not {self.motors}, {self.view} "
                f"and {self.field}"
            )

    command = action(lambda self: Box(-1.0, 1.0, (self.motors,)))

    @property
    def causes(self) -> int:
        """How many features of a command move what is seen."""
        return self.motors + self.bias

    def features(self, command: Tensor) -> Tensor:
        """Return what of a command moves what is seen, (causes,): the thesis's φ. Override it for another."""
        return torch.cat([command, ones(1)]) if self.bias else command

    @static
    def first_actuation(self):
        """How far a unit of each feature of a command moves what is seen, when born, (2, causes), pixels."""
        return Normal(zeros(2, self.causes), self.gain).to_event(2)

    @static
    def first_scene(self):
        """What is out there, when born."""
        return Normal(self.brightness * ones(*self.field), self.contrast).to_event(2)

    @state
    def actuation(self, prev_actuation=first_actuation):
        """How far a unit of each feature of a command moves what is seen, (2, causes), pixels (eq. 6.25)."""
        return Normal(prev_actuation, self.wear).to_event(2)

    @state
    def motion(self, actuation, command):
        """By how much what is seen moves, (horizontal, vertical), pixels (eq. 6.24)."""
        return Normal(actuation @ self.features(command), self.slip).to_event(1)

    @state
    def gaze(self, motion, prev_gaze=lambda self: zeros(2)):
        """By how much all movements have moved what is seen."""
        return prev_gaze + motion

    @state
    def scene(self, prev_scene=first_scene):
        """What is out there (eq. 6.23)."""
        return Normal(shift(prev_scene, zeros(2), self.brightness), self.change).to_event(2)

    @observation
    def image(self, scene, gaze):
        """What the camera sees (eq. 6.22); what lies outside the scene is as unknown as all was at first."""
        corner = self.middle() - gaze
        spread = where(self.inside(corner), self.noise, (self.noise**2 + self.contrast**2) ** 0.5)
        return Normal(window(scene, corner, self.view, self.brightness), spread).to_event(2)

    def inside(self, corner: Tensor) -> Tensor:
        """Tell which pixels of a view at a corner (horizontal, vertical) lie in the scene, (rows, columns)."""
        left, top = corner.round().unbind(-1)
        rows, columns = torch.arange(self.view[0]) + top, torch.arange(self.view[1]) + left
        return ((rows >= 0) & (rows < self.field[0]))[:, None] & (columns >= 0) & (columns < self.field[1])

    def middle(self) -> Tensor:
        """Return the (horizontal, vertical) corner of a view at the middle of the scene."""
        (rows, columns), (height, width) = self.view, self.field
        return torch.tensor([(width - columns) // 2, (height - rows) // 2], dtype=torch.get_default_dtype())

    interest = actuation
