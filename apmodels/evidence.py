"""Observations that can be scored but not drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints


class Evidence(TorchDistribution):
    """What an observed value says for this world over the background, as a log likelihood ratio in nats.

    ``log_ratio`` is a function from the observed value to a scalar tensor: ``Evidence(lambda image: f(image)[place])``.
    The background's own likelihood is common to all worlds and cancels in every belief; a log evidence is then
    relative to the background.
    """

    arg_constraints = {}  # type: ignore[assignment]
    support = constraints.real_vector  # type: ignore[assignment]
    has_rsample = False

    def __init__(self, log_ratio: Callable[[Tensor], Tensor], validate_args: bool | None = None):
        if not callable(log_ratio):
            raise TypeError(
                "Evidence takes a function from the observed value to its log likelihood ratio, "
                f"not a {type(log_ratio).__name__}; write Evidence(lambda observed: ...)"
            )
        self.log_ratio = log_ratio
        super().__init__(torch.Size(), torch.Size(), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log likelihood ratio of ``value`` in nats."""
        return self.log_ratio(value)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Refuse: nobody said how such an observation comes about."""
        raise NotImplementedError(
            "an Evidence can be scored but not drawn: it says how much likelier an observation is than under "
            "the background, not how observations come about; simulate with a body that really observes"
        )

    rsample = sample
