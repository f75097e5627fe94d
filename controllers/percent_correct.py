"""Doing what makes a guess right most often, one step ahead (Najemnik & Geisler 2005)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from apmodels import ValueOutOfRange
from controllers.one_step import OneStep
from inference import Engine


class PercentCorrect(OneStep):
    """Chooses the action after which the best guess is expected to be right most often, E[max_i B_i].

    Najemnik & Geisler's searcher. The expectation is over the next observation: exact where that has few outcomes; an
    integral over one number where every hypothesis shows in Normal elements of its own, whose error falls as one over
    the square of ``samples`` (0.6 % at 32 on 7×7, 0.15 % at 64); else an average over imagined observations, with
    common random numbers, whose error falls as one over the root of their number.

    Args:
        engine: one whose interest has finitely many values.
        candidates: the actions to choose from, (K, *shape); all of them by default, where they are finite.
        samples: at how many points to integrate, or how many observations to imagine, for each action.
        seed: for what is imagined.
    """

    def __init__(self, engine: Engine, candidates: Any = None, samples: int = 64, seed: int = 0):
        super().__init__(engine, candidates, seed)
        if samples < 1:
            raise ValueOutOfRange(f"PercentCorrect imagines 1 observation or more, not {samples}")
        self.samples = samples
        # An engine that cannot say refuses here, and not in the middle of an episode.
        engine.best_guess(engine.start(), self.candidates[:1], samples=1)

    def worth(self, belief: Any, seed: int) -> Tensor:
        """Return how probably the best guess is right after each candidate, (*batch, K)."""
        return self.engine.best_guess(belief, self.candidates, samples=self.samples, seed=seed)
