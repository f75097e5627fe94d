"""Doing what is expected to tell the most, one step ahead."""

from __future__ import annotations

from typing import Any

import torch

from controllers.controller import Controller
from inference import Belief, Engine, Refusal

# How many units of rounding may lie between equals.
ROUNDING = 64


class GreedyInfomax(Controller):
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
        super().__init__(engine, seed)
        self.name, space = self.only_action()
        if candidates is None and space.size is None:
            raise Refusal(f"{self.name} is a continuum; give GreedyInfomax the candidates to choose from")
        self.candidates = space.values() if candidates is None else space.check(candidates, self.name)
        self.samples = samples

    def act(self, belief: Belief) -> Any:
        """Return the most informative candidate, for each belief; of those equal but for rounding, the first."""
        seed = int(torch.randint(2**31, (), generator=self.generator))
        gain = self.engine.gain(belief, self.candidates, samples=self.samples, seed=seed)
        best = gain.amax(-1, keepdim=True)
        equal = gain >= best - ROUNDING * torch.finfo(gain.dtype).eps * best.abs().clamp(min=1.0)
        return self.candidates[equal.to(torch.uint8).argmax(-1)]
