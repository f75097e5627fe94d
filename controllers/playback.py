"""Doing what was done before."""

from __future__ import annotations

from typing import Any

from apmodels import ValueOutOfRange
from apmodels.simulation import as_dict, as_given, check_actions
from controllers.controller import Controller
from inference import Belief, Engine


class Playback(Controller):
    """Repeats a record of actions, by the belief's own time.

    Args:
        engine: see Controller.
        actions: (steps, *shape) for all, or (batch, steps, *shape); a dict by name where the model has several.
        seed: unused.
    """

    def __init__(self, engine: Engine, actions: Any, seed: int = 0):
        super().__init__(engine, seed)
        self.actions = check_actions(self.model, as_dict(actions, self.model.action_names, "action"))

    def act(self, belief: Belief) -> Any:
        """Return this step's actions; ValueOutOfRange when the record is over."""
        chosen = {}
        for name, value in self.actions.items():
            shape = self.model.space(name).shape
            at = value.dim() - len(shape) - 1
            if belief.time >= value.shape[at]:
                raise ValueOutOfRange(
                    f"the record of {name} has {value.shape[at]} steps; this is step {belief.time + 1}"
                )
            now = value.select(at, belief.time)
            chosen[name] = now if belief.batch is None or at else now.expand(belief.batch, *shape)
        return as_given(chosen)
