"""A body made from a model: the world is what the model says it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.laws import Laws
from apmodels.simulation import Worlds, as_dict, as_given, check_actions


class Simulated:
    """Worlds drawn from a model. An agent that holds another model is wrong about its world.

    Args:
        model: what the world is like.
        batch: how many worlds run side by side; None for one, whose actions and observations have no batch.
        given: values of static variables that are fixed instead of drawn, scalars or (batch, *shape).
    """

    def __init__(self, model: Model, batch: int | None = None, given: Mapping[str, Any] | None = None):
        if batch is not None and batch < 1:
            raise ValueOutOfRange(f"a batch of {batch} worlds is empty; give 1 or more, or None")
        self.model = model
        self.batch = batch
        self.given = given
        self.laws = Laws(model)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Draw new worlds; the same seed draws the same ones, whatever else draws in between."""
        with torch.random.fork_rng(devices=[]):
            if seed is None:
                torch.seed()
            else:
                torch.manual_seed(seed)
            self._state = torch.get_rng_state()
        with self._own_randomness():
            self.worlds = Worlds(self.laws, self.batch or 1, self.given)

    def step(self, action: Any = None) -> Any:
        """Act (*batch, *shape) and return the observation; dicts by name where there are several of either."""
        actions = check_actions(self.model, as_dict(action, self.model.action_names, "action"))
        rows = self.batch or 1
        wide = {}
        for name, value in actions.items():
            shape = self.model.space(name).shape
            if tuple(value.shape) not in (shape, (rows, *shape)):
                raise ValueOutOfRange(f"{name} has shape {tuple(value.shape)}; {rows} worlds need {(rows, *shape)}")
            wide[name] = value.expand(rows, *shape)
        with self._own_randomness():
            seen = self.worlds.step(wide)
        return as_given(seen if self.batch is not None else {name: value[0] for name, value in seen.items()})

    def close(self) -> None:
        """Nothing to release."""

    @property
    def truth(self) -> dict[str, Tensor]:
        """The hidden variables as they are now, (*batch, *shape) by name."""
        values = {**self.worlds.statics, **self.worlds.values}
        hidden = [v.name for v in self.model.declaration.of_role("static", "state") if v.name in values]
        return {name: values[name] if self.batch is not None else values[name][0] for name in hidden}

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._state)
            yield
            self._state = torch.get_rng_state()
