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
def learn(values, reward, weights, moves, chance, ahead, starts, world, epsilon, trials, seed):
    """Learn values (T + 1, kinds, states) in place from so many trials; return how often each action was done.

    A trial draws a world, acts in it, greedily but for a share ``epsilon`` of random actions, and then backs the values
    of what it met up, the last first, by the best action and not the one taken. ``world`` are the hypotheses'
    probabilities, the pseudo-counts of their components, and which component an atom is drawn from.
    """
    np.random.seed(seed)
    prior, pseudo, component = world
    after, atom = moves
    steps, actions = len(values) - 1, after.shape[1]
    done = np.zeros(actions, dtype=np.int64)
    kinds, states = np.zeros(steps + 1, dtype=np.int64), np.zeros(steps + 1, dtype=np.int64)
    rates = np.zeros(pseudo.shape[1])
    for _ in range(trials):
        kinds[0], states[0] = starts[np.random.randint(len(starts))], 0
        hypothesis = np.searchsorted(np.cumsum(prior), np.random.random())
        hypothesis = min(hypothesis, len(prior) - 1)
        for c in range(len(rates)):
            rates[c] = np.random.beta(pseudo[hypothesis, c, 1], pseudo[hypothesis, c, 0])
        for t in range(steps):
            best, chosen, equal = -np.inf, 0, 0
            for u in range(actions):
                here = worth(values[t + 1], kinds[t], states[t], u, moves, chance, ahead)
                if here > best:
                    best, chosen, equal = here, u, 1
                elif here == best:
                    equal += 1
                    if np.random.randint(equal) == 0:
                        chosen = u
            if np.random.random() < epsilon:
                chosen = np.random.randint(actions)
            done[chosen] += 1
            k = atom[kinds[t], chosen]
            kinds[t + 1], states[t + 1] = after[kinds[t], chosen], states[t]
            if k >= 0:
                outcome = int(np.random.random() < rates[component[k, hypothesis]])
                states[t + 1] = ahead[k, outcome, states[t]]
        values[steps, kinds[steps], states[steps]] = weights[steps] * reward[states[steps]]
        for t in range(steps - 1, -1, -1):
            best = -np.inf
            for u in range(actions):
                best = max(best, worth(values[t + 1], kinds[t], states[t], u, moves, chance, ahead))
            values[t, kinds[t], states[t]] = weights[t] * reward[states[t]] + best
    return done
