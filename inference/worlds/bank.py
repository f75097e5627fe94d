"""A bank of worlds: what cannot be integrated has values, world by world; all the rest is integrated given those.

The worlds are hypotheses (every combination of finite statics) or particles; what is done in a step is the same.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels import Model, ValueOutOfRange
from apmodels.simulation import Values
from apmodels.variables import Variable
from inference.records.record import narrow
from inference.worlds.asking import Asking
from inference.worlds.count_block import CountBlock
from inference.worlds.field_block import FieldBlock
from inference.worlds.finite_block import FiniteBlock
from inference.worlds.frame import Frame
from inference.worlds.gaussian import Gaussian
from inference.worlds.gaussian_block import GaussianBlock, predicted, seen_by
from inference.worlds.known import Known
from inference.worlds.linear import Linear
from inference.worlds.plan import Plan
from inference.worlds.step import BankBelief, Step, drawn


class Bank(Asking):
    """The part of an engine that moves worlds on; subclasses say which worlds there are.

    Args:
        model: the model.
        plan: which variables have values in the worlds, and how the others are grouped.
        dtype: see Engine.
    """

    # Whether the best of what is drawn is chosen, so that a draw's own probability matters; whether worlds all differ.
    chooses, distinct = False, False

    def __init__(self, model: Model, plan: Plan, dtype: torch.dtype | None = None):
        super().__init__(model, dtype)
        self.plan = plan
        self.known = Known(self.laws, self.structure)
        nodes = self.structure.nodes
        self.roles = {name: variable.role for name, variable in model.declaration.variables.items()}
        shapes = {node.name: tuple(node.shape) for node in nodes.values()}
        self.linear = Linear(model, shapes)
        # In which order a step's states happen.
        self.order = list(model.declaration.names["state"])
        self.functions: dict[str, Tensor] = {}
        self.owner: dict[str, tuple[str, int]] = {}
        remembered = model.declaration.remembered
        self.gaussians = [
            GaussianBlock(self.linear, group, self._claim("gaussian", i, group), self.roles, remembered)
            for i, group in enumerate(plan.gaussian)
        ]
        self.images = [
            FieldBlock(self.laws, group, self._claim("field", i, group), self.roles, remembered)
            for i, group in enumerate(plan.fields)
        ]
        self.tallies = [
            CountBlock(model, group, self._claim("count", i, group), shapes) for i, group in enumerate(plan.counted)
        ]
        seen = self._claim("finite", 0, plan.finite)
        self.summed = FiniteBlock(self.laws, self.structure, plan.finite, seen) if plan.finite else None

    def _claim(self, kind: str, index: int, group: tuple[str, ...]) -> list[str]:
        """The variables with values (drawn or seen) that depend on a group; the group owns them."""
        valued = (*self.plan.worlds, *self.model.observation_names)
        claimed = [n for n in self.roles if n in valued and self._touches(n, set(group))]
        for name in claimed:
            assert name not in self.owner, f"{name} depends on two groups"
            self.owner[name] = (kind, index)
        return claimed

    def _touches(self, name: str, group: set[str]) -> bool:
        return any(arrow.parent in group for arrow in self.structure.into(name))

    # Beginning.

    def people(self, step: Step) -> tuple[Step, Tensor]:
        """Fill the frame with the statics of every world; return the step and log weights (rows or 1, worlds)."""
        raise NotImplementedError

    def start(self, batch: int | None = None, given: Values | None = None) -> BankBelief:
        """Return the belief before any data; without ``batch``, a single one.

        ``given`` are the worlds' statics, (rows, worlds, *shape), where they are not to be drawn.
        """
        if batch is not None and batch < 1:
            raise ValueOutOfRange(f"a batch of {batch} beliefs is empty; give 1 or more, or None")
        rows = 1 if batch is None else batch
        nothing = Gaussian(torch.zeros(1, 1, 0, dtype=self.dtype), torch.zeros(1, 1, 0, 0, dtype=torch.float64))
        zero = torch.zeros(1, 1, dtype=self.dtype)
        step = Step(Frame(), (rows, 1), [nothing for _ in self.gaussians], [], [], None, zero, zero, given)
        for name in self.model.declaration.names["static"]:
            if self.structure.nodes[name].plan == "known":
                step.frame.values[name, 0] = self.known._static(name)[None, None]
        step, weights = self.people(step)
        worlds = weights.shape[1]
        step.lead = (rows, worlds)
        values = {n: v for (n, _), v in step.frame.values.items() if n in (*self.plan.worlds, *self.plan.computed)}
        befores = {name: self._before(name, step) for name in self.model.declaration.remembered}
        for name in (*self.plan.worlds, *self.plan.computed):
            if name in befores and self.roles[name] == "state":
                before = befores[name]
                values[name] = step.frame.values[before, 0] if isinstance(before, str) else before
        gaussian = [
            block.begin(block.leave(block.advance(belief, step.frame, birth=True), birth=True), befores, step.lead)
            for block, belief in zip(self.gaussians, step.gaussian, strict=True)
        ]
        fields = [block.start(step.frame, befores) for block in self.images]
        finite = None
        if self.summed is not None:
            finite, score = self.summed.start(step.frame, befores, step.lead)
            weights = weights + score
        return BankBelief(
            engine=self,
            batch=batch,
            time=0,
            log_evidence=torch.zeros(() if batch is None else rows, dtype=self.dtype),
            known=self.known.first(rows),
            log_weights=(weights.log_softmax(1) if given is None else weights).expand(rows, worlds),
            values={name: value.expand(value.shape[0], worlds, *value.shape[2:]) for name, value in values.items()},
            gaussian=tuple(gaussian),
            fields=tuple(fields),
            counts=tuple(step.counts),
            finite=finite,
        )

    def births(self, step: Step, name: str) -> None:
        """Put pseudo-counts of a group into a step when its first variable's turn has come."""
        for i, group in enumerate(self.plan.counted):
            if group[0] == name:
                assert i == len(step.counts)
                step.counts.append(self.tallies[i].start(step.frame))

    def _before(self, name: str, step: Step) -> str | Tensor:
        """A variable before time began: another one of its own group, or a value (rows or 1, worlds or 1, *shape)."""
        before = self.laws.before(name)
        if not isinstance(before, Variable):
            return before[None, None]
        held = step.frame.values.get((before.name, 0))
        return before.name if held is None else held

    # Moving on.

    def step_of(self, belief: BankBelief, actions: Values) -> tuple[Step, Values]:
        """Return a step about to be made, and the known variables."""
        rows = len(belief.log_weights)
        known, context = self.known.move(belief.known, actions, rows)
        values = {key: narrow(value)[:, None] for key, value in context.items()}
        for name, value in belief.values.items():
            values[name, 0 if self.roles[name] == "static" else 1] = value
        lead = (rows, belief.log_weights.shape[1])
        gaussian = [b.enter(g, belief.time) for b, g in zip(self.gaussians, belief.gaussian, strict=True)]
        zero = torch.zeros(lead, dtype=self.dtype)
        fields = list(belief.fields)
        return Step(Frame(values), lead, gaussian, fields, list(belief.counts), belief.finite, zero, zero), known

    def move(self, step: Step, given: Values | None = None) -> None:
        """Move the worlds on: draw their states, or score the ones ``given`` (rows, worlds, *shape)."""
        for name in self.order:
            if name in self.plan.computed:
                value = step.frame.in_all(self.laws, name, step.frame.lead(self._parents(name)))
                step.frame.values[name, 0] = value  # type: ignore[assignment]
            elif name in self.plan.worlds:
                self.draw(step, name, None if given is None else given[name])

    def _parents(self, name: str) -> list[tuple[str, int]]:
        return [(p.name, p.lag) for p in self.laws.variables[name].parents]

    def draw(self, step: Step, name: str, given: Tensor | None = None, birth: bool = False) -> None:
        """Draw one variable of every world, or score what is given; what is integrated learns from it."""
        kind, at = self.owner.get(name, ("", 0))
        shape = tuple(self.structure.nodes[name].shape)
        if kind == "gaussian":
            block = self.gaussians[at]
            belief = block.advance(step.gaussian[at], step.frame, name, birth)
            view = block.view(step.frame, name, birth)
            value = given
            if value is None:
                value = drawn(predicted(belief, view), step.lead).reshape(*step.lead, *shape)
            flat = value.reshape(*value.shape[:2], -1)
            step.gaussian[at], score = seen_by(belief, view, flat)
        elif kind == "count":
            block, counts = self.tallies[at], step.counts[at]
            value = block.draw(counts, step.frame, name, step.lead, self.laws) if given is None else given
            step.counts[at], score = block.count(counts, step.frame, name, value)
        elif kind == "finite":
            # Scored with the rest of what tells of the finite variables.
            assert given is not None, f"{name} can only be scored"
            value, score = given, torch.zeros(step.lead)
        elif given is None:
            law, value = step.frame.draw(self.laws, name, step.lead)
            score = torch.zeros(())
            if self.chooses and isinstance(law, Distribution):
                score = law.log_prob(value)
        else:
            value, score = given, step.frame.score(self.laws, name, given, step.lead)
        step.prior = step.prior + score.to(self.dtype)
        step.frame.values[name, 0] = value

    def sense(self, step: Step, seen: Values) -> None:
        """Condition on what is seen, (rows or 1, worlds or 1, *shape) by name."""
        for name, value in seen.items():
            step.frame.values[name, 0] = value
        scores = []
        for i, block in enumerate(self.gaussians):
            belief = block.advance(step.gaussian[i], step.frame)
            if block.seen:
                flat = [seen[name].reshape(*seen[name].shape[:2], -1) for name in block.seen]
                lead = torch.broadcast_shapes(*(part.shape[:2] for part in flat))
                value = torch.cat([part.expand(*lead, -1) for part in flat], -1)
                belief, score = seen_by(belief, block.view(step.frame), value)
                scores.append(score)
            step.gaussian[i] = block.leave(belief)
        for i, block in enumerate(self.images):
            step.fields[i], score = block.step(step.fields[i], step.frame, seen)
            scores.append(score)
        if self.summed is not None and step.finite is not None:
            step.finite, score = self.summed.step(step.finite, step.frame)
            scores.append(score)
        for name in self.model.observation_names:
            kind, at = self.owner.get(name, ("", 0))
            if kind == "count":
                step.counts[at], score = self.tallies[at].count(step.counts[at], step.frame, name, seen[name])
                scores.append(score)
            elif not kind:
                lead = step.frame.lead([*self._parents(name), (name, 0)])
                scores.append(step.frame.score(self.laws, name, seen[name], lead))
        for score in scores:
            step.score = step.score + score.to(self.dtype)

    def total(self, weights: Tensor, frame: Frame) -> Tensor:
        """Return the log of the sum of log weights (rows, worlds), (rows,); ValueOutOfRange where that is nothing."""
        total = weights.logsumexp(1)
        if not bool(torch.isfinite(total).all()):
            free = [name for name in self.model.observation_names if name not in self.owner]
            frame.check(self.laws, [name for name in free if self.structure.nodes[name].family != "Evidence"])
            raise ValueOutOfRange(f"{type(self.model).__name__} gives what was observed no probability at all")
        return total

    def made(
        self, belief: BankBelief, step: Step, known: Values, weights: Tensor, seen: Values, kept: Values | None = None
    ) -> BankBelief:
        """Return the belief after a step: ``weights`` (rows, worlds) are log p(world, observation).

        ``kept`` is what later steps ask for, where that has been found already.
        """
        total = self.total(weights, step.frame)
        names = (*self.plan.worlds, *self.plan.computed)
        values = {n: step.frame.values[n, 0] for n in names if (n, 0) in step.frame.values}
        if kept is None:
            flat = {name: value.reshape(len(value), -1) for name, value in seen.items()}
            kept = self.known.keep(known, flat) if self.known.kept else {}
        return BankBelief(
            engine=self,
            batch=belief.batch,
            time=belief.time + 1,
            log_evidence=belief.log_evidence + (total[0] if belief.batch is None else total),
            known=kept,
            log_weights=weights - total[:, None],
            values=values,
            gaussian=tuple(step.gaussian),
            fields=tuple(step.fields),
            counts=tuple(step.counts),
            finite=step.finite,
        )
