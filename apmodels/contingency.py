"""Is anybody answering me? Contingency detection as a control problem (thesis ch. 4)."""

from __future__ import annotations

import torch
from pyro.distributions import Beta
from pyro.distributions.torch import Bernoulli  # type: ignore[attr-defined]

from apmodels.errors import ValueOutOfRange
from apmodels.model import Model
from apmodels.spaces import Binary
from apmodels.transforms import where
from apmodels.variables import action, observation, state, static

Pair = tuple[float, float]


class Contingency(Model):
    """Is anybody answering me?  One call and one sound, or silence, per step.  (thesis ch. 4, eqs 4.22 to 4.37)

    Sounds have three causes, each with a rate of its own: the robot's echo while it hears itself, an answer while one
    could come, and the background. Where nobody answers, the background sounds all the time.

    Of the thesis's fifteen parameters (section 4.8.2) twelve are here; the threshold of the sound belongs to the
    microphone, the horizon to the controller.

    Args:
        presence: P(responsive), before any data.
        echo: first and last step after a call in which the robot hears itself.
        window: first and last step after a call in which an answer may come; after the echo.
        echoing: Beta prior of the echo's rate: pseudo-counts of sounds and of silences.
        answering: of the answers' rate.
        background: of the background's rate.
        period: seconds a step takes.
    """

    presence: float = 0.01
    echo: tuple[int, int] = (0, 0)
    window: tuple[int, int] = (1, 3)
    echoing: Pair = (1.0, 1.0)
    answering: Pair = (1.0, 1.0)
    background: Pair = (1.0, 1.0)
    period: float = 0.8

    vocalize = action(Binary())

    def __post_init__(self) -> None:
        super().__post_init__()
        first, last = self.echo
        if not 0 <= first <= last < self.window[0] <= self.window[1]:
            raise ValueOutOfRange(
                f"Contingency hears itself from {first} to {last} and answers from {self.window[0]} to "
                f"{self.window[1]} steps after a call; the echo must end before answers begin"
            )

        if not isinstance(self.period, (int, float)) or not self.period > 0:
            raise ValueOutOfRange(f"a period is seconds, and more than none, not {self.period}")

    @static
    def responsive(self):
        """Whether somebody answers."""
        return Bernoulli(self.presence)

    @static
    def rates(self):
        """How often the echo, an answer and the background are heard, in steps in which they may be."""
        sounds, silences = torch.tensor([self.echoing, self.answering, self.background]).mT
        return Beta(sounds, silences).to_event(1)

    @state
    def timer(self, vocalize, prev_timer=lambda self: self.window[1] + 1):
        """Steps since the last call, up to the first in which no answer can come any more."""
        return where(vocalize == 1, 0, (prev_timer + 1).clamp(max=self.window[1] + 1))

    @observation
    def sound(self, responsive, rates, timer):
        """Whether there was a sound."""
        echoing = (self.echo[0] <= timer) & (timer <= self.echo[1])
        answering = (self.window[0] <= timer) & (timer <= self.window[1]) & (responsive == 1)
        return Bernoulli(rates[where(echoing, 0, where(answering, 1, 2))])

    interest = responsive
