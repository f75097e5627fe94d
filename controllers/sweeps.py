"""Backward induction over a lattice of counts, compiled (numba).

A sweep replaces every state's value by that of one step more. A state's successors have the same counts or one outcome
more, so that layers are swept from few outcomes to many, in place, and the rows of a layer side by side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

# An action takes an earlier one's place where it is better by more than this: exact ties go to the first.
TIE = 1e-12


@njit(cache=True)
def _decoded(totals, line, mirrored, ones):
    """How many ones a row has of every atom but the last."""
    for k in range(len(totals) - 2, -1, -1):
        width = (totals[k] // 2 if mirrored and k == 0 else totals[k]) + 1
        ones[k] = line % width
        line //= width


@njit(cache=True)
def _start(totals, ones, offset, atom, added, mirrored):
    """Where a row begins after one outcome more of an atom, and which way it runs (1, or -1 in the mirror)."""
    last = len(totals) - 1
    step, line = 1, 0
    turned = mirrored and atom == 0 and added == 1 and ones[0] + 1 > (totals[0] + 1) // 2
    for k in range(last):
        total = totals[k] + (1 if k == atom else 0)
        here = ones[k] + (added if k == atom else 0)
        if turned:
            here = total - here
        line = line * ((total // 2 if mirrored and k == 0 else total) + 1) + here
    width = totals[last] + (2 if atom == last else 1)
    start = offset + line * width
    if atom == last:
        return start + added, step
    if turned:
        return start + totals[last], -1
    return start, step


@njit(cache=True)
def _expected(k, totals, ones, h, component, prior):
    """The mean chance of a one of an atom under a hypothesis, as a + b * (ones of the last atom)."""
    c, last = component[k, h], len(totals) - 1
    one, seen = prior[h, c, 1], prior[h, c, 0] + prior[h, c, 1]
    for other in range(last + 1):
        if component[other, h] == c:
            seen += totals[other]
            if other < last:
                one += ones[other]
    return one / seen, (1.0 / seen if component[last, h] == c else 0.0)


@njit(cache=True)
def _chances(chance, shares, base, totals, ones, component, prior):
    """Fill the chance of a one of every atom, along a row."""
    for k in range(len(totals)):
        row = chance[k]
        a, b = _expected(k, totals, ones, 0, component, prior)
        for i in range(len(row)):
            row[i] = a + b * i
        for h in range(1, component.shape[1]):
            c, d = _expected(k, totals, ones, h, component, prior)
            c, d, share = c - a, d - b, shares[h - 1, base : base + len(row)]
            for i in range(len(row)):
                row[i] += share[i] * (c + d * i)


@njit(parallel=True, cache=True)
def _layer(values, reward, shares, weight, rows, bound, lattice, counted, moves, choices, decided):
    totals, offset, earliest, after, mirrored = lattice
    component, prior = counted
    to, atom = moves
    atoms = totals.shape[1]
    for r in prange(len(rows)):
        block = rows[r, 0]
        if earliest[block] > bound:
            continue
        ones = np.zeros(atoms, dtype=np.int64)
        _decoded(totals[block], rows[r, 1], mirrored, ones)
        size = totals[block, atoms - 1] + 1
        base, _ = _start(totals[block], ones, offset[block], -1, 0, mirrored)
        chance, ahead = np.empty((atoms, size)), np.empty((len(to), size))
        _chances(chance, shares, base, totals[block], ones, component, prior)
        for j in range(len(to)):
            there, k = values[to[j]], atom[j]
            if k < 0:
                ahead[j] = there[base : base + size]
                continue
            if after[block, k] < 0:
                # Known states that cannot be met with these counts; nobody asks for their values.
                ahead[j] = 0.0
                continue
            target = offset[after[block, k]]
            zero, _ = _start(totals[block], ones, target, k, 0, mirrored)
            one, step = _start(totals[block], ones, target, k, 1, mirrored)
            p, row, a = chance[k], ahead[j], there[zero : zero + size]
            if step == 1:
                b = there[one : one + size]
                for i in range(size):
                    row[i] = a[i] + p[i] * (b[i] - a[i])
            else:
                for i in range(size):
                    row[i] = a[i] + p[i] * (there[one - i] - a[i])
        gain = reward[base : base + size]
        for c in range(choices.shape[0]):
            best, mine = ahead[choices[c, 0]].copy(), values[c, base : base + size]
            for u in range(1, choices.shape[1]):
                other = ahead[choices[c, u]]
                if decided.shape[1] > 0:
                    for i in range(size):
                        if other[i] > best[i] + TIE:
                            best[i] = other[i]
                            decided[c, base + i] = u
                else:
                    for i in range(size):
                        best[i] = max(best[i], other[i])
            for i in range(size):
                mine[i] = weight * gain[i] + best[i]


@njit(cache=True)
def sweep(values, reward, shares, weight, rows, layers, bound, lattice, counted, moves, choices, decided):
    """Replace values (C, N) by those of a step more, of blocks that can be reached in ``bound`` steps.

    ``reward`` (N,) counts ``weight`` times; ``shares`` (H - 1, N) are all hypotheses' but the first one's; ``moves``
    are (state, atom) that an action may lead to, ``choices`` (C, U) which move an action is; ``decided`` (C, N) takes
    the best actions, or is (C, 0).
    """
    for layer in range(min(bound, len(layers) - 2) + 1):
        part = rows[layers[layer] : layers[layer + 1]]
        _layer(values, reward, shares, weight, part, bound, lattice, counted, moves, choices, decided)


@njit(parallel=True, cache=True)
def informed(reward, shares, rows, lattice, log_prior, groups, component, normal, whole):
    """Fill rewards (N,), minus the entropy of the interest in nats, and shares of all hypotheses but the first.

    ``normal`` (H, C, 2, T) are the log gamma of pseudo-counts after so many outcomes, ``whole`` (H, C, T) of their
    sums, over those of the prior; ``groups`` (H,) say which value of the interest a hypothesis has.
    """
    totals, offset, _, _, mirrored = lattice
    atoms, hypotheses = component.shape
    kinds = normal.shape[1]
    for r in prange(len(rows)):
        block = rows[r, 0]
        n = totals[block]
        ones = np.zeros(atoms, dtype=np.int64)
        _decoded(n, rows[r, 1], mirrored, ones)
        base, _ = _start(n, ones, offset[block], -1, 0, mirrored)
        logs, share = np.empty(hypotheses), np.empty(hypotheses)
        yes = np.empty((hypotheses, kinds), dtype=np.int64)
        seen = np.empty((hypotheses, kinds), dtype=np.int64)
        for i in range(n[atoms - 1] + 1):
            ones[atoms - 1] = i
            yes[:] = 0
            seen[:] = 0
            top = -np.inf
            for h in range(hypotheses):
                for k in range(atoms):
                    yes[h, component[k, h]] += ones[k]
                    seen[h, component[k, h]] += n[k]
                logs[h] = log_prior[h]
                for c in range(kinds):
                    no = seen[h, c] - yes[h, c]
                    logs[h] += normal[h, c, 0, no] + normal[h, c, 1, yes[h, c]] - whole[h, c, seen[h, c]]
                top = max(top, logs[h])
            total = 0.0
            for h in range(hypotheses):
                logs[h] = math.exp(logs[h] - top)
                total += logs[h]
            share[:] = 0.0
            for h in range(hypotheses):
                logs[h] /= total
                share[groups[h]] += logs[h]
            found = 0.0
            for h in range(hypotheses):
                if share[h] > 0:
                    found += share[h] * math.log(share[h])
            reward[base + i] = found
            for h in range(1, hypotheses):
                shares[h - 1, base + i] = logs[h]
