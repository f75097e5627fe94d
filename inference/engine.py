"""What every engine does, and the part of it that does not depend on how."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.distributions import words
from apmodels.laws import Laws
from apmodels.simulation import Values, as_dict
from apmodels.structure import Structure
from inference.beliefs import Belief
from inference.records.record import Record


class Refusal(TypeError):
    """An engine cannot serve a model; the message names the variable and the reason."""


@dataclass(frozen=True)
class Bid:
    """How well an engine serves a structure, from 0 (not at all) to 1 (nothing can do better), and why."""

    competence: float
    reason: str

    def __bool__(self) -> bool:
        return self.competence > 0


class Engine(ABC):
    """Turns a model and a history into a belief. It reads the model's structure and never asks which model it is.

    Args:
        model: the model.
        dtype: the precision of beliefs and of the laws, torch's default if None.
    """

    def __init__(self, model: Model, dtype: torch.dtype | None = None):
        if not isinstance(model, Model):
            what = f"the class {model.__name__}" if isinstance(model, type) else f"a {type(model).__name__}"
            raise Refusal(f"{type(self).__name__} needs a model, not {what}; write {type(self).__name__}(MyModel(...))")
        self.model = model
        self.structure: Structure = model.structure
        bid = self.bid(self.structure)
        if not bid:
            raise Refusal(f"{type(self).__name__} cannot serve {type(model).__name__}: {bid.reason}")
        self.laws = Laws(model, dtype)
        self.dtype = self.laws.dtype
        self.spaces = {name: model.space(name) for name in model.action_names}
        # One whole number is the commonest action by far: it is made and checked once.
        first = next(iter(self.spaces.values()), None)
        few = first.values().tolist() if len(self.spaces) == 1 and first.size and first.size <= 4096 else []  # type: ignore[union-attr]
        self._numbers = {n: {model.action_names[0]: torch.tensor([n])} for n in few}
        self.labels = {name: f"{type(model).__name__}.{name}" for name in model.declaration.variables}
        self.shown = {name: self.structure.nodes[name].shape for name in model.observation_names}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.model!r})"

    @classmethod
    @abstractmethod
    def bid(cls, structure: Structure) -> Bid:
        """Say how well this engine serves a structure."""

    @abstractmethod
    def start(self, batch: int | None = None) -> Belief:
        """Return the belief before any data; without ``batch``, a single one."""

    @abstractmethod
    def update(self, belief: Any, action: Any, observation: Any) -> Any:
        """Return the belief after one more action and observation.

        Args:
            belief: unharmed, whatever happens.
            action: a tensor (*batch, *shape), a dict of them by name where the model has several actions, None
                where it has none. One that has no batch dimension goes for the whole batch.
            observation: likewise; NaN elements are missing.

        Raises:
            ValueOutOfRange: an action outside its space, an observation of the wrong shape, infinite or impossible.
        """

    @abstractmethod
    def forecast(self, belief: Any, action: Any) -> Any:
        """Return the predictive distribution of the next observation; a dict by name where there are several."""

    @abstractmethod
    def gain(self, belief: Any, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return the expected information about the interest, in nats, (*batch, K), of each of K actions.

        ``actions`` (K, *shape), all values of a finite action by default. Exact where the observation has few
        outcomes, otherwise an average over ``samples`` imagined observations, with common random numbers.
        """

    def expect(
        self,
        belief: Any,
        worth: Callable[[Tensor], Tensor],
        actions: Any = None,
        samples: int = 64,
        seed: int = 0,
    ) -> Tensor:
        """Return what a function of the next belief about the interest is expected to be, (*batch, K), after K actions.

        ``worth`` takes the log probabilities of the interest's values, (N, n), and returns (N,). Imagines as ``gain``
        does: where it is minus the entropy, what is returned is the gain minus the entropy before.

        Raises:
            Refusal: the interest has no finite list of values.
        """
        raise Refusal(f"{type(self).__name__} imagines no beliefs about the interest")

    def imagine(self, belief: Any, action: Any, samples: int = 64, seed: int = 0) -> tuple[Values, Tensor]:
        """Return what a batch of B beliefs may see next, each after its own action, and how probable that is.

        Returns:
            Observations (B, S, *shape) by name, and weights (B, S): all outcomes with their probabilities where there
            are ``samples`` of them or fewer; else as many draws of equal weight, with common random numbers.
        """
        raise Refusal(f"{type(self).__name__} imagines no observations")

    def best_guess(self, belief: Any, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return how probable the interest's most probable value is expected to be, (*batch, K), after K actions."""
        return self.expect(belief, lambda logs: logs.amax(-1).exp(), actions, samples, seed)

    def discriminability(self, belief: Any, actions: Any = None) -> Tensor:
        """Return sum over the interest's values i of B_i d'²(i, action), (*batch, K), after K actions.

        Raises:
            Refusal: the engine tabulates no laws, or they have no baseline that the hypotheses share.
        """
        raise Refusal(f"{type(self).__name__} has no table of laws to read d' from; use Exact, where it bids")

    def filter(self, actions: Any, observations: Any, batch: int | None = None) -> Sequence[Any]:
        """Return the beliefs after each step of a record, (steps, *shape) or (batch, steps, *shape).

        They are those that ``update`` returns, step by step; but what can be done for all steps at once is.
        """
        return self.along(Record.of(self, actions, observations), batch)

    def along(self, record: Record, batch: int | None) -> Sequence[Any]:
        """Return the beliefs along a record."""
        return self.stepwise(self.start(batch), record)

    def stepwise(self, belief: Any, record: Record, first: int = 0, last: int | None = None) -> list[Any]:
        """Return the beliefs along a record's steps first ... last - 1, each updated from the one before."""
        beliefs = []
        for t in range(first, record.steps if last is None else last):
            belief = self.update(belief, *record.step(t))
            beliefs.append(belief)
        return beliefs

    def names(self, names: str | tuple[str, ...] | None) -> tuple[str, ...]:
        """Return variables' names as a tuple; the interest's where none are given."""
        if names is None:
            return ("interest",) if self.model.declaration.interest else self.structure.interest
        return (names,) if isinstance(names, str) else tuple(names)

    # What users pass, checked and with a batch dimension.

    def _actions(self, action: Any, batch: int) -> Values:
        if type(action) is int and batch == 1 and action in self._numbers:
            return self._numbers[action]
        given = as_dict(action, self.model.action_names, "action", self.dtype)
        checked = {}
        for name, value in given.items():
            space = self.spaces[name]
            value = space.check(value, self.labels[name])
            value = value.to(self.dtype) if value.is_floating_point() else value
            checked[name] = self._batched(name, value, space.shape, batch)
        return checked

    def _observations(self, observation: Any, batch: int) -> Values:
        seen = {}
        for name, value in as_dict(observation, self.model.observation_names, "observation", self.dtype).items():
            value = value if value.dtype == self.dtype else value.to(self.dtype)
            value = self._batched(name, value, self.shown[name], batch)
            seen[name] = value if value.dim() == 2 else value.reshape(batch, -1)
        return seen

    def seen_as(self, observation: Any, rows: int) -> Values:
        """Return observations, checked, as (rows, 1, *shape) by name."""
        flat = self._observations(observation, rows)
        shaped = {}
        for name, value in flat.items():
            value = value.reshape(rows, *self.shown[name])
            finite = torch.isfinite(value) | torch.isnan(value)
            if not bool(finite.all()):
                where = self.labels[name]
                raise ValueOutOfRange(f"{where} is infinite in some element; observe a number, or NaN if it is missing")
            self.check_limits(name, value)
            shaped[name] = value[:, None]
        return shaped

    def check_limits(self, name: str, value: Tensor) -> None:
        """Raise ValueOutOfRange for an observation (..., *shape) that its law never gives, whatever its parameters."""
        limits = self.structure.nodes[name].limits
        if limits is None:
            return
        good = limits.check(value) | torch.isnan(value)
        if not bool(good.all()):
            family = self.structure.nodes[name].family
            bad = f"{value[~good].flatten()[0]:g}"
            raise ValueOutOfRange(f"{self.labels[name]} is {bad}, which no {family} gives: {words(limits)}")

    def _batched(self, name: str, value: Tensor, shape: tuple[int, ...], batch: int) -> Tensor:
        if value.shape == shape:
            return value.unsqueeze(0) if batch == 1 else value.expand(batch, *shape)
        if value.shape == (batch, *shape):
            return value
        where = self.labels[name]
        raise ValueOutOfRange(
            f"{where} has shape {tuple(value.shape)}; one value has shape {shape}, and this belief "
            + (f"holds {batch} of them" if batch > 1 else "holds one")
        )
