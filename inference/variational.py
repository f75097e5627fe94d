"""Stochastic variational inference, with Pyro's automatic guides, on any model that can be scored.

The guide is fitted to the whole record; finite variables are enumerated. Draws from it are then weighed by how probable
they make the record, the finite variables summed in each, and drawn anew where the weights say (adaptive importance
sampling): what is reported is as good as the draws cover the posterior, and not as bad as the guide's shape.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.infer import SVI, Trace_ELBO, TraceEnum_ELBO
from pyro.infer.autoguide import AutoMultivariateNormal, AutoNormal
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.progress import tracked
from apmodels.simulation import Values, as_given, seeded
from apmodels.structure import Structure
from inference.answers.draws import draw_values
from inference.engine import Bid, Engine
from inference.guides.amortised import Amortised
from inference.guides.posterior_draws import Draws, Proposal, proposal
from inference.guides.variational_belief import VariationalBelief, line
from inference.particles import Particles
from inference.rao_blackwell import DepletionWarning, effective
from inference.worlds.plan import make_plan
from inference.worlds.scored_bank import ScoredBank
from inference.worlds.step import BankBelief

GUIDES = {"full": AutoMultivariateNormal, "diagonal": AutoNormal}
# The draws are weighed, and taken anew where their weights say, until this share is effective, or so many times.
PLENTY, ROUNDS = 0.4, 8
# Records that take longer show how far they are.
LONG = 2000


class Variational(Engine):
    """Fits a guide over everything continuous to the whole record; what is finite is enumerated.

    A belief is fitted when something is asked of it, starting from where the fit of the step before ended, so that a
    belief asked for at every step is learned online; one asked for at the end costs one fit. After :meth:`learn` a
    network that was taught by simulated records takes the place of fitting.

    Args:
        model: see Engine.
        guide: "full" (a joint Gaussian in unconstrained space), "diagonal" (independent ones; batches use it always),
            or a function of a Pyro program that returns an automatic guide of one of these two families.
        iterations: steps of gradient descent in a first fit; later ones take a quarter.
        draws: how many draws from the guide are weighed.
        rate: the step of Adam.
        dtype: see Engine.
        seed: see RaoBlackwell.
    """

    def __init__(
        self,
        model: Model,
        guide: Any = "full",
        iterations: int = 150,
        draws: int = 4000,
        rate: float = 0.05,
        dtype: torch.dtype | None = None,
        seed: int = 0,
    ):
        super().__init__(model, dtype)
        if isinstance(guide, str) and guide not in GUIDES:
            raise ValueOutOfRange(f"there is no guide {guide}; there are {', '.join(GUIDES)}")
        if iterations < 1 or draws < 2:
            raise ValueOutOfRange(f"a fit needs iterations and draws, not {iterations} and {draws}")
        self.guide, self.iterations, self.draws, self.rate, self.seed = guide, iterations, draws, rate, seed
        self.network: Amortised | None = None
        self.bank = ScoredBank(model, self.dtype)
        self.loose = Particles(model, particles=1024, dtype=self.dtype, guided=False)

    def learn(self, steps: int = 10, rounds: int = 400, records: int = 256, rate: float = 3e-3) -> list[float]:
        """Learn a guide that serves every record at once, from records that the model itself simulates (amortised).

        Args:
            steps: how long the records may be.
            rounds: how many batches.
            records: how many in a batch.
            rate: the step of Adam, at first.

        Returns:
            How unlikely the hidden variables were, batch by batch, nats.
        """
        free = [name for name in self.bank.plan.worlds if self.structure.nodes[name].values is None]
        if not free:
            raise ValueOutOfRange(f"nothing that {type(self.model).__name__} hides is continuous: nothing to learn")
        with seeded(self.seed):
            network = Amortised(self.model, free)
            losses = network.learn(steps, rounds, records, rate, self.seed)
        self.network = network
        return losses

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve any model that can be scored by Pyro."""
        for node in structure.hidden:
            if node.random and node.values is None and node.family in ("Poisson", "Geometric", "NegativeBinomial"):
                return Bid(0.0, f"{node.name} is a {node.family}: neither finite nor continuous")
        for arrow in structure.arrows:
            if (
                structure.nodes[arrow.parent].role == structure.nodes[arrow.child].role == "observation"
                and not arrow.lag
            ):
                return Bid(0.0, f"{arrow.child} depends on {arrow.parent}, an observation of the same step")
        for arrow in structure.arrows:
            parent = structure.nodes[arrow.parent]
            if not arrow.smooth and parent.hidden and parent.values is None:
                return Bid(0.0, f"{arrow.child} changes in steps with {arrow.parent}: there is no gradient to follow")
        free = [n.name for n in structure.hidden if n.random and n.values is None]
        for name in set(make_plan(structure, free, scored=True).worlds) - set(free):
            mixed = next(a.child for a in structure.out_of(name) if not structure.nodes[a.child].random)
            return Bid(0.0, f"{name} cannot be summed: {mixed} is computed from it and from what is continuous")
        if not free:
            return Bid(0.1, "nothing that is hidden is continuous: there is nothing to fit")
        return Bid(0.3, f"a guide over {', '.join(free)}")

    def start(self, batch: int | None = None) -> VariationalBelief:
        """Return the belief before any data; without ``batch``, a single one."""
        first = self.bank.start_known(batch)
        return VariationalBelief(self, batch, 0, None, first, ())  # type: ignore[arg-type]

    def update(self, belief: VariationalBelief, action: Any, observation: Any) -> VariationalBelief:
        """Return the belief after one more action and observation; it is fitted when something is asked of it."""
        rows = belief.batch or 1
        actions, seen = self._actions(action, rows), self.bank.seen_as(observation, rows)
        known, _ = self.bank.known.move(belief.known, actions, rows)
        flat = {name: value.reshape(rows, -1) for name, value in seen.items()}
        kept = self.bank.known.keep(known | actions, flat) if self.bank.known.kept else {}
        record = (*belief.record, (actions, seen))
        return VariationalBelief(self, belief.batch, belief.time + 1, None, kept, record, belief)  # type: ignore[arg-type]

    # Asking.

    def marginal(self, belief: VariationalBelief, name: str) -> Any:
        """Return the distribution of a hidden variable."""
        return self.bank.marginal(self.posterior(belief), name)

    def entropy(self, belief: VariationalBelief, names: Any = None) -> Tensor:
        """Return the joint entropy of variables in nats, (*batch,)."""
        return self.bank.entropy(self.posterior(belief), names)

    def most_probable(self, belief: VariationalBelief, name: str | None = None) -> Tensor:
        """Return the most probable value of a variable, (*batch, *shape)."""
        return self.bank.most_probable(self.posterior(belief), name)

    def forecast(self, belief: VariationalBelief, action: Any) -> Any:
        """Return the predictive distribution of the next observation."""
        return self.loose.forecast(self.cloud(belief), action)

    def gain(self, belief: VariationalBelief, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return the expected information about the interest, nats, (*batch, K), from draws of the posterior."""
        return self.loose.gain(self.cloud(belief), actions, samples, seed)

    def expect(
        self, belief: VariationalBelief, worth: Any, actions: Any = None, samples: int = 64, seed: int = 0
    ) -> Tensor:
        """Return the expectation of a function of the next belief about the interest, from draws of the posterior."""
        return self.loose.expect(self.cloud(belief), worth, actions, samples, seed)

    def cloud(self, belief: VariationalBelief) -> BankBelief:
        """Return the posterior as particles of everything."""
        found = self.posterior(belief)
        count = self.loose.particles
        values = draw_values(self.bank, found, count, self.seed)
        names = (*self.loose.plan.worlds, *self.loose.plan.computed)
        blank = self.loose.start(belief.batch)
        weights = torch.full((len(found.log_weights), count), -math.log(count), dtype=self.dtype)
        values = {name: value for name, value in values.items() if name in names}
        known = {"known": belief.known, "log_evidence": found.log_evidence, "past": None}
        return replace(blank, time=belief.time, log_weights=weights, values=values, **known)

    # Fitting.

    def posterior(self, belief: VariationalBelief) -> BankBelief:
        """Return the weighed draws of the guide, fitted if need be."""
        if "posterior" not in belief.kept:
            # A parameter store of its own: a user's other guides stay as they are.
            with pyro.get_param_store().scope(), seeded(self.seed * 1_000_003 + belief.time):
                try:
                    guide = self._fitted(belief)
                except ValueError as error:
                    # Pyro appends a table of shapes.
                    raise ValueOutOfRange(str(error).split("\n")[0]) from error
                belief.kept["posterior"] = self._weighed(belief, guide)
        return belief.kept["posterior"]

    def _fitted(self, belief: VariationalBelief) -> Proposal | None:
        """Fit a guide to the record; None where nothing is continuous yet."""
        free = [name for name in self.bank.plan.worlds if belief.time or self.bank.roles[name] == "static"]
        if not free:
            return None
        if self.network is not None:
            return self.network.proposal(*self._record(belief))
        program = self._program(belief)
        hidden = [site for site in self._finite_sites(belief)]
        guide = self._guide(poutine.block(program, hide=hidden), belief.batch)
        self._warm(guide, belief)
        loss: Any = TraceEnum_ELBO if hidden else Trace_ELBO
        planes = 1 if belief.batch is not None else 0
        elbo = loss(num_particles=4, vectorize_particles=True, max_plate_nesting=planes)
        rate = {"lr": self.rate, "lrd": 0.1 ** (1 / self.iterations)}
        svi = SVI(program, guide, pyro.optim.ClippedAdam(rate), loss=elbo)  # type: ignore[attr-defined]
        warm = any("parameters" in b.kept for b in line(belief))
        many = max(self.iterations // 4, 1) if warm else self.iterations
        rounds = tracked(range(many), "fitting") if many * belief.time > LONG else range(many)
        for _ in rounds:
            value: Any = svi.step()
            if not math.isfinite(value):
                raise ValueOutOfRange(
                    f"the fit of {type(self.model).__name__} diverged; try a smaller rate than {self.rate}"
                )
        belief.kept["parameters"] = {name: p.detach().clone() for name, p in guide.named_parameters()}
        return proposal(guide, belief.batch or 1)

    def _record(self, belief: VariationalBelief) -> tuple[Values, Values]:
        """The record so far: actions and observations (rows, steps, *shape) by name."""
        rows = belief.batch or 1
        actions = {n: torch.zeros(rows, 0, *space.shape) for n, space in self.spaces.items()}
        seen = {n: torch.zeros(rows, 0, *shape, dtype=self.dtype) for n, shape in self.shown.items()}
        if belief.record:
            actions = {n: torch.stack([a[n] for a, _ in belief.record], 1) for n in actions}
            seen = {n: torch.stack([s[n][:, 0] for _, s in belief.record], 1) for n in seen}
        return actions, seen

    def _program(self, belief: VariationalBelief) -> Any:
        actions, seen = self._record(belief)
        if belief.batch is None:
            actions, seen = ({n: v[0] for n, v in some.items()} for some in (actions, seen))
        return self.model.pyro(None, as_given(actions), as_given(seen))

    def _finite_sites(self, belief: VariationalBelief) -> list[str]:
        sites = []
        for node in self.structure.hidden:
            if node.random and node.values is not None:
                steps = range(1, belief.time + 1)
                sites += [node.name] if node.role == "static" else [f"{node.name}_{t}" for t in steps]
        return sites

    def _guide(self, program: Any, batch: int | None) -> Any:
        made = self.guide
        if isinstance(made, str):
            made = GUIDES["diagonal" if batch is not None else made]
        guide = made(program)
        guide()
        return guide

    def _warm(self, guide: Any, belief: VariationalBelief) -> None:
        """Begin where the fit of an earlier step ended, for what it knew already."""
        known = next((b.kept["parameters"] for b in line(belief) if "parameters" in b.kept), None)
        if known is None or not isinstance(guide, AutoNormal):
            return
        with torch.no_grad():
            for name, parameter in guide.named_parameters():
                if name in known and known[name].shape == parameter.shape:
                    parameter.copy_(known[name])

    def _weighed(self, belief: VariationalBelief, guide: Proposal | None) -> BankBelief:
        if guide is None:
            blank = torch.zeros(belief.batch or 1, 1, dtype=self.dtype)
            return self.bank.scored(belief.batch, belief.record, Draws({}, blank, blank[..., None]))
        for _ in range(ROUNDS):
            draws = guide.draw(self.draws)
            found = self.bank.scored(belief.batch, belief.record, draws)
            fewest = float(effective(found.log_weights).min())
            if fewest > PLENTY * self.draws:
                break
            guide = guide.learned(draws, found.log_weights)
        if fewest < max(10.0, 0.005 * self.draws):
            warnings.warn(
                f"{type(self.model).__name__}: the guide covers the posterior of step {belief.time} badly "
                f"({fewest:.1f} of {self.draws} draws carry the weight); use another guide, or more iterations",
                DepletionWarning,
                stacklevel=4,
            )
        return found
