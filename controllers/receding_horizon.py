"""Planning a few steps ahead on the memory of a few steps (thesis section 4.5.1)."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from apmodels import ValueOutOfRange
from controllers.controller import Controller
from controllers.dynamic_programming import DynamicProgramming
from inference import Belief


class RecedingHorizon(Controller):
    """Does what a plan would do that had seen the last few steps only, and had a few more to go.

    What was seen in a step is read from how beliefs change, so that one controller follows one batch of beliefs, step
    by step, from the first one on.

    Args:
        plan: was made, or learned, for ``memory`` + ``lookahead`` steps or more, from any known state.
        memory: how many steps are remembered.
        lookahead: how many steps the plan is asked to look ahead.
    """

    def __init__(self, plan: DynamicProgramming, memory: int, lookahead: int):
        if memory < 0 or lookahead < 1 or memory + lookahead > plan.horizon:
            raise ValueOutOfRange(
                f"a plan over {plan.horizon} steps cannot remember {memory} and look {lookahead} ahead"
            )
        self.maker, self.memory, self.lookahead = plan, memory, lookahead
        super().__init__(plan.engine)

    def reset(self, seed: int | None = None) -> None:
        """Forget everything."""
        super().reset(seed)
        self.steps: deque[np.ndarray] = deque(maxlen=self.memory)
        self.last, self.time = np.zeros(0), 0

    def act(self, belief: Belief) -> Any:
        """Return the plan's action for what is remembered, for each belief."""
        kind, counts = self.maker.mdp.read(belief)
        if not belief.time:
            self.reset()
        elif belief.time != self.time + 1:
            raise ValueOutOfRange(f"beliefs must follow each other: {belief.time} came after {self.time}")
        else:
            self.steps.append(counts - self.last)
        self.last, self.time = counts, belief.time
        seen = sum(self.steps, np.zeros_like(counts))
        return self.maker.chosen(belief, kind, np.asarray(seen), self.left(len(self.steps)))

    def left(self, seen: int) -> int:
        """Return how many steps the plan is asked to look ahead; further, while less than all of memory was seen."""
        return self.lookahead + self.memory - seen

    def __repr__(self) -> str:
        return f"RecedingHorizon({self.maker!r}, memory={self.memory}, lookahead={self.lookahead})"
