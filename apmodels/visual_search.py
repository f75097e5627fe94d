"""Where is the target? Visual search as a control problem, I-POMDP (thesis ch. 5, section 5.4)."""

from __future__ import annotations

import torch
from pyro.distributions import Categorical, Normal

from apmodels.acuity import Acuity, Calibrated
from apmodels.model import Model
from apmodels.planted import Planted
from apmodels.spaces import Grid
from apmodels.variables import action, observation, static


class VisualSearch(Model):
    """Where is the target?  A noisy glimpse of the whole grid per fixation.  (thesis ch. 5, eqs 5.16 and 5.17)"""

    grid: Grid = Grid(11, 11)
    acuity: Acuity = Calibrated()

    fixation = action(lambda self: self.grid)

    @static
    def target(self) -> Categorical:
        """The cell that holds the target."""
        return self.grid.uniform()

    @observation
    def glimpse(self, target, fixation):
        """One number a cell: standard normal noise, plus d' of the eccentricity where the target is."""
        signal = self.acuity(self.grid.distance(target, fixation))
        return Planted(target, Normal(signal, 1.0), Normal(torch.zeros(self.grid.size), 1.0))

    interest = target
