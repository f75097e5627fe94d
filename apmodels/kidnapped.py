"""Where am I now?  Learning to look, by a head that may be carried elsewhere without a word (thesis section 6.5.5)."""

from __future__ import annotations

import torch
from pyro.distributions import Normal
from pyro.distributions.torch import Bernoulli  # type: ignore[attr-defined]

from apmodels.errors import ValueOutOfRange
from apmodels.learning_to_look import LearningToLook
from apmodels.transforms import shift, where
from apmodels.variables import state


class Kidnapped(LearningToLook):
    """Now and then all that was known of the scene is out of sight; how motors work stays as it was.

    One particle keeps the more probable of both: ``belief.values["lost"]`` is 0 or 1. What an image has in common with
    a scene that was seen is weighed against what any image might show, so ``contrast`` should be that of images.

    Args:
        kidnapping: how probable that is at a command.
    """

    kidnapping: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.kidnapping < 1:
            raise ValueOutOfRange(f"kidnapping is a probability above 0 and below 1, not {self.kidnapping}")

    @state
    def lost(self):
        """Whether it is elsewhere now."""
        return Bernoulli(self.kidnapping)

    @state
    def scene(self, lost, prev_scene=LearningToLook.first_scene):
        """What is out there; the scene that was is farther away than the image is large."""
        away = lost * 2.0 * max(self.field) * torch.ones(2)
        return Normal(shift(prev_scene, away, self.brightness), where(lost == 1, self.contrast, self.change)).to_event(
            2
        )
