"""What every policy is: what is believed becomes the probabilities of actions, softmax of weights times features."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from apmodels import ValueOutOfRange
from apmodels.errors import nearest
from apmodels.spaces import Space
from controllers.policy_files import keep
from controllers.rewards import interest_of
from inference import Engine, Marginal, Refusal

# What policies may see of probabilities b, which is the thesis's φ(b); all of about one size, to learn at one rate.
FEATURES: dict[str, Callable[[Tensor], Tensor]] = {
    "belief": lambda b: b,
    "squared": lambda b: b * b,
    "doubt": lambda b: b * (1 - b),
    "flattened": lambda b: b.sqrt() / b.sqrt().sum(-1, keepdim=True),
    "sharpened": lambda b: b * b / (b * b).sum(-1, keepdim=True),
    "surprise": lambda b: torch.special.entr(b) / max(1.0, math.log(b.shape[-1])),
    "even": lambda b: torch.ones_like(b) / b.shape[-1],
}


class Policy(nn.Module):
    """Logits of actions, linear in weights: probabilities b (*batch, N) of the interest's values go in.

    Args:
        shape: of the weights of a feature.
        features: names in ``FEATURES``.
        spread: standard deviation of the first weights; 0 begins with a uniform policy.
        seed: of the first weights.
    """

    def __init__(self, shape: tuple[int, ...], features: Sequence[str], spread: float = 0.0, seed: int = 0):
        super().__init__()
        self.features = (features,) if isinstance(features, str) else tuple(features)
        for name in self.features:
            if name not in FEATURES:
                raise ValueOutOfRange(f"a belief has no feature {name!r}{nearest(name, FEATURES)}")
        if not self.features or not 0 <= spread < float("inf"):
            raise ValueOutOfRange(f"a policy needs a feature and a spread of 0 or more, not {features} and {spread}")
        draws = torch.randn(len(self.features), *shape, generator=torch.Generator().manual_seed(seed))
        self.weights = nn.Parameter(spread * draws)

    def featured(self, probs: Tensor) -> Tensor:
        """Return the features of probabilities, (*batch, F, N)."""
        return torch.stack([FEATURES[name](probs) for name in self.features], -2)

    @abstractmethod
    def forward(self, probs: Tensor) -> Tensor:
        """Return the logits of actions, (*batch, M)."""

    @abstractmethod
    def about(self) -> dict[str, Any]:
        """Return what it was made with, but for the weights."""

    @abstractmethod
    def plot(self) -> Any:
        """Return a figure of the weights."""

    def serves(self, engine: Engine) -> None:
        """Raise Refusal where the policy is not made for the engine's beliefs and actions."""
        states, space = sizes(engine)
        wanted = self.about()["states"], self.about()["actions"]
        if (len(states), space.size) != wanted:
            raise Refusal(
                f"{type(self).__name__} is made for {wanted[0]} values and {wanted[1]} actions; "
                f"{type(engine.model).__name__} has {len(states)} and {space.size}"
            )

    def save(self, path: str | Path) -> None:
        """Keep the policy: arrays and a JSON header (numpy's npz)."""
        keep(path, {"policy": self.header()}, {"weights": self.weights.detach().cpu().numpy()})

    def header(self) -> dict[str, Any]:
        """Return what, with the weights, makes the policy again."""
        return {"kind": type(self).__name__, "features": list(self.features), **self.about()}


def sizes(engine: Engine) -> tuple[Tensor, Space]:
    """Return the values of the interest and the space of the one action; Refusal where a policy can have neither."""
    model, names = type(engine.model).__name__, engine.model.action_names
    if len(names) != 1:
        raise Refusal(f"a policy chooses one action; {model} has {names}")
    space = engine.model.space(names[0])
    if space.size is None:
        raise Refusal(f"a policy chooses among finitely many actions; {names[0]} is of {space}")
    interest = interest_of(engine)
    marginal = engine.start().marginal(interest)
    if not isinstance(marginal, Marginal):
        raise Refusal(f"a policy sees the probabilities of finitely many values; {interest} of {model} is a continuum")
    return marginal.values, space
