"""Where is the target that does not keep still?  Visual search with Brownian motion (thesis section 5.5.8)."""

from __future__ import annotations

import torch
from pyro.distributions import Categorical
from torch import Tensor

from apmodels.variables import state, static
from apmodels.visual_search import VisualSearch


class WanderingSearch(VisualSearch):
    """As ``VisualSearch``, but the target may step to a neighbouring cell, up, down, left or right, in every step.

    Args:
        restless: P(it steps); a step that would leave the grid is not made.
    """

    restless: float = 0.1

    @static
    def start(self) -> Categorical:
        """Where the target was before time began."""
        return self.grid.uniform()

    @state
    def target(self, prev_target=start) -> Categorical:
        """The cell that holds the target."""
        return Categorical(self.steps()[prev_target])

    def steps(self) -> Tensor:
        """Return P(to | from), (cells, cells)."""
        cells = self.grid.values()
        near = self.grid.distance(cells[:, None], cells) == 1
        moves = near.to(torch.get_default_dtype()) * self.restless / 4
        return moves + torch.diag(1 - moves.sum(1))

    interest = target
