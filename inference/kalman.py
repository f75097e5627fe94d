"""The Kalman filter, of any model that is affine and Gaussian given finite hypotheses (thesis eqs 6.17 to 6.29)."""

from __future__ import annotations

from typing import Any

import torch

from apmodels import Model
from apmodels.structure import Structure
from inference.engine import Bid
from inference.records.record import Record
from inference.worlds.hypotheses import Hypotheses, hypotheses_plan
from inference.worlds.plan import Plan
from inference.worlds.smoothing import smoothed
from inference.worlds.step import BankBelief


class Kalman(Hypotheses):
    """Integrates affine-Gaussian variables; one filter for each value of a static finite parent.

    Laws may depend on actions and known states in any way; what they make of Gaussian parents is read as matrices, once
    for each context. Covariances are in double precision and in Joseph's form, whatever ``dtype``. Fields of
    independent pixels that are only moved are two images.

    Args:
        model: see Engine.
        dtype: see Engine.
    """

    def __init__(self, model: Model, dtype: torch.dtype | None = None):
        plan: Any = hypotheses_plan(model.structure) if isinstance(model, Model) else None
        super().__init__(model, plan if isinstance(plan, Plan) else None, dtype)  # type: ignore[arg-type]

    def smooth(self, actions: Any, observations: Any, batch: int | None = None) -> list[BankBelief]:
        """Return the beliefs about each step of a record, given all of it; see ``filter`` for the arguments."""
        beliefs, record = list(self.filter(actions, observations, batch)), Record.of(self, actions, observations)
        rows = 1 if batch is None else batch
        steps = [record.step(t) for t in range(record.steps)]
        acts = [self._actions(act, rows) for act, _ in steps]
        return smoothed(self, self.start(batch), beliefs, acts, [self.seen_as(see, rows) for _, see in steps])

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve models in which something is integrated, and all else finite or counted."""
        found = hypotheses_plan(structure)
        if isinstance(found, Bid):
            return found
        if not found.gaussian and not found.fields:
            return Bid(0.0, "nothing that is hidden is Gaussian")
        integrated = ", ".join(name for group in (*found.gaussian, *found.fields) for name in group)
        given = f" given {', '.join(found.worlds)}" if found.worlds else ""
        return Bid(1.0, f"affine and Gaussian{given}: {integrated}")
