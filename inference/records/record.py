"""A record of actions and observations, and the beliefs along it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.distributions import compact
from apmodels.simulation import Values, as_dict

# Up to so many numbers an operation takes less time than it takes to wake a thread.
SMALL = 1 << 17


class Beliefs(Sequence[Any]):
    """The beliefs after each step of a record; one that has not been asked for yet is not made yet."""

    def __init__(self, items: Sequence[Any]):
        self._items = list(items)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        item = self._items[index]
        if isinstance(item, Later):
            item = self._items[index] = item.make(item.step)
        return item

    def __repr__(self) -> str:
        return f"<{len(self)} beliefs>"


@dataclass(frozen=True)
class Later:
    """A belief that ``make`` makes of a step when it is asked for."""

    make: Callable[[int], Any]
    step: int


@dataclass(frozen=True)
class Record:
    """What was done and seen, by name: (steps, *shape), or (batch, steps, *shape), where ``at`` says which."""

    steps: int
    actions: Values
    seen: Values
    at: dict[str, int]

    @classmethod
    def of(cls, engine: Any, actions: Any, observations: Any) -> Record:
        """Read what a user gave."""
        acts = as_dict(actions, engine.model.action_names, "action", engine.dtype)
        seen = as_dict(observations, engine.model.observation_names, "observation", engine.dtype)
        shapes = {name: space.shape for name, space in engine.spaces.items()} | engine.shown
        # A record without a batch dimension goes for the whole batch.
        at = {name: value.dim() - len(shapes[name]) - 1 for name, value in (acts | seen).items()}
        for name, dim in at.items():
            if dim < 0:
                shape = tuple((acts | seen)[name].shape)
                raise ValueOutOfRange(
                    f"{engine.labels[name]} has shape {shape}; a record of it has shape (steps, *{shapes[name]})"
                )
        lengths = {name: value.shape[at[name]] for name, value in (acts | seen).items()}
        if len(set(lengths.values())) > 1:
            raise ValueOutOfRange(f"the records differ in their number of steps: {lengths}")
        return cls(next(iter(lengths.values())), acts, seen, at)

    def step(self, t: int) -> tuple[Values | None, Values]:
        """Return the action and the observation of a step as ``update`` wants them."""
        act, see = ({n: v.select(self.at[n], t) for n, v in record.items()} for record in (self.actions, self.seen))
        return act or None, see

    def checked(self, engine: Any, rows: int) -> tuple[Values, Values]:
        """Return all actions and observations, checked, (steps, rows or 1, *shape): 1 where the batch is alike."""
        actions, seen = {}, {}
        if not self.steps:
            return actions, seen
        for name, value in self.actions.items():
            space = engine.spaces[name]
            value = space.check(value, engine.labels[name])
            value = value.to(engine.dtype) if value.is_floating_point() else value
            actions[name] = alike(self._timed(engine, name, value, space.shape, rows))
        for name, value in self.seen.items():
            value = self._timed(engine, name, value.to(engine.dtype), engine.shown[name], rows)
            # One sum finds both the infinite and the missing.
            if not math.isfinite(float(value.detach().sum())) and bool(torch.isinf(value).any()):
                where = engine.labels[name]
                raise ValueOutOfRange(f"{where} is infinite in some element; observe a number, or NaN if it is missing")
            engine.check_limits(name, value)
            seen[name] = value
        return actions, seen

    def _timed(self, engine: Any, name: str, value: Tensor, shape: tuple[int, ...], rows: int) -> Tensor:
        engine._batched(name, value.select(self.at[name], 0), shape, rows)
        return value.movedim(self.at[name], 0) if self.at[name] else value.unsqueeze(1)


def alike(value: Tensor) -> Tensor:
    """Return one row of (steps, rows, ...) where all rows are alike."""
    if value.shape[1] > 1 and (value.stride(1) == 0 or bool((value == value[:, :1]).all())):
        return value[:, :1]
    return value


def narrow(value: Tensor) -> Tensor:
    """Keep one row of (rows, ...) that says itself that all are alike."""
    return compact(value) if value.dim() == 1 or (value.shape[0] > 1 and value.stride(0) == 0) else value


def folded(value: Tensor, rows: int) -> Tensor:
    """Return (steps, rows or 1, *shape) as (steps * rows, *shape)."""
    return value.expand(value.shape[0], rows, *value.shape[2:]).flatten(0, 1)


@contextmanager
def alone(numbers: int) -> Iterator[None]:
    """Compute in one thread where operations are small: to wait for another one takes longer, on a busy machine far."""
    threads = torch.get_num_threads()
    if numbers > SMALL or threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
