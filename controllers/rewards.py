"""What is worth having: a reward is a function of the belief, and perhaps of the action that led to it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from inference import Marginal, Refusal


class Information:
    """Minus the uncertainty about the interest, nats (thesis eq. 4.8)."""

    def __call__(self, belief: Any, action: Any = None) -> Tensor:
        """Return the reward of every belief of a batch, (*batch,)."""
        return -belief.entropy()

    def gain(self, engine: Any, belief: Any, actions: Any, samples: int, seed: int) -> Tensor:
        """Return by how much the reward is expected to grow in one step, (*batch, K), after each of K actions."""
        structure = engine.structure
        if all(structure.nodes[name].role == "static" for name in structure.interest):
            return engine.gain(belief, actions, samples=samples, seed=seed)
        # What moves is less sure, or surer, before anything of it is seen.
        left = engine.expect(belief, lambda logs: -torch.xlogy(logs.exp(), logs.exp()).sum(-1), actions, samples, seed)
        return belief.entropy()[..., None] - left

    def groups(self, process: Any) -> Tensor | None:
        """Return which value of the interest every hypothesis has, (H,); None where counts bear on it themselves."""
        engine = process.engine
        names = engine.structure.interest
        if engine.model.declaration.interest is not None or not set(names) <= set(engine.plan.worlds):
            return None
        values = engine.start().values
        rows = torch.cat([values[name][0].reshape(len(process.log_prior), -1).double() for name in names], 1)
        return torch.unique(rows, dim=0, return_inverse=True)[1]

    def __repr__(self) -> str:
        return "Information()"


class PercentCorrect:
    """The probability that the interest's most probable value is the true one, max_i b_i (Najemnik & Geisler)."""

    def __call__(self, belief: Any, action: Any = None) -> Tensor:
        """Return the reward of every belief of a batch, (*batch,)."""
        return _finite(self, belief).probs.amax(-1)

    def __repr__(self) -> str:
        return "PercentCorrect()"


class Fixated:
    """The probability that the action that was taken equals the interest, b_u (thesis section 5.5.6)."""

    def __call__(self, belief: Any, action: Any = None) -> Tensor:
        """Return the reward of every belief of a batch and the action that led to it, (*batch,)."""
        if not isinstance(action, (Tensor, int)):
            raise Refusal("Fixated asks for the action that led to a belief: one number, and the interest's value")
        marginal = _finite(self, belief)
        equal = marginal.values == torch.as_tensor(action).unsqueeze(-1)
        return (marginal.probs * equal).sum(-1)

    def __repr__(self) -> str:
        return "Fixated()"


def asked(reward: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Return a reward as a function of a belief and the action that led to it, whether it asks for one or both."""
    try:
        inspect.signature(reward).bind(None, None)
    except TypeError:
        return lambda belief, action: reward(belief)
    return reward


def interest_of(engine: Any) -> str:
    """Return the name of an engine's one interest."""
    names = engine.names(None)
    if len(names) != 1:
        raise Refusal(f"the interest of {type(engine.model).__name__} is {', '.join(names)}; one variable is needed")
    return names[0]


def _finite(reward: Any, belief: Any) -> Marginal:
    name = interest_of(belief.engine)
    marginal = belief.marginal(name)
    if not isinstance(marginal, Marginal) or marginal.values.dim() != 1:
        raise Refusal(f"{reward!r} needs an interest with finitely many values, one number each, and {name} has not")
    return marginal
