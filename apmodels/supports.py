"""The finitely many values that a law allows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of
from apmodels.evidence import Evidence

LARGEST_SUPPORT = 4096


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
