"""Doing what is expected to tell the most, one step ahead."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from controllers.one_step import OneStep
from inference import Engine


class GreedyInfomax(OneStep):
    """Chooses the action with the largest expected information about the interest (thesis eq. 5.4).

    The expectation is exact where observations have few outcomes; else it is an average over imagined ones, with
    common random numbers.

    Args:
        engine: any engine that has ``gain``.
        candidates: the actions to choose from, (K, *shape); all of them by default, where they are finite.
        samples: how many observations to imagine for each action.
        seed: for what is imagined.
    """

    def __init__(self, engine: Engine, candidates: Any = None, samples: int = 64, seed: int = 0):
        super().__init__(engine, candidates, seed)
        self.samples = samples

    def worth(self, belief: Any, seed: int) -> Tensor:
        """Return the expected information of each candidate, nats, (*batch, K)."""
        return self.engine.gain(belief, self.candidates, samples=self.samples, seed=seed)
