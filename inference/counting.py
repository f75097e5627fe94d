"""Exact beliefs where something is known by counting, given finite hypotheses (thesis ch. 4, appendix II)."""

from __future__ import annotations

from typing import Any

import torch

from apmodels import Model
from apmodels.structure import Structure
from inference.engine import Bid
from inference.exact import Exact
from inference.worlds.count_process import CountProcess, count_process
from inference.worlds.hypotheses import Hypotheses, hypotheses_plan
from inference.worlds.plan import Plan
from inference.worlds.statistic import Statistic, statistic
from inference.worlds.step import BankBelief


class Counting(Hypotheses):
    """What ``Exact`` is for models with Beta, Dirichlet or Gamma variables whose components outcomes select."""

    def __init__(self, model: Model, dtype: torch.dtype | None = None):
        plan: Any = hypotheses_plan(model.structure) if isinstance(model, Model) else None
        super().__init__(model, plan if isinstance(plan, Plan) else None, dtype)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return f"Exact({self.model!r})"

    def statistic(self, belief: BankBelief) -> Statistic:
        """Return what the hypotheses' posterior depends on: known states, and the counts that bear on them."""
        return statistic(self, belief)

    def process(self) -> CountProcess:
        """Return the statistic as a Markov chain that actions steer: what plans are made on (thesis eq. 4.53)."""
        return count_process(self)

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve models in which all that is hidden is counted or finite."""
        found = hypotheses_plan(structure)
        if isinstance(found, Bid):
            return found
        for group in (*found.gaussian, *found.fields):
            return Bid(0.0, f"{group[0]} is integrated, not enumerated: {structure.nodes[group[0]].why}")
        if not found.counted:
            return Bid(0.0, "nothing that is hidden is counted")
        counted = ", ".join(name for group in found.counted for name in group)
        given = f" given {', '.join(found.worlds)}" if found.worlds else ""
        return Bid(1.0, f"conjugate counts{given}: {counted}")


# An Exact engine, to whoever asks.
Exact.register(Counting)
