"""An engine's sufficient statistic as a Markov decision process: what planners and learners need, and nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.special import gammaln

from controllers.lattice import Lattice, lattice
from controllers.rewards import Information
from controllers.threads import threads_for
from inference import Engine, Refusal

Array = np.ndarray
# Beliefs that are asked for a reward at a time.
CHUNK = 256
# So many are asked to find out how long it takes.
SOME = 8


class BeliefMDP:
    """States are counts and a known state; actions lead on by what is known, outcomes by what is believed.

    Known states from which all that follows is alike are one ``kind``: of a timer, the last step in which an answer may
    come and all later ones.

    Args:
        engine: one that counts (``inference.Exact`` with Beta variables).
        reward: a function of beliefs, (*batch,).
    """

    def __init__(self, engine: Engine, reward: Callable[[Any], Any] | None = None):
        process = getattr(engine, "process", None)
        if process is None:
            raise Refusal(f"{type(engine).__name__} has no sufficient statistic to plan on: use Exact, where it counts")
        self.engine, self.reward = engine, reward or Information()
        self.process = process()
        if self.process.prior.shape[-1] != 2 or not self.process.atoms:
            raise Refusal(f"{type(engine.model).__name__} counts no outcomes of two values: no plan can be made yet")
        self.after, self.atom, self.kind_of = _kinds(self.process.after.numpy(), self.process.atom.numpy())
        self.first = int(self.kind_of[self.process.first])

    @property
    def mirrored(self) -> bool:
        """Whether zeros and ones mean the same: all priors are symmetric, and the reward asks for hypotheses alone."""
        prior = self.process.prior
        return self.groups() is not None and bool((prior[..., 0] == prior[..., 1]).all())

    def groups(self) -> Any:
        """Return which value of the interest each hypothesis has, where rewards are information about those."""
        return self.reward.groups(self.process) if isinstance(self.reward, Information) else None

    def lattice(self, steps: int, mirrored: bool | None = None, first: Any = None) -> Lattice:
        """Return all counts that can be reached in some steps, from a kind of known state or some of them."""
        first = self.first if first is None else first
        mirrored = self.mirrored if mirrored is None else mirrored
        return lattice(self.after, self.atom, first, self.process.atoms, steps, mirrored)

    def tables(self, states: Lattice) -> tuple[Array, Array]:
        """Return every state's reward, (N,), and the share of every hypothesis but the first, (H - 1, N)."""
        # Importing a compiler takes long; who does not plan does not wait for it.
        from controllers.sweeps import informed

        process = self.process
        reward, shares = np.empty(states.size), np.empty((len(process.log_prior) - 1, states.size))
        groups, most = self.groups(), int(states.totals.sum(1).max()) + 1
        prior = process.prior.numpy()
        total = prior.sum(-1)
        normal = gammaln(prior[..., None] + np.arange(most)) - gammaln(prior)[..., None]
        whole = gammaln(total[..., None] + np.arange(most)) - gammaln(total)[..., None]
        which = np.zeros(len(process.log_prior), dtype=np.int64) if groups is None else groups.numpy()
        component, logs = process.component.numpy(), process.log_prior.numpy()
        with threads_for(states.size):
            informed(reward, shares, states.rows, states.packed, logs, which, component, normal, whole)
        if groups is None:
            self._asked(reward, states)
        return reward, shares

    def seconds(self, states: int) -> float:
        """Return about how long it takes to ask for so many states' rewards; 0 where they are in closed form."""
        if self.groups() is not None:
            return 0.0
        some = self.process.beliefs(torch.zeros(SOME, self.process.atoms, 2, dtype=torch.int64))
        begin = time.perf_counter()
        self.reward(some)
        return (time.perf_counter() - begin) / SOME * states

    def _asked(self, reward: Array, states: Lattice) -> None:
        """Ask the reward itself, a chunk of beliefs at a time."""
        counts = np.concatenate([states.counts(block) for block in range(len(states.totals))])
        for start in range(0, len(counts), CHUNK):
            part = torch.as_tensor(counts[start : start + CHUNK])
            reward[start : start + len(part)] = np.asarray(self.reward(self.process.beliefs(part)), dtype=np.float64)

    def read(self, belief: Any) -> tuple[Array, Array]:
        """Return the kind of a belief's known state, (rows,), and its counts, (rows, K, 2)."""
        state, counts = self.process.read(belief)
        return self.kind_of[state.numpy()], counts.numpy()


def belief_mdp(engine: Engine, reward: Callable[[Any], Any] | None = None) -> BeliefMDP:
    """Return an engine's sufficient statistic as a Markov decision process; see :class:`BeliefMDP`."""
    return BeliefMDP(engine, reward)


def _kinds(after: Array, atom: Array) -> tuple[Array, Array, Array]:
    """Merge states from which all that follows is alike; return the merged tables, and each state's kind."""
    kind = np.zeros(len(after), dtype=np.int64)
    while True:
        marks = np.concatenate([kind[:, None], kind[after], atom], 1)
        _, firsts, found = np.unique(marks, axis=0, return_index=True, return_inverse=True)
        found = found.reshape(-1)
        if found.max() == kind.max():
            return kind[after[firsts]], atom[firsts], kind if np.array_equal(found, kind) else found
        kind = found
