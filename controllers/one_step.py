"""Choosing by what is expected of one step."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from controllers.controller import Controller
from inference import Belief, Engine, Refusal

# How many units of rounding may lie between equals.
ROUNDING = 64


class OneStep(Controller):
    """Chooses the candidate that is worth most, for each belief; subclasses say what one is worth.

    Args:
        engine: see Controller.
        candidates: the actions to choose from, (K, *shape); all of them by default, where they are finite.
        seed: for what is imagined.
    """

    def __init__(self, engine: Engine, candidates: Any = None, seed: int = 0):
        super().__init__(engine, seed)
        self.name, space = self.only_action()
        if candidates is None and space.size is None:
            raise Refusal(f"{self.name} is a continuum; give {type(self).__name__} the candidates to choose from")
        self.candidates = space.values() if candidates is None else space.check(candidates, self.name)

    @abstractmethod
    def worth(self, belief: Any, seed: int) -> Tensor:
        """Return what each candidate is worth, (*batch, K)."""

    def act(self, belief: Belief) -> Any:
        """Return the candidate that is worth most, for each belief; of those equal but for rounding, the first."""
        worth = self.worth(belief, int(torch.randint(2**31, (), generator=self.generator)))
        best = worth.amax(-1, keepdim=True)
        equal = worth >= best - ROUNDING * torch.finfo(worth.dtype).eps * best.abs().clamp(min=1.0)
        return self.candidates[equal.to(torch.uint8).argmax(-1)]
