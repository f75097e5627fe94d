"""Noticing that learning goes wrong, and keeping what was good before it did."""

from __future__ import annotations

import copy
import math
from collections import deque
from typing import Any

import torch
from torch import nn


class LearningWarning(UserWarning):
    """Learning was stopped, and the last good parameters were kept; the message says why."""


class Watch:
    """Compares every stretch of updates with the best, and keeps the newest parameters that were no worse.

    Args:
        policy: what learns.
        stretch: so many updates are averaged.
        errors: a fall by so many standard errors is no accident.
        share: nor may it be less than this share of all that was gained.
    """

    def __init__(self, policy: nn.Module, stretch: int = 10, errors: float = 6.0, share: float = 0.25):
        self.policy, self.errors, self.share = policy, errors, share
        self.returns: deque[float] = deque(maxlen=stretch)
        self.variances: deque[float] = deque(maxlen=stretch)
        self.first = self.best = -math.inf
        self.good: dict[str, Any] = copy.deepcopy(policy.state_dict())

    def trouble(self, worth: float, error: float, entropy: float) -> str | None:
        """Say what is wrong with an update of this mean return, its standard error and the policy's entropy, if any."""
        if not math.isfinite(worth):
            return f"episodes were worth {worth}"
        if any(not bool(torch.isfinite(p.grad).all()) for p in self.policy.parameters() if p.grad is not None):
            return "a gradient was not finite"
        self.returns.append(worth)
        self.variances.append(error**2)
        now, noise = sum(self.returns) / len(self.returns), math.sqrt(2 * sum(self.variances)) / len(self.variances)
        self.first = now if self.first == -math.inf else self.first
        self.best = max(self.best, now)
        fall = self.best - now
        # The newest that are no worse than the best, neither on average nor by what they did last.
        if fall <= noise and worth >= self.best - 2 * error:
            self.good = copy.deepcopy(self.policy.state_dict())
        if len(self.returns) < (self.returns.maxlen or 0) or fall <= self.errors * noise:
            return None
        if fall <= self.share * (self.best - self.first):
            return None
        why = "the policy collapsed to few actions" if entropy < 0.1 else "the rate may be too large"
        return f"episodes were worth {now:.4g} and had been worth {self.best:.4g}: {why} (entropy {entropy:.2g} nats)"

    def restore(self) -> None:
        """Give the policy its last good parameters, and begin to compare anew."""
        self.policy.load_state_dict(self.good)
        self.returns.clear()
        self.variances.clear()
