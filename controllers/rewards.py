"""What a plan is made for: a reward is a function of the belief."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Information:
    """Minus the uncertainty about the interest, nats (thesis eq. 4.8)."""

    def __call__(self, belief: Any) -> Tensor:
        """Return the reward of every belief of a batch, (*batch,)."""
        return -belief.entropy()

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
