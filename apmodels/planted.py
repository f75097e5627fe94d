"""Fields of independent elements that are all alike but one."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, constraints


class Planted(TorchDistribution):
    """Independent elements: the one at ``index`` follows ``here``, all others follow ``elsewhere``.

    The same law can be written with a one-hot mean; said like this, neither its table nor its likelihood ever
    touches the elements that do not differ, so that a model with N places costs N per look and not N².

    Args:
        index: which element differs, int64, (*batch,).
        here: the law of that element, batch shape (*batch,).
        elsewhere: the laws of all elements where nothing is planted, batch shape (*batch, elements), of the same
            family as ``here``.
    """

    arg_constraints = {}  # type: ignore[assignment]
    support = constraints.real_vector  # type: ignore[assignment]
    has_rsample = False

    def __init__(self, index: Tensor, here: Distribution, elsewhere: Distribution, validate_args: bool | None = None):
        if type(here) is not type(elsewhere) or here.event_shape != elsewhere.event_shape:
            raise TypeError(
                f"Planted needs one family for both laws, not {type(here).__name__} and {type(elsewhere).__name__}"
            )
        self.index = torch.as_tensor(index)
        self.here = here
        self.elsewhere = elsewhere
        batch = torch.broadcast_shapes(self.index.shape, here.batch_shape, elsewhere.batch_shape[:-1])
        super().__init__(batch, elsewhere.batch_shape[-1:] + elsewhere.event_shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log p(value), nats; elements that are NaN are missing."""
        background = elementwise_log_prob(self.elsewhere, value)
        lead = torch.broadcast_shapes(value.shape[:-1], self.index.shape, background.shape[:-1])
        index = self.index.expand(lead).unsqueeze(-1)
        inside = value.expand(*lead, value.shape[-1]).gather(-1, index).squeeze(-1)
        replaced = background.expand(*lead, value.shape[-1]).gather(-1, index).squeeze(-1)
        return background.sum(-1) - replaced + elementwise_log_prob(self.here, inside)

    def sample(self, sample_shape: torch.Size | tuple = ()) -> Tensor:  # type: ignore[override]
        """Draw values, (*sample_shape, *batch, elements)."""
        shape = torch.Size(sample_shape)
        drawn = self.elsewhere.expand(self.batch_shape + self.elsewhere.batch_shape[-1:]).sample(shape)
        index = self.index.unsqueeze(-1).expand(*drawn.shape[:-1], 1)
        return drawn.scatter(-1, index, self.here.expand(self.batch_shape).sample(shape).unsqueeze(-1))

    @property
    def mean(self) -> Tensor:
        """The mean of every element, (*batch, elements)."""
        mean = self.elsewhere.mean.expand(self.batch_shape + self.event_shape)
        here = self.here.mean.expand(self.batch_shape).unsqueeze(-1)
        return mean.scatter(-1, self.index.expand(self.batch_shape).unsqueeze(-1), here)


def elementwise_log_prob(law: Distribution, value: Tensor) -> Tensor:
    """Return log p of independent elements, nats, 0 where an element is NaN, which means that it is missing."""
    if type(law).__name__ in ("Bernoulli", "Categorical") and "probs" in vars(law):
        return _log_chance(law, value)
    if not value.is_floating_point():
        return law.log_prob(value)
    missing = torch.isnan(value)
    # What stands in for them must have a score and a gradient, and 0 and 1 are often at an edge.
    stand_in = 0.0 if law.support.is_discrete else 0.5  # type: ignore[union-attr]
    return torch.where(missing, 0.0, law.log_prob(torch.where(missing, stand_in, value)))


def _log_chance(law: Any, value: Tensor) -> Tensor:
    """log p of elements with few outcomes, whose own ``log_prob`` rounds a probability of 0 up."""
    missing = torch.isnan(value)
    outcome = torch.where(missing, 0.0, value)
    if type(law).__name__ == "Bernoulli":
        chance = torch.where(outcome == 1, law.probs, 1 - law.probs)
    else:
        probs = law.probs.expand(*torch.broadcast_shapes(law.probs.shape[:-1], outcome.shape), law.probs.shape[-1])
        chance = probs.gather(-1, outcome.long().expand(probs.shape[:-1])[..., None])[..., 0]
    # Where the chance is 0 there is a score, minus infinity, but no gradient.
    none = chance <= 0
    score = torch.where(none, 1.0, chance).log().masked_fill(none, -torch.inf)
    return score.masked_fill(missing, 0.0)
