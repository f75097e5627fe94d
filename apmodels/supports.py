"""The finitely many values that a law allows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints

from apmodels.distributions import base_of
from apmodels.evidence import Evidence

# A photograph's worth of places, 128 x 128; more values than these are sampled.
LARGEST_SUPPORT = 1 << 14


def limits_of(law: Any) -> Any:
    """Return the constraint on every element of a draw that a law has whatever its parameters, or None."""
    if not isinstance(law, Distribution) or isinstance(law, Evidence):
        return None
    base, _ = base_of(law)
    fixed = not constraints.is_dependent(getattr(type(base), "support", constraints.dependent))
    support: Any = base.support if fixed or isinstance(base, Categorical) else None
    return None if support is None or support.event_dim or support is constraints.real else support


def support_of(law: Any) -> Tensor | None:
    """Return the finitely many values of a law, (size, *event shape), or None."""
    if not isinstance(law, Distribution):
        return None
    base, added = base_of(law)
    if not base.has_enumerate_support or isinstance(base, Evidence):
        return None
    try:
        values = type(base).enumerate_support(base, expand=False)
    except NotImplementedError:
        return None
    # One element's values (n, *its shape), and every combination of the elements'.
    values = values.reshape(len(values), *base.event_shape)
    elements = torch.Size(law.event_shape[:added]).numel()
    if len(values) ** elements > LARGEST_SUPPORT:
        return None
    picks = torch.cartesian_prod(*[torch.arange(len(values))] * elements)
    return values[picks].reshape(-1, *law.event_shape)
