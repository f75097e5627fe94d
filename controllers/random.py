"""Acting at random."""

from __future__ import annotations

from typing import Any

import torch

from apmodels.simulation import as_given, seeded
from controllers.controller import Controller
from inference import Belief


class Random(Controller):
    """Draws every action uniformly from its space."""

    def act(self, belief: Belief) -> Any:
        """Return a uniform draw for each belief."""
        shape = () if belief.batch is None else (belief.batch,)
        seed = int(torch.randint(2**31, (), generator=self.generator))
        with seeded(seed):
            return as_given({name: self.model.space(name).sample(shape) for name in self.model.action_names})
