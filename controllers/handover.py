"""One controller first, then another."""

from __future__ import annotations

from typing import Any

from apmodels import ValueOutOfRange
from controllers.controller import Controller
from inference import Belief


class Handover(Controller):
    """Does what one controller does for some steps, and from then on what another does.

    Args:
        first: acts while fewer than ``steps`` steps have passed.
        steps: when it hands over.
        then: acts from then on; an engine of the same model made both.
    """

    def __init__(self, first: Controller, steps: int, then: Controller):
        if steps < 0:
            raise ValueOutOfRange(f"a controller hands over after 0 steps or more, not {steps}")
        self.first, self.steps, self.then = first, steps, then
        super().__init__(then.engine)

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode."""
        super().reset(seed)
        self.first.reset(seed)
        self.then.reset(seed)

    def act(self, belief: Belief) -> Any:
        """Return the action of whose turn it is."""
        return (self.first if belief.time < self.steps else self.then).act(belief)

    def __repr__(self) -> str:
        return f"Handover({self.first!r}, {self.steps}, {self.then!r})"
