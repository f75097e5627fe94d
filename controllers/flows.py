"""How probability flows through known states, memories and counts, compiled (numba)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def flow(here, edges, into, chosen, actions, chance, ahead):
    """Return where probability is after a step, as ``here`` says where it was.

    That is ``begin`` (M + 1,), where a machine's states begin among ``at`` and ``mass``, counts and their probability.
    ``edges`` (4, E) are the states they leave, actions, atoms and outcomes, sorted by where they lead; those into a
    state begin at ``into`` (M + 1,). ``chosen`` (M, N), or (M, 1) for all counts, are actions, or -1 for any.
    """
    begin, at, mass = here
    source, action, atom, outcome = edges
    most = 0
    for e in range(len(source)):
        most += begin[source[e] + 1] - begin[source[e]]
    then, there, share = np.zeros(len(begin), dtype=np.int64), np.empty(most, dtype=np.int32), np.empty(most)
    gathered, n = np.zeros(chance.shape[1]), 0
    for m in range(len(begin) - 1):
        first = n
        for e in range(into[m], into[m + 1]):
            k, row = atom[e], chosen[source[e]]
            for j in range(begin[source[e]], begin[source[e] + 1]):
                state, p = at[j], mass[j]
                does = row[state if len(row) > 1 else 0]
                if does >= 0 and does != action[e]:
                    continue
                if does < 0:
                    p /= actions
                if k >= 0:
                    p *= chance[k, state] if outcome[e] else 1 - chance[k, state]
                    state = ahead[k, outcome[e], state]
                if p > 0.0:
                    if gathered[state] == 0.0:
                        there[n] = state
                        n += 1
                    gathered[state] += p
        for j in range(first, n):
            share[j] = gathered[there[j]]
            gathered[there[j]] = 0.0
        then[m + 1] = n
    return then, there[:n].copy(), share[:n].copy()
