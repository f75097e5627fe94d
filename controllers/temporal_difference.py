"""Learning what is best from one's own experience (thesis section 4.8.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from apmodels import ValueOutOfRange
from controllers.belief_mdp import BeliefMDP
from controllers.dynamic_programming import DynamicProgramming, shares
from controllers.plan import Plan
from inference import Engine

Array = np.ndarray


class TemporalDifference(DynamicProgramming):
    """Learns values of the engine's statistic from trials, in which rewards are its own beliefs'.

    A trial's values are backed up, the last first, by the best action: by the one that was taken, exploring would
    corrupt them. Where values begin is what makes the controller try what it does not know.

    Args:
        engine: see DynamicProgramming.
        horizon: the steps of a trial.
        weights: see DynamicProgramming.
        reward: see DynamicProgramming.
        epsilon: the share of actions that are random.
        optimism: 1 begins with values of zero (the thesis's, as if all were known from now on), 0 as if no more would
            ever be known than in a state already.
        anywhere: begin in any known state, instead of the model's own first one.
        seed: of the trials.
        memory: act on what so many steps showed, the last ones; by default on a trial's.
        session: live for so many steps in a world before another is drawn; every stretch of ``horizon`` of them is a
            trial. By default a session is a trial.
        symmetric: learn of a state's mirror image too, where zeros and ones mean the same.
    """

    def __init__(
        self,
        engine: Engine,
        horizon: int,
        weights: str | Sequence[float] = "summed",
        reward: Callable[[Any], Any] | None = None,
        epsilon: float = 0.0,
        optimism: float = 1.0,
        anywhere: bool = False,
        seed: int = 0,
        memory: int | None = None,
        session: int | None = None,
        symmetric: bool = False,
    ):
        super(DynamicProgramming, self).__init__(engine, seed)
        if horizon < 1 or not 0 <= epsilon <= 1 or not 0 <= optimism <= 1:
            raise ValueOutOfRange(
                f"trials need 1 step or more, epsilon and optimism in [0, 1], not {horizon}, {epsilon}, {optimism}"
            )
        self.memory, self.session = horizon - 1 if memory is None else memory, horizon if session is None else session
        if not 0 <= self.memory < horizon <= self.session or (self.session > horizon and not anywhere):
            raise ValueOutOfRange(
                f"trials of {horizon} steps need a memory of fewer, not {self.memory}, and a session of as many or, "
                f"where they begin anywhere, more, not {self.session}"
            )
        self.mdp, self.horizon, self.steps = BeliefMDP(engine, reward), horizon, None
        self.weights, self.epsilon, self.seed, self.learned = shares(weights, horizon), epsilon, seed, 0
        self.table = Table(self.mdp, horizon, anywhere)
        self.starts = self.table.starts
        still = np.cumsum(np.array([0.0, *self.weights])[::-1])[::-1, None] * self.table.reward
        self.values = np.repeat((1 - optimism) * still[:, None], len(self.mdp.after), 1)
        counts = self.table.counts[..., ::-1] if symmetric and self.mdp.mirrored else self.table.counts
        self.twin = self.table.states.index(counts)
        self._policy: Plan | None = None

    def learn(self, sessions: int) -> Array:
        """Learn from so many more sessions; return how often each action was done in them, (actions,)."""
        from controllers.trials import learn

        table, process = self.table, self.mdp.process
        world = process.log_prior.exp().numpy(), process.prior.numpy(), process.component.numpy()
        weights = np.array([0.0, *self.weights])
        moves = self.mdp.after, self.mdp.atom
        seed = (self.seed * 1_000_003 + self.learned) % 2**31
        done = learn(
            self.values, table.reward, weights, moves, table.chance, table.ahead, self.twin, table.starts, world,
            self.epsilon, self.memory, self.session, sessions, seed,
        )  # fmt: skip
        self.learned += sessions
        self._policy = None
        return done

    @property
    def plan(self) -> Plan:
        """The greedy policy of what has been learned so far."""
        if self._policy is None:
            layers = {}
            for t in range(self.horizon):
                found = self.table.worths(self.values[t + 1]).argmax(1)
                layers[self.horizon - t] = np.packbits(found.astype(np.uint8), axis=1) if self.actions == 2 else found
            value = self.table.value(layers, self.weights, self.actions)
            self._policy = Plan(self.table.states, self.horizon, self.actions, value, layers, 0.0)
        return self._policy

    @property
    def actions(self) -> int:
        """How many actions there are."""
        return self.mdp.after.shape[1]


class Table:
    """All states within some steps, one by one.

    Their counts (N, K, 2), rewards (N,), hypotheses' shares ``weighed`` (H, N), chances of a one (K, N), and where
    outcomes lead, ``ahead`` (K, 2, N).
    """

    def __init__(self, mdp: BeliefMDP, steps: int, anywhere: bool):
        self.mdp = mdp
        self.starts = mdp.kind_of if anywhere else np.array([mdp.first])
        self.states = mdp.lattice(steps, mirrored=False, first=self.starts)
        self.reward, weighed = mdp.tables(self.states)
        self.counts = np.concatenate([self.states.counts(block) for block in range(len(self.states.totals))])
        self.weighed = np.concatenate([1 - weighed.sum(0, keepdims=True), weighed])
        component, prior = mdp.process.component.numpy(), mdp.process.prior.numpy()
        self.chance = np.stack([_mean(k, self.counts, self.weighed, component, prior) for k in range(len(component))])
        self.ahead = np.zeros((len(component), 2, len(self.counts)), dtype=np.int64)
        for k in range(len(component)):
            for outcome in (0, 1):
                more = self.counts.copy()
                more[:, k, outcome] += 1
                there = self.states.has(more)
                self.ahead[k, outcome, there] = self.states.index(more[there])

    def worths(self, values: Array) -> Array:
        """Return what each action is worth, (kinds, actions, states), where values (kinds, states) follow."""
        found = np.empty((*self.mdp.after.shape, self.states.size))
        for kind, (after, atom) in enumerate(zip(self.mdp.after, self.mdp.atom, strict=True)):
            for u, (to, k) in enumerate(zip(after, atom, strict=True)):
                there = values[to]
                if k >= 0:
                    zero, one = (there[self.ahead[k, outcome]] for outcome in (0, 1))
                    there = zero + self.chance[k] * (one - zero)
                found[kind, u] = there
        return found

    def solved(self, weights: Sequence[float]) -> Array:
        """Return the best policy's values, (T + 1, kinds, states), by backward induction."""
        counted = np.array([0.0, *weights])
        values = np.tile(counted[:, None, None] * self.reward, (1, len(self.mdp.after), 1))
        for t in range(len(weights) - 1, -1, -1):
            values[t] += self.worths(values[t + 1]).max(1)
        return values

    def best(self, weights: Sequence[float]) -> float:
        """Return what the best policy is worth, on average over where trials begin."""
        return float(self.solved(weights)[0, self.starts, 0].mean())

    def value(self, layers: dict[int, Array], weights: Sequence[float], actions: int) -> float:
        """Return what a policy is worth, on average over where trials begin."""
        values = np.tile(weights[-1] * self.reward, (len(self.mdp.after), 1))
        for left in range(1, len(layers) + 1):
            chosen = layers[left]
            if actions == 2:
                chosen = np.unpackbits(chosen, axis=1, count=self.states.size)
            values = np.take_along_axis(self.worths(values), chosen[:, None].astype(np.int64), 1)[:, 0]
            if left < len(layers):
                values += weights[len(layers) - left - 1] * self.reward
        return float(values[self.starts, 0].mean())


def _mean(k: int, counts: Array, shares: Array, component: Array, prior: Array) -> Array:
    found = np.zeros(len(counts))
    for h, c in enumerate(component[k]):
        pool = counts[:, component[:, h] == c].sum(1) + prior[h, c]
        found += shares[h] * pool[:, 1] / pool.sum(1)
    return found
