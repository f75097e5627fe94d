"""What every controller is: a belief becomes an action."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch

from apmodels.spaces import Space
from inference import Belief, Engine, Refusal


class Controller(ABC):
    """Turns beliefs into actions, one for each belief of a batch.

    Args:
        engine: the engine whose beliefs it will see; its model says which actions there are.
        seed: for controllers that draw.
    """

    def __init__(self, engine: Engine, seed: int = 0):
        if not isinstance(engine, Engine):
            raise Refusal(
                f"{type(self).__name__} needs an engine, not a {type(engine).__name__}: inference.choose(model)"
            )
        self.engine = engine
        self.model = engine.model
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode; the same seed draws the same actions."""
        if seed is not None:
            self.generator = torch.Generator().manual_seed(seed)

    @abstractmethod
    def act(self, belief: Belief) -> Any:
        """Return an action (*batch, *shape); a dict by name where the model has several."""

    def only_action(self) -> tuple[str, Space]:
        """Return the model's one action and its space; Refusal where it has none or several."""
        names = self.model.action_names
        if len(names) != 1:
            raise Refusal(f"{type(self).__name__} chooses one action; {type(self.model).__name__} has {names}")
        return names[0], self.model.space(names[0])
