"""Where is the target, if looking elsewhere costs sight?  The dilemma of section 1.1: see now, or move and see more."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import Normal

from apmodels.planted import Planted
from apmodels.transforms import where
from apmodels.variables import observation, state
from apmodels.visual_search import VisualSearch


class BlindingSearch(VisualSearch):
    """As ``VisualSearch``, but a saccade blinds: nothing is seen in its step, nor in those that follow.

    Args:
        blinded: how many steps a saccade takes the sight of, its own included.
    """

    blinded: int = 2

    @state
    def blind(self, fixation, prev_fixation=0, prev_blind: Any = 0):
        """Steps without sight, this one included."""
        return where(fixation != prev_fixation, self.blinded, (prev_blind - 1).clamp(min=0))

    @observation
    def glimpse(self, target, fixation, blind):
        """What is seen with open eyes, and noise with closed ones."""
        signal = self.acuity(self.grid.distance(target, fixation)) * (blind == 0)
        return Planted(target, Normal(signal, 1.0), Normal(torch.zeros(self.grid.size), 1.0))
