"""What an engine knows after a history: an immutable value of batched tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from pyro.distributions import Categorical
from torch import Tensor
from torch.distributions import Distribution


class Marginal(Categorical):
    """The distribution of a variable with finitely many values: ``probs`` (*batch, size) over ``values``.

    Samples are positions in ``values`` (size, *shape); ``mean`` and ``mode`` are in the variable's own units.
    """

    def __init__(self, log_probs: Tensor, values: Tensor):
        # Already normalised, which Categorical's own constructor would do again, at the cost of an update.
        self.logits = self._param = log_probs  # type: ignore[assignment]
        self._num_events = log_probs.shape[-1]
        self.values = values
        Distribution.__init__(self, log_probs.shape[:-1], validate_args=False)

    @property
    def mean(self) -> Tensor:
        """The expected value, (*batch, *shape)."""
        values = self.values.to(self.probs.dtype)
        return torch.tensordot(self.probs, values, dims=1)

    @property
    def mode(self) -> Tensor:
        """The most probable value, (*batch, *shape); the first of several."""
        return self.values[self.logits.argmax(-1)]


class Weighted(Distribution):
    """The distribution of a continuous variable that is known by weighted values, (*batch, worlds, *shape).

    ``values`` and ``log_weights`` (*batch, worlds) are all there is: it has moments, quantiles and samples, but no
    density.
    """

    arg_constraints = {}  # type: ignore[assignment]

    def __init__(self, log_weights: Tensor, values: Tensor):
        self.log_weights, self.values = log_weights, values
        shape = values.shape[log_weights.dim() :]
        super().__init__(log_weights.shape[:-1], shape, validate_args=False)

    def _weights(self) -> Tensor:
        return self.log_weights.exp().reshape(*self.log_weights.shape, *[1] * len(self.event_shape))

    @property
    def mean(self) -> Tensor:
        """The expected value, (*batch, *shape)."""
        return (self._weights() * self.values).sum(len(self.batch_shape))

    @property
    def variance(self) -> Tensor:
        """The variance of each element, (*batch, *shape)."""
        off = self.values - self.mean.unsqueeze(len(self.batch_shape))
        return (self._weights() * off * off).sum(len(self.batch_shape))

    @property
    def mode(self) -> Tensor:
        """The value with the largest weight, (*batch, *shape)."""
        best = self.log_weights.argmax(-1)
        return self._at(best.unsqueeze(-1)).squeeze(len(self.batch_shape))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw values by their weights, (*sample_shape, *batch, *shape)."""
        size = torch.Size(sample_shape)
        chosen = Categorical(logits=self.log_weights, validate_args=False).sample(torch.Size([size.numel()]))
        drawn = self._at(chosen.movedim(0, -1))
        return drawn.movedim(len(self.batch_shape), 0).reshape(*size, *self.batch_shape, *self.event_shape)

    def quantile(self, level: float) -> Tensor:
        """Return the smallest value of each element below which at least this share of the weight lies."""
        dim = len(self.batch_shape)
        ordered, order = self.values.sort(dim)
        weight = self._weights().expand(self.values.shape).gather(dim, order).cumsum(dim)
        at = (weight < level).sum(dim, keepdim=True).clamp(max=self.values.shape[dim] - 1)
        return ordered.gather(dim, at).squeeze(dim)

    def _at(self, index: Tensor) -> Tensor:
        wide = index.reshape(*index.shape, *[1] * len(self.event_shape)).expand(*index.shape, *self.event_shape)
        return self.values.gather(len(self.batch_shape), wide)


@dataclass(frozen=True)
class Belief:
    """What every belief has. ``batch`` is None for a single one.

    ``log_evidence`` (*batch,) is log p(observations | actions) so far, in nats; ``time`` counts steps; ``known``
    holds what the agent need not infer but must remember.
    """

    engine: Any = field(repr=False, compare=False)
    batch: int | None
    time: int
    log_evidence: Tensor = field(repr=False)
    known: dict[str, Tensor] = field(repr=False)

    def marginal(self, name: str) -> Any:
        """Return the distribution of a hidden variable."""
        return self.engine.marginal(self, name)

    def entropy(self, names: str | tuple[str, ...] | None = None, bits: bool = False) -> Tensor:
        """Return the joint entropy of variables, the interest by default, in nats or bits, (*batch,)."""
        entropy = self.engine.entropy(self, names)
        return entropy / math.log(2) if bits else entropy

    def most_probable(self, name: str | None = None) -> Tensor:
        """Return the most probable value of a variable, of the interest by default, (*batch, *shape)."""
        return self.engine.most_probable(self, name)


@dataclass(frozen=True)
class FiniteBelief(Belief):
    """Log probabilities (batch or 1, *sizes) over the joint values of the hidden variables, normalised."""

    log_probs: Tensor = field(repr=False)
