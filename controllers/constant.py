"""Doing always the same."""

from __future__ import annotations

from typing import Any

from apmodels.simulation import as_dict, as_given, check_actions
from controllers.controller import Controller
from inference import Belief, Engine


class Constant(Controller):
    """Returns one action for ever.

    Args:
        engine: see Controller.
        action: the action, a dict by name where the model has several.
        seed: unused.
    """

    def __init__(self, engine: Engine, action: Any, seed: int = 0):
        super().__init__(engine, seed)
        self.actions = check_actions(self.model, as_dict(action, self.model.action_names, "action"))

    def act(self, belief: Belief) -> Any:
        """Return the action, for each belief."""
        rows = () if belief.batch is None else (belief.batch,)
        return as_given({name: value.expand((*rows, *value.shape)) for name, value in self.actions.items()})
