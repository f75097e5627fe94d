"""A bank whose worlds are hypotheses: every combination of finite statics; nothing is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from apmodels.simulation import Values
from apmodels.structure import Structure
from inference.engine import Bid
from inference.records.bank_record import along
from inference.records.record import Record
from inference.worlds.bank import Bank
from inference.worlds.plan import Plan, make_plan
from inference.worlds.step import BankBelief, Step


class Hypotheses(Bank):
    """Exact beliefs: hypotheses are weighed, and what is continuous is integrated in closed form given each."""

    distinct = True

    def people(self, step: Step) -> tuple[Step, Tensor]:
        """Lay out all combinations of the hypotheses' values, with the log of their prior."""
        names = [name for name in self.plan.worlds]
        values = [self.structure.nodes[name].values for name in names]
        ranges = [torch.arange(len(value)) for value in values if value is not None]
        picks = torch.cartesian_prod(*ranges).reshape(-1, len(names)) if names else torch.zeros(1, 0)
        weights = torch.zeros(1, len(picks), dtype=self.dtype)
        for i, (name, value) in enumerate(zip(names, values, strict=True)):
            assert value is not None
            value = value[picks[:, i]][None]
            step.frame.values[name, 0] = value.to(self.dtype) if value.is_floating_point() else value
        step.lead = (1, len(picks))
        for name in self.model.declaration.names["static"]:
            if name in names:
                weights = weights + step.frame.score(self.laws, name, step.frame.values[name, 0], step.lead)
            elif name in self.plan.computed:
                step.frame.values[name, 0] = step.frame.in_all(self.laws, name, step.lead)  # type: ignore[assignment]
            self.births(step, name)
        return step, weights

    def update(self, belief: BankBelief, action: Any, observation: Any) -> BankBelief:
        """Return the belief after one more action and observation (thesis eqs 4.17 to 4.26, 6.17 to 6.29)."""
        rows = len(belief.log_weights)
        actions = self._actions(action, rows)
        return self.advance(belief, actions, self.seen_as(observation, rows))

    def along(self, record: Record, batch: int | None) -> Sequence[BankBelief]:
        """Return the beliefs along a record, of all steps at once where nothing stands against it."""
        return along(self, record, batch)

    def advance(self, belief: BankBelief, actions: Values, seen: Values) -> BankBelief:
        """The same, of what has been checked: actions (rows, *shape), observations (rows, 1, *shape)."""
        step, known = self.step_of(belief, actions)
        self.move(step)
        self.sense(step, seen)
        return self.made(belief, step, known | actions, belief.log_weights + step.score, seen)


def hypotheses_plan(structure: Structure) -> Plan | Bid:
    """Return a plan in which worlds are finite statics, or why there is none."""
    bad = next((node for node in structure.hidden if node.plan == "sampled"), None)
    if bad is not None:
        return Bid(0.0, f"{bad.name} is sampled: {bad.why}")
    plan = make_plan(structure)
    for name in plan.worlds:
        node = structure.nodes[name]
        if node.role != "static":
            met = next(a.child for a in structure.out_of(name)) if structure.out_of(name) else "something continuous"
            return Bid(0.0, f"{name} changes from step to step and bears on what is integrated ({met}): sample it")
        if node.values is None:
            return Bid(0.0, f"{name} has too many values to be enumerated")
    for arrow in structure.arrows:
        parent, child = structure.nodes[arrow.parent], structure.nodes[arrow.child]
        if arrow.lag == 0 and parent.role == child.role == "observation":
            return Bid(0.0, f"{child.name} depends on {parent.name}, an observation of the same step")
        if child.role == "observation" and child.family == "Evidence":
            return Bid(0.0, f"{child.name} is an Evidence, which can only be scored")
    return plan
