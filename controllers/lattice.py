"""All counts of binary outcomes that some steps can lead to, laid out so that neighbours are found by arithmetic.

Counts are (zeros, ones) of each atom. How often an atom was seen, its total, says which block a state is in; how many
of those were ones says where in the block. Where zeros and ones mean the same, a state and its mirror image are one: of
the first atom only those with no more ones than zeros are kept.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Lattice:
    """Blocks by how often each atom was seen, those with fewer outcomes first.

    ``totals`` (B, K); ``offset`` (B,), where a block begins; ``size``, how many states there are in all; ``earliest``
    (B,), the first step in which a block can be reached; ``after`` (B, K), the block with one outcome more, or -1;
    ``number`` (T + 1, ...), the block by its totals; ``rows`` (R, 2), every block's rows of its last atom, as (block,
    number), in layers that begin at ``layers``.
    """

    totals: Array
    offset: Array
    size: int
    earliest: Array
    after: Array
    number: Array
    rows: Array
    layers: Array
    mirrored: bool

    @property
    def packed(self) -> tuple:
        """What a compiled sweep is told."""
        return self.totals, self.offset, self.earliest, self.after, self.mirrored

    def has(self, counts: Array) -> Array:
        """Tell which counts (n, K, 2) are among the states."""
        totals = counts.sum(-1)
        inside = (totals < len(self.number)).all(1)
        return inside & (self.number[tuple(np.where(inside[:, None], totals, 0).T)] >= 0)

    def index(self, counts: Array) -> Array:
        """Return where states are; ``counts`` are (n, K, 2)."""
        totals, ones = counts.sum(-1), counts[..., 1]
        if len(totals) and (totals.max() >= len(self.number) or self.number[tuple(totals.T)].min() < 0):
            raise IndexError("more outcomes than the plan was made for")
        block = self.number[tuple(totals.T)]
        if self.mirrored:
            beyond = ones[:, 0] > totals[:, 0] // 2
            ones = np.where(beyond[:, None], totals - ones, ones)
        at = np.zeros(len(counts), dtype=np.int64)
        for k in range(totals.shape[1]):
            at = at * self.width(totals[:, k], k) + ones[:, k]
        return self.offset[block] + at

    def width(self, totals: Any, atom: int) -> Any:
        """How many states of an atom a block has."""
        return (totals // 2 if self.mirrored and not atom else totals) + 1

    def counts(self, block: int) -> Array:
        """Return the counts of a block's states, (states, K, 2)."""
        totals = self.totals[block]
        axes = [np.arange(self.width(n, k)) for k, n in enumerate(totals)]
        ones = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(totals))
        return np.stack([totals - ones, ones], -1)


def reached(after: Array, atom: Array, first: Any, atoms: int, steps: int) -> Array:
    """Return the first step in which totals (steps + 1, ...) can be reached, a large number where they cannot be."""
    never = np.iinfo(np.int32).max
    earliest = np.full((len(after), *(steps + 1,) * atoms), never, dtype=np.int32)
    edge = _begun(earliest.shape, first)
    earliest[edge] = 0
    for t in range(1, steps + 1):
        edge = _ahead(edge, after, atom) & (earliest == never)
        earliest[edge] = t
        if not edge.any():
            break
    return earliest.min(0)


def visited(after: Array, atom: Array, first: Any, atoms: int, steps: int) -> Array:
    """Tell which states and totals (states, steps + 1, ...) can be met after exactly so many steps."""
    edge = _begun((len(after), *(steps + 1,) * atoms), first)
    for _ in range(steps):
        edge = _ahead(edge, after, atom)
    return edge


def _begun(shape: tuple[int, ...], first: Any) -> Array:
    edge = np.zeros(shape, dtype=bool)
    edge[(first, *[0] * (len(shape) - 1))] = True
    return edge


def _ahead(edge: Array, after: Array, atom: Array) -> Array:
    """Where all actions and outcomes lead."""
    ahead, atoms = np.zeros_like(edge), edge.ndim - 1
    for state in range(len(after)):
        for to, k in zip(after[state], atom[state], strict=True):
            here, there = [slice(None)] * atoms, [slice(None)] * atoms
            if k >= 0:
                here[k], there[k] = slice(None, -1), slice(1, None)
            ahead[to][tuple(there)] |= edge[state][tuple(here)]
    return ahead


def lattice(after: Array, atom: Array, first: Any, atoms: int, steps: int, mirrored: bool) -> Lattice:
    """Lay out all counts that can be reached in some steps; ``after`` and ``atom`` are (states, actions)."""
    mirrored = mirrored and atoms > 1
    dense = reached(after, atom, first, atoms, steps)
    totals = np.argwhere(dense <= steps)
    totals = totals[np.argsort(totals.sum(1), kind="stable")]
    number = np.full(dense.shape, -1, dtype=np.int64)
    number[tuple(totals.T)] = np.arange(len(totals))
    padded = np.pad(number, [(0, 1)] * atoms, constant_values=-1)
    ahead = np.stack([padded[tuple((totals + np.eye(atoms, dtype=int)[k]).T)] for k in range(atoms)], 1)
    widths = totals + 1
    if mirrored:
        widths[:, 0] = totals[:, 0] // 2 + 1
    sizes = widths.prod(1)
    offset = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    lines = widths[:, :-1].prod(1)
    rows = np.stack([np.repeat(np.arange(len(totals)), lines), _within(lines)], 1)
    layer = totals.sum(1)[rows[:, 0]]
    layers = np.searchsorted(layer, np.arange(int(layer.max()) + 2))
    for start, stop in itertools.pairwise(layers):
        # Every second row first: two threads then have as much to do.
        rows[start:stop] = np.concatenate([rows[start:stop:2], rows[start + 1 : stop : 2]])
    return Lattice(totals, offset, int(sizes.sum()), dense[tuple(totals.T)], ahead, number, rows, layers, mirrored)


def _within(lines: Array) -> Array:
    starts = np.cumsum(lines) - lines
    return np.arange(int(lines.sum())) - np.repeat(starts, lines)
