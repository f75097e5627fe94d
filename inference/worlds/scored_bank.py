"""A bank whose worlds are given: all that is continuous has values along the whole record, what is finite is summed.

It draws nothing; it tells how probable each world makes the record.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.simulation import Values
from apmodels.structure import Structure
from inference.engine import Bid
from inference.guides.posterior_draws import Draws
from inference.worlds.bank import Bank
from inference.worlds.plan import make_plan
from inference.worlds.step import BankBelief, Step


class ScoredBank(Bank):
    """Weighs whole paths of everything that is continuous."""

    def __init__(self, model: Model, dtype: torch.dtype | None = None):
        structure = model.structure
        free = [node.name for node in structure.hidden if node.random and node.values is None]
        super().__init__(model, make_plan(structure, free, scored=True), dtype)

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve whoever makes one; it is no engine of its own."""
        return Bid(1.0, "no engine of its own")

    def update(self, belief: Any, action: Any, observation: Any) -> Any:
        """Refuse: paths are weighed whole."""
        raise TypeError("a scored bank weighs whole records")

    def people(self, step: Step) -> tuple[Step, Tensor]:
        """Take the statics as given, with the log of their prior."""
        given = step.given or {}
        sizes = [value.shape[1] for value in given.values()]
        step.lead = (step.lead[0], sizes[0] if sizes else 1)
        step.prior = step.prior.expand(step.lead)
        for name in self.model.declaration.names["static"]:
            if name in self.plan.worlds:
                self.draw(step, name, given[name], birth=True)
            elif name in self.plan.computed:
                step.frame.values[name, 0] = step.frame.in_all(self.laws, name, step.lead)  # type: ignore[assignment]
        return step, step.prior

    def start_known(self, batch: int | None) -> Values:
        """Return what is known before time began."""
        if batch is not None and batch < 1:
            raise ValueOutOfRange(f"a batch of {batch} beliefs is empty; give 1 or more, or None")
        return self.known.first(1 if batch is None else batch)

    def scored(self, batch: int | None, record: tuple, draws: Draws) -> BankBelief:
        """Return the worlds that draws describe, weighed by how probable they make a record, over log q."""
        rows, count = draws.log_prob.shape
        values = {name: value.to(self.dtype) for name, value in draws.values.items()}
        statics = {name: values[name] for name in self.plan.worlds if self.roles[name] == "static"}
        if not statics:
            blank = torch.zeros(rows, count, dtype=self.dtype)
            belief = self.start(batch, {"": blank})
        else:
            belief = self.start(batch, statics)
        weights = belief.log_weights
        for t, (actions, seen) in enumerate(record):
            step, known = self.step_of(belief, actions)
            path = {n: values[f"{n}_{t + 1}"] for n in self.plan.worlds if self.roles[n] == "state"}
            self.move(step, path)
            self.sense(step, seen)
            weights = weights + step.prior + step.score
            flat = torch.zeros(weights.shape, dtype=self.dtype)
            belief = self.made(belief, step, known | actions, flat, seen)
        weights = weights - draws.log_prob
        total = weights.logsumexp(1)
        if not bool(torch.isfinite(total).all()):
            raise ValueOutOfRange(f"{type(self.model).__name__} gives what was observed no probability at all")
        evidence = total - math.log(count)
        return replace(
            belief, log_weights=weights - total[:, None], log_evidence=evidence[0] if batch is None else evidence
        )
