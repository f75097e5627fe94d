"""Doing what stands out most where the interest probably is (Najemnik & Geisler 2009)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from controllers.one_step import OneStep
from inference import Engine


class EntropyLimit(OneStep):
    """Chooses the action with the largest expected discriminability, sum over i of B_i d'²(i, action).

    Najemnik & Geisler's entropy-limit minimisation: on a grid, the belief convolved with d'². Nothing is imagined, so
    nothing is drawn. What d' is of other than Normal elements: see ``Engine.discriminability``.

    Args:
        engine: one that tabulates laws with a baseline that the interest's values share (``inference.Exact``).
        candidates: the actions to choose from, (K, *shape); all of them by default, where they are finite.
        seed: unused.
    """

    def __init__(self, engine: Engine, candidates: Any = None, seed: int = 0):
        super().__init__(engine, candidates, seed)
        # An engine that cannot say refuses here, and not in the middle of an episode.
        engine.discriminability(engine.start(), self.candidates[:1])

    def worth(self, belief: Any, seed: int) -> Tensor:
        """Return the expected d'² of each candidate, (*batch, K)."""
        return self.engine.discriminability(belief, self.candidates)
