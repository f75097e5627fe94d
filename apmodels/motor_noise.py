"""Which of my motors can be relied upon?  Signal-dependent noise (thesis sections 6.6.3, 6.6.5 and 6.8.6)."""

from __future__ import annotations

import math

import torch
from pyro.distributions import Normal
from pyro.distributions.torch import HalfNormal  # type: ignore[attr-defined]
from torch import Tensor

from apmodels.errors import ValueOutOfRange
from apmodels.learning_to_look import LearningToLook
from apmodels.model import Model
from apmodels.spaces import Box
from apmodels.transforms import zeros
from apmodels.variables import action, observation, state, static


class MotorNoise(LearningToLook):
    """The farther a motor is told to go, the less is known of where it goes.  (thesis ch. 6, eqs 6.51 to 6.58)

    Each motor strays by itself, M = AU + (N ∘ W)U, which is what the cost of eq. 6.62 needs. The features are the
    motors' own commands.

    Args:
        unsteady: standard deviation of the noise that a unit of a motor's command may have, pixels.
    """

    unsteady: float = 50.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bias or self.unsteady <= 0:
            raise ValueOutOfRange(f"noise is of motors, without a bias, and unsteady is above 0, not {self.unsteady}")

    @static
    def straying(self):
        """The standard deviation that a unit of each motor's command adds, (2, motors), pixels (N)."""
        return HalfNormal(self.unsteady * torch.ones(2, self.motors)).to_event(2)

    @state
    def motion(self, actuation, straying, command):
        """By how much what is seen moves, (horizontal, vertical), pixels (eq. 6.57)."""
        return Normal(actuation @ command, strayed(straying, command, self.slip)).to_event(1)


class NoisyMotors(Model):
    """The same motors, whose movements are seen as they are: for learning their noise from movements that were found.

    Args:
        motors: how many.
        gain: standard deviation of what a unit of a command may move, pixels.
        wear: of how that changes from command to command.
        slip: of how a movement strays, whatever the command, pixels.
        straying: what a unit of each motor's command adds to it, (2, motors), pixels (N).
    """

    motors: int = 2
    gain: float = 500.0
    wear: float = 5.0
    slip: float = 5.0
    straying: Tensor | tuple[tuple[float, ...], ...] | None = None

    command = action(lambda self: Box(-1.0, 1.0, (self.motors,)))

    @static
    def first_actuation(self):
        """How far a unit of each motor's command moves what is seen, when born, (2, motors), pixels."""
        return Normal(zeros(2, self.motors), self.gain).to_event(2)

    @state
    def actuation(self, prev_actuation=first_actuation):
        """Likewise, now."""
        return Normal(prev_actuation, self.wear).to_event(2)

    @observation
    def motion(self, actuation, command):
        """By how much what is seen moves, (horizontal, vertical), pixels."""
        noise = 0.0 if self.straying is None else self.straying
        noise = torch.as_tensor(noise, dtype=command.dtype).expand(2, self.motors)
        return Normal(actuation @ command, strayed(noise, command, self.slip)).to_event(1)

    interest = actuation


class MotorErrors(Model):
    """How far movements end from where they should have, told as the thesis tells it: a Kalman filter (section 6.6.5).

    |m - Au| is seen as if it were Normal about the sum of what every motor adds, which it is not: errors add in
    squares. Its mean is sqrt(2/π) of a standard deviation, and that the thesis leaves out.

    Args:
        motors: how many.
        unsteady: standard deviation of what a unit of each motor's command may add, pixels (Σ_N0).
        fading: of how that changes from command to command (Σ_N).
        spread: of what is seen, pixels.
    """

    motors: int = 2
    unsteady: float = 50.0
    fading: float = 0.5
    spread: float = 20.0

    command = action(lambda self: Box(-1.0, 1.0, (self.motors,)))

    @static
    def first_straying(self):
        """The standard deviation that a unit of each motor's command adds, when born, (2, motors), pixels."""
        return Normal(zeros(2, self.motors), self.unsteady).to_event(2)

    @state
    def straying(self, prev_straying=first_straying):
        """Likewise, now (eq. 6.54)."""
        return Normal(prev_straying, self.fading).to_event(2)

    @observation
    def error(self, straying, command):
        """|m - Au|, (horizontal, vertical), pixels."""
        return Normal(math.sqrt(2 / math.pi) * straying @ command.abs(), self.spread).to_event(1)

    interest = straying


def strayed(straying: Tensor, command: Tensor, slip: float) -> Tensor:
    """Return the standard deviation of a movement, (2,): of each motor's own noise and of a slip."""
    return ((straying**2) @ (command**2) + slip**2).sqrt()
