"""A policy found by backward induction, packed into bits."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controllers.belief_mdp import BeliefMDP
from controllers.lattice import Lattice
from controllers.threads import threads_for

Array = np.ndarray


@dataclass(frozen=True)
class Plan:
    """The best action of every state, by how many steps are left.

    ``value`` is what is expected of the best policy from the first belief on; ``layers`` are by the steps that are
    left, (kinds, bytes) packed bits where there are two actions, else (kinds, states) whole; ``seconds`` are those of
    solving.
    """

    states: Lattice
    horizon: int
    actions: int
    value: float
    layers: dict[int, Array]
    seconds: float

    def choose(self, kind: Array, counts: Array, left: int) -> Array:
        """Return the best action's number, (n,), with ``left`` steps left; of kinds (n,) and counts (n, K, 2)."""
        layer, at = self.layers[left], self.states.index(counts)
        if self.actions > 2:
            return layer[kind, at]
        return layer[kind, at >> 3] >> (7 - (at & 7)).astype(np.uint8) & 1


def solve(
    mdp: BeliefMDP,
    horizon: int,
    weights: Sequence[float],
    steps: int = 0,
    keep: Callable[[int], bool] = lambda left: True,
    advance: Callable[[], Any] = lambda: None,
    states: Lattice | None = None,
    tables: tuple[Array, Array] | None = None,
) -> Plan:
    """Return the best policy over a horizon.

    Args:
        mdp: what is to be planned.
        horizon: how many steps a plan looks ahead.
        weights: how much the reward after each of them counts.
        steps: how many steps may have passed before the plan is asked (a receding horizon).
        keep: which steps that are left are kept.
        advance: called after every sweep.
        states: all counts that can be reached in as many steps, where they have been laid out already.
        tables: their rewards, and the hypotheses' shares, where these are known already.
    """
    from controllers.sweeps import sweep

    begin = time.perf_counter()
    states = states or mdp.lattice(horizon + steps)
    reward, shares = mdp.tables(states) if tables is None else tables
    kinds, actions = mdp.after.shape
    pairs = np.stack([mdp.after, mdp.atom], -1).reshape(-1, 2)
    moves, choices = np.unique(pairs, axis=0, return_inverse=True)
    values = np.empty((kinds, states.size))
    np.multiply(reward, weights[-1], out=values[0])
    values[1:] = values[0]
    counted = mdp.process.component.numpy(), mdp.process.prior.numpy()
    options = choices.reshape(kinds, actions)
    way = np.ascontiguousarray(moves[:, 0]), np.ascontiguousarray(moves[:, 1])
    layers: dict[int, Array] = {}
    with threads_for(states.size):
        for left in range(1, horizon + 1):
            bound = horizon + steps - left
            weight = weights[horizon - left - 1] if left < horizon else 0.0
            decided = np.zeros((kinds, states.size if keep(left) else 0), dtype=np.uint8)
            sweep(
                values,
                reward,
                shares,
                weight,
                states.rows,
                states.layers,
                bound,
                states.packed,
                counted,
                way,
                options,
                decided,
            )
            if keep(left):
                reached = int(states.offset[states.earliest <= bound].max()) + int(_largest(states, bound))
                layers[left] = (
                    np.packbits(decided[:, :reached], axis=1) if actions == 2 else decided[:, :reached].copy()
                )
            advance()
    value = float(values[mdp.first, 0])
    return Plan(states, horizon, actions, value, layers, time.perf_counter() - begin)


def size(mdp: BeliefMDP, states: Lattice, horizon: int, steps: int, kept: int) -> tuple[float, float]:
    """Return how many bytes solving takes, and how many values are computed."""
    kinds, actions = mdp.after.shape
    sizes = np.append(states.offset[1:], states.size) - states.offset
    order = np.argsort(states.earliest, kind="stable")
    below = np.concatenate([[0], np.cumsum(sizes[order])])
    ends = np.searchsorted(states.earliest[order], np.arange(horizon + steps + 1), side="right")
    visits = below[ends[steps : horizon + steps]].sum() * kinds
    bits = kinds * states.size * (1 / 8 if actions == 2 else 1)
    working = states.size * (8.0 * (kinds + len(mdp.process.log_prior)) + (kinds if kept else 0))
    return working + kept * bits, float(visits)


def _largest(states: Lattice, bound: int) -> int:
    """How many states the last block that is reached has."""
    ends = np.append(states.offset[1:], states.size)
    last = np.flatnonzero(states.earliest <= bound)[-1]
    return int(ends[last] - states.offset[last])
