"""Looking where it probably is."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from controllers.controller import Controller
from inference import Belief, Engine, Refusal

# Probabilities closer than this, relatively, are a tie.
TIE = 1e-5


class MostProbable(Controller):
    """Chooses the action that equals the interest's most probable value, as salience models do (thesis 5.5.5).

    Ties are broken at random.

    Args:
        engine: one whose interest has the same values as the action.
        first: the action of the first step, before anything is known; the most probable one if None.
        seed: for ties.
    """

    def __init__(self, engine: Engine, first: Any = None, seed: int = 0):
        super().__init__(engine, seed)
        name, space = self.only_action()
        interest = engine.structure.interest
        whole = len(interest) == 1 and engine.model.declaration.interest is None
        values = engine.structure.nodes[interest[0]].values if whole else None
        same = values is not None and space.size == len(values)
        if not same or not torch.equal(values.double(), space.values().double()):  # type: ignore[union-attr]
            raise Refusal(
                f"MostProbable needs an action with the values of the interest; {name} is of {space}, "
                f"and the interest is {', '.join(interest)}"
            )
        self.interest = interest[0]
        self.first = None if first is None else space.check(first, name)

    def act(self, belief: Belief) -> Any:
        """Return the most probable value, for each belief."""
        if belief.time == 0 and self.first is not None:
            return self.first if belief.batch is None else self.first.expand(belief.batch)
        marginal = belief.marginal(self.interest)
        best, at = marginal.logits.topk(2 if marginal.logits.shape[-1] > 1 else 1)
        if belief.batch is None:
            ends, where = best.tolist(), at.tolist()
            tied = len(ends) > 1 and ends[0] - ends[-1] < TIE
            return marginal.values[int(self._one_of(marginal.logits)) if tied else where[0]]
        tied = (best[..., 0] - best[..., -1]) < TIE
        if bool(tied.any()):
            at = torch.where(tied[..., None], self._one_of(marginal.logits), at)
        return marginal.values[at[..., 0]]

    def _one_of(self, logits: Tensor) -> Tensor:
        among = logits >= logits.amax(-1, keepdim=True) - TIE
        draw = torch.rand(logits.shape, generator=self.generator)
        return torch.where(among, draw, -1.0).argmax(-1, keepdim=True)
