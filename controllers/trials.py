"""Learning from trials on a Markov decision process of counts, compiled (numba)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def worth(values, kind, state, action, moves, chance, ahead):
    """What is expected of an action: the values of where it may lead, by how probable they are (eq. 4.56)."""
    after, atom = moves
    there, k = values[after[kind, action]], atom[kind, action]
    if k < 0:
        return there[state]
    p = chance[k, state]
    return (1 - p) * there[ahead[k, 0, state]] + p * there[ahead[k, 1, state]]


@njit(cache=True)
def best(values, kind, state, moves, chance, ahead):
    """What the best action is expected to lead to."""
    found = -np.inf
    for u in range(moves[0].shape[1]):
        found = max(found, worth(values, kind, state, u, moves, chance, ahead))
    return found


@njit(cache=True)
def greedy(values, kind, state, moves, chance, ahead):
    """The best action; of those that are equal any, at random."""
    top, chosen, equal = -np.inf, 0, 0
    for u in range(moves[0].shape[1]):
        here = worth(values, kind, state, u, moves, chance, ahead)
        if here > top:
            top, chosen, equal = here, u, 1
        elif here == top:
            equal += 1
            if np.random.randint(equal) == 0:
                chosen = u
    return chosen


@njit(cache=True)
def counted(states, atoms, outcomes, ahead):
    """Fill states (n + 1,) by what n steps showed, from no counts on."""
    states[0] = 0
    for j in range(len(atoms)):
        states[j + 1] = ahead[atoms[j], outcomes[j], states[j]] if atoms[j] >= 0 else states[j]


@njit(cache=True)
def drawn(rates, world):
    """Draw a hypothesis, and fill the rates of its components."""
    prior, pseudo, _ = world
    hypothesis = np.searchsorted(np.cumsum(prior), np.random.random())
    hypothesis = min(hypothesis, len(prior) - 1)
    for c in range(len(rates)):
        rates[c] = np.random.beta(pseudo[hypothesis, c, 1], pseudo[hypothesis, c, 0])
    return hypothesis


@njit(cache=True)
def learn(values, reward, weights, moves, chance, ahead, twin, starts, world, epsilon, memory, length, sessions, seed):
    """Learn values (T + 1, kinds, states) in place from so many sessions; return how often each action was done.

    A session draws a world and acts in it for ``length`` steps, on what the last ``memory`` steps showed, greedily but
    for a share ``epsilon`` of random actions. Each stretch of T steps in it is a trial, the last first: the values of
    what it met are backed up, the last first, by the best action and not the one taken. ``twin`` (N,) are states that
    are worth the same; ``world`` are the hypotheses' probabilities, the pseudo-counts of their components, and which
    component an atom is drawn from.
    """
    np.random.seed(seed)
    after, atom = moves
    steps, component = len(values) - 1, world[2]
    done = np.zeros(after.shape[1], dtype=np.int64)
    kinds, states = np.zeros(length + 1, dtype=np.int64), np.zeros(steps + 1, dtype=np.int64)
    atoms, outcomes = np.zeros(length, dtype=np.int64), np.zeros(length, dtype=np.int64)
    rates = np.zeros(world[1].shape[1])
    for _ in range(sessions):
        kinds[0] = starts[np.random.randint(len(starts))]
        hypothesis = drawn(rates, world)
        for t in range(length):
            seen = min(t, memory)
            counted(states, atoms[t - seen : t], outcomes[t - seen : t], ahead)
            chosen = greedy(values[seen + 1], kinds[t], states[seen], moves, chance, ahead)
            if np.random.random() < epsilon:
                chosen = np.random.randint(after.shape[1])
            done[chosen] += 1
            atoms[t], kinds[t + 1] = atom[kinds[t], chosen], after[kinds[t], chosen]
            if atoms[t] >= 0:
                outcomes[t] = int(np.random.random() < rates[component[atoms[t], hypothesis]])
        for begin in range(length - steps, -1, -1):
            counted(states, atoms[begin : begin + steps], outcomes[begin : begin + steps], ahead)
            kind = kinds[begin : begin + steps + 1]
            for t in range(steps, -1, -1):
                at, found = states[t], weights[t] * reward[states[t]]
                if t < steps:
                    found += best(values[t + 1], kind[t], at, moves, chance, ahead)
                values[t, kind[t], at] = values[t, kind[t], twin[at]] = found
    return done
