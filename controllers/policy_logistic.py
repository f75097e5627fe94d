"""A policy in which every weight is free (thesis section 5.5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from apmodels import Grid, ValueOutOfRange
from controllers.policy import Policy
from controllers.policy_convolutional import ConvolutionalPolicy, between


class LogisticPolicy(Policy):
    """logits_k = Σ_f θ_fk · φ_f(b), any weight free (thesis eq. 5.20).

    Args:
        states: how many values the interest has, N.
        actions: how many actions there are, M.
        features: see Policy; the belief itself by default.
        spread: see Policy.
        seed: see Policy.

    ``weights`` are (F, M, N).
    """

    def __init__(
        self, states: int, actions: int, features: Sequence[str] = ("belief",), spread: float = 0.0, seed: int = 0
    ):
        if states < 1 or actions < 1:
            raise ValueOutOfRange(f"a policy needs 1 value and 1 action or more, not {states} and {actions}")
        super().__init__((actions, states), features, spread, seed)
        self.states, self.actions = states, actions

    def forward(self, probs: Tensor) -> Tensor:
        """Return the logits of actions, (*batch, M)."""
        return self.featured(probs).flatten(-2) @ self.weights.transpose(1, 2).flatten(0, 1)

    def about(self) -> dict[str, Any]:
        """Return what it was made with, but for the weights."""
        return {"states": self.states, "actions": self.actions}

    def tied(self, grid: Grid) -> ConvolutionalPolicy:
        """Return the convolutional policy whose weights are the means of those at each distance on a grid."""
        policy = ConvolutionalPolicy(grid, features=self.features)
        if (grid.size, grid.size) != (self.states, self.actions):
            raise ValueOutOfRange(f"{grid} has {grid.size} cells; the policy has {self.states} values of the interest")
        rings = between(grid, policy.lookup)
        counts = torch.bincount(rings, minlength=len(policy.distances))
        with torch.no_grad():
            policy.weights.zero_().index_add_(1, rings, self.weights.cpu().flatten(1)).div_(counts)
        return policy

    def plot(self) -> Any:
        """Return a figure of the weights, actions by values."""
        import matplotlib.pyplot as plt

        figure, panels = plt.subplots(1, len(self.features), squeeze=False, layout="constrained")
        for panel, name, weights in zip(panels[0], self.features, self.weights.detach().cpu().numpy(), strict=True):
            panel.set(title=name, xlabel="value", ylabel="action")
            figure.colorbar(panel.imshow(weights), ax=panel, label="weight")
        return figure
