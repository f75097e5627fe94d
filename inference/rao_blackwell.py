"""Particles of what cannot be integrated; all the rest is integrated in each of them (thesis ch. 6, section 6.4)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.errors import nearest
from apmodels.simulation import Values, seeded
from apmodels.structure import Structure
from inference.engine import Bid, Refusal
from inference.records.record import Record
from inference.records.swarm import Swarm
from inference.worlds.bank import Bank
from inference.worlds.gaussian import Gaussian
from inference.worlds.gaussian_block import predicted, seen_by
from inference.worlds.offsets import NothingSeen, NoTranslation, Offsets, displacements, follow
from inference.worlds.plan import Plan, make_plan
from inference.worlds.rejuvenation import Past, forgotten, rejuvenated
from inference.worlds.step import BankBelief, Step, even, pick, take_worlds
from inference.worlds.trying import combinations, give

# How many values are tried where one particle is kept.
CANDIDATES = 256
# Displacements are looked for where their standard deviation is more than so much of a pixel.
FINE = 0.3


class DepletionWarning(UserWarning):
    """So few particles carry the weight that beliefs are hardly to be trusted."""


class RaoBlackwell(Bank):
    """Rao-Blackwellised particles.

    What is sampled is found by the one rule (see apmodels.structure), and finite variables that bear on what is
    integrated are sampled too. Particles are resampled (systematically) when their effective number falls below a
    share of them; sampled statics are then rejuvenated by a Metropolis move that leaves the posterior as it is.

    Args:
        model: see Engine.
        particles: how many. One is the conditional maximum a posteriori of thesis 6.4: of ``candidates`` drawn values
            the best-scoring is kept.
        given: more variables to sample.
        dtype: see Engine.
        seed: the same seed draws the same particles; a belief's update is a function of the seed and its time.
        threshold: resample below this share of effective particles.
        candidates: how many values are tried where one particle is kept.
    """

    def __init__(
        self,
        model: Model,
        particles: int = 1000,
        given: str | Iterable[str] = (),
        dtype: torch.dtype | None = None,
        seed: int = 0,
        threshold: float = 0.5,
        candidates: int = CANDIDATES,
    ):
        if particles < 1 or candidates < 1:
            raise ValueOutOfRange(f"there must be 1 particle or more, not {particles} ({candidates} candidates)")
        plan: Any = self.divide(model.structure, given) if isinstance(model, Model) else None
        super().__init__(model, plan, dtype)
        # Where nothing must be sampled, all particles are alike.
        particles, candidates = (particles, candidates) if plan.worlds else (1, 1)
        self.particles, self.seed, self.threshold = particles, seed, threshold
        self.candidates, self.chooses = (candidates, True) if particles == 1 else (particles, False)
        statics = self.model.declaration.names["static"]
        self.guide: Any = None
        self._swarm: Swarm | None = None
        moves = displacements(self.structure, self.plan, self.images)
        self.offsets = {d.name: Offsets(self, d) for d in moves if self.owner.get(d.name, ("", 0))[0] == "gaussian"}
        self.sampled_statics = [name for name in self.plan.worlds if name in statics]
        self.tried, self.every = self.candidates, {}
        if self.offsets and self.chooses and not self.sampled_statics:
            self.every = combinations(self.structure, self.plan.worlds, self.candidates)
            self.candidates = len(next(iter(self.every.values()), (0,)))
        for name in self.offsets:
            # As late as can be: what is seen after a displacement may depend on what else has happened.
            after = follow(self.structure, name)
            self.order = [n for n in self.order if n not in after] + [n for n in self.order if n in after]

    def divide(self, structure: Structure, given: str | Iterable[str]) -> Plan:
        """Return the plan: what is sampled by rule, and what is sampled by wish."""
        wanted = (given,) if isinstance(given, str) else tuple(given)
        for name in wanted:
            node = structure.nodes.get(name)
            hidden = [node.name for node in structure.hidden if node.random]
            if node is None or name not in hidden:
                raise Refusal(f"{structure.model} has no random hidden variable {name}{nearest(name, hidden)}")
        return make_plan(structure, wanted)

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve models of which some part must be sampled and some can be integrated."""
        plan = make_plan(structure)
        sampled = [name for name in plan.worlds]
        if not sampled:
            return Bid(0.5, "nothing must be sampled: an exact engine is better")
        for name, node in structure.nodes.items():
            if node.role == "observation" and node.family == "Evidence" and _meets(structure, name, plan):
                return Bid(0.0, f"{name} is an Evidence, and cannot be scored against what is integrated")
        if not plan.integrated and not plan.finite:
            return Bid(0.35, f"{', '.join(sampled)} sampled, and nothing integrated: plain particles do")
        rest = [*sorted(plan.integrated), *plan.finite]
        return Bid(0.8, f"{', '.join(sampled)} sampled; {', '.join(rest)} integrated")

    # Beginning.

    def people(self, step: Step) -> tuple[Step, Tensor]:
        """Draw the statics of every particle."""
        given = step.given
        worlds = self.candidates if given is None else next(iter(given.values())).shape[1]
        step.lead = (step.lead[0], worlds)
        for name in self.model.declaration.names["static"]:
            if name in self.plan.worlds:
                self.draw(step, name, None if step.given is None else step.given[name], birth=True)
            elif name in self.plan.computed:
                step.frame.values[name, 0] = step.frame.in_all(self.laws, name, step.lead)  # type: ignore[assignment]
            self.births(step, name)
        prior = step.prior if step.given is not None else torch.zeros(1, step.lead[1], dtype=self.dtype)
        return step, prior.expand(-1, step.lead[1])

    def start(self, batch: int | None = None, given: Values | None = None) -> BankBelief:
        """Return the belief before any data; without ``batch``, a single one."""
        with seeded(self.seed * 1_000_003 if given is None else None):
            belief = super().start(batch, given)
        values = {n: v.expand(len(belief.log_weights), *v.shape[1:]) for n, v in belief.values.items()}
        past = Past() if self.sampled_statics and self.particles > 1 else None
        return replace(belief, values=values, past=past)

    def replay_start(self, batch: int | None, statics: Values) -> BankBelief:
        """Return the belief before any data in which the particles' statics are these, weighed by their prior."""
        return super().start(batch, statics)

    def model_law(self, name: str) -> Any:
        """Return the law of a static in one world that was drawn for the purpose."""
        return self.structure_laws()[name]

    def structure_laws(self) -> dict[str, Any]:
        """Return a law of every static, in some world."""
        with seeded(0):
            values: Values = {}
            laws: dict[str, Any] = {}
            for variable in self.model.declaration.of_role("static"):
                law = self.laws.one(variable.name, {p.argument: values[p.name] for p in variable.parents})
                laws[variable.name] = law
                values[variable.name] = law if isinstance(law, Tensor) else law.sample()
        return laws

    # Moving on.

    def update(self, belief: BankBelief, action: Any, observation: Any) -> BankBelief:
        """Return the belief after one more action and observation."""
        rows, before = len(belief.log_weights), belief
        actions, seen = self._actions(action, rows), self.seen_as(observation, rows)
        with seeded(self.seed * 1_000_003 + belief.time + 1):
            if self.particles > 1:
                belief = self.refreshed(belief)
            elif belief.log_weights.shape[1] == 1 < self.candidates:
                belief = spread(belief, self.candidates)
            step, known = self.step_of(belief, actions)
            step.seen = seen
            try:
                step = self.propagate(step, seen)
            except NoTranslation:
                # The graph would have allowed it, the laws do not: values are tried, as for any other variable.
                self.offsets, self.every, self.candidates = {}, {}, self.tried
                return self.update(before, action, observation)
            weights = belief.log_weights + step.score
            if self.particles == 1:
                return self._best(belief, step, known | actions, weights, seen)
        after = self.made(belief, step, known | actions, weights, seen)
        if belief.past is not None:
            drawn = {name: after.values[name] for name in self.plan.worlds if self.roles[name] == "state"}
            after = replace(after, past=belief.past.after(actions, seen, drawn))
        self.watched(after)
        return after

    def along(self, record: Record, batch: int | None) -> Sequence[BankBelief]:
        """Return the beliefs along a record."""
        self._swarm = self._swarm or Swarm(self)
        return self._swarm.along(record, batch)

    def propagate(self, step: Step, seen: Values) -> Step:
        """Draw the particles' states, and condition on what is seen."""
        self.move(step)
        self.sense(step, seen)
        return step

    def draw(self, step: Step, name: str, given: Tensor | None = None, birth: bool = False) -> None:
        """Draw one variable of every world; a displacement by what is seen, of which every offset is scored."""
        offsets = self.offsets.get(name)
        if given is None and step.seen is not None and name in self.every:
            return give(self, step, name, self.every[name])
        if offsets is None or given is not None or step.seen is None:
            return super().draw(step, name, given, birth)
        _, at = self.owner[name]
        block = self.gaussians[at]
        belief = block.advance(step.gaussian[at], step.frame, name, birth)
        view = block.view(step.frame, name, birth)
        prior = predicted(belief, view)
        if not self.chooses and not bool((torch.linalg.eigvalsh(prior.covariance) > FINE**2).all()):
            # Where it is known to a fraction of a pixel, a draw of its own does better.
            return super().draw(step, name, given, birth)
        try:
            value, chosen, expected = offsets.choose(step, prior, step.seen, best=self.chooses)
        except NothingSeen:
            expected = prior.mean.expand(*step.lead, -1)
            return super().draw(step, name, expected if self.chooses else None, birth)
        step.gaussian[at], log_p = seen_by(belief, view, value)
        step.score = step.score + (expected if self.chooses else log_p.to(self.dtype)) - chosen
        step.frame.values[name, 0] = value

    def refreshed(self, belief: BankBelief, many: Tensor | None = None) -> BankBelief:
        """Resample where the effective number of particles is low, and rejuvenate what is static."""
        low = (effective(belief.log_weights) if many is None else many) < self.threshold * self.particles
        if not bool(low.any()):
            # A finite static's value that no particle has any more is tried again, more and more rarely.
            lost = belief.past is not None and belief.time.bit_count() == 1 and forgotten(self, belief)
            return rejuvenated(self, belief, ~low) if lost else belief
        index = even(belief.log_weights, self.particles)
        stay = torch.arange(self.particles).expand(index.shape)
        index = torch.where(low[:, None], index, stay)
        weights = torch.where(low[:, None], -math.log(self.particles), belief.log_weights)
        belief = replace(resampled(belief, index), log_weights=weights)
        return belief if belief.past is None else rejuvenated(self, belief, low)

    def _best(self, belief: BankBelief, step: Step, known: Values, weights: Tensor, seen: Values) -> BankBelief:
        """Keep the one value that scores best, by its prior and by what was seen (thesis eq. 6.7)."""
        total = self.total(weights, step.frame)
        prior = step.prior
        if not belief.time and self.sampled_statics:
            statics = {name: belief.values[name] for name in self.sampled_statics}
            prior = prior + self.replay_start(belief.batch, statics).log_weights
        best = (weights + prior).argmax(1, keepdim=True)
        only = take_worlds(step, best)
        after = self.made(belief, only, known, torch.zeros(len(best), 1, dtype=self.dtype), seen)
        evidence = belief.log_evidence + (total[0] if belief.batch is None else total)
        return replace(after, log_evidence=evidence)

    def watched(self, belief: BankBelief) -> Tensor:
        """Return the effective number of particles, (rows,), and say so where few carry the weight."""
        many = effective(belief.log_weights)
        fewest = float(many.min())
        if fewest < max(2.0, 0.005 * self.particles):
            warnings.warn(
                f"{type(self.model).__name__}: at step {belief.time} {fewest:.1f} of {self.particles} particles carry "
                "the weight; use more, or another engine",
                DepletionWarning,
                stacklevel=4,
            )
        return many


def _meets(structure: Structure, name: str, plan: Plan) -> bool:
    return any(arrow.parent in plan.integrated for arrow in structure.into(name))


def effective(log_weights: Tensor) -> Tensor:
    """Return the effective number of particles, (rows,)."""
    weights = log_weights.exp()
    return 1 / (weights * weights).sum(1)


def resampled(belief: BankBelief, index: Tensor) -> BankBelief:
    """Return a belief over chosen particles (rows, count), with their weights as they are."""
    return replace(
        belief,
        values={name: pick(value, index) for name, value in belief.values.items()},
        gaussian=tuple(Gaussian(pick(g.mean, index), pick(g.covariance, index)) for g in belief.gaussian),
        fields=tuple({n: (pick(m, index), pick(v, index)) for n, (m, v) in some.items()} for some in belief.fields),
        counts=tuple(pick(counts, index) for counts in belief.counts),
        finite=None if belief.finite is None else pick(belief.finite, index),
        past=None if belief.past is None else belief.past.resampled(index),
    )


def spread(belief: BankBelief, count: int) -> BankBelief:
    """Return a belief in one world as one in many that are alike."""
    index = torch.zeros(len(belief.log_weights), count, dtype=torch.int64)
    weights = torch.full(index.shape, -math.log(count), dtype=belief.log_weights.dtype)
    wide = {name: value.expand(value.shape[0], count, *value.shape[2:]) for name, value in belief.values.items()}
    return replace(belief, log_weights=weights, values=wide)
