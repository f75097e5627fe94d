"""What is to be expected of a controller: how probable all counts are after every step, exactly, without episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from apmodels import ValueOutOfRange
from controllers.belief_mdp import BeliefMDP
from controllers.dynamic_programming import DynamicProgramming
from controllers.receding_horizon import RecedingHorizon
from controllers.temporal_difference import Table

Array = np.ndarray
# Actions are drawn, all alike.
ANY = -1


@dataclass(frozen=True)
class Machine:
    """How a controller goes on: a kind of known state, and what it remembers.

    ``after`` (M, A, 2), where actions and outcomes lead; ``atom`` (M, A), of what they show an outcome, or -1;
    ``first``, where it begins; ``chosen``, a function of the steps that passed and of counts that were met, (n,),
    which returns actions, (M, n), or (M, 1) where counts do not matter.
    """

    after: Array
    atom: Array
    first: int
    chosen: Callable[[int, Array], Array]


def prospects(machine: Machine, table: Table, steps: int) -> Iterator[Array]:
    """Yield how probable all states of a table are, (N,), after each of some steps.

    Outcomes are as probable as the table's beliefs say: the controller may have been made for others. The table is
    one for as many steps, or more, from ``machine.first``'s known state.
    """
    from controllers.flows import flow

    edges, into = _edges(machine)
    begin = (np.arange(len(machine.after) + 1) > machine.first).astype(np.int64)
    here = begin, np.zeros(1, dtype=np.int32), np.ones(1)
    size, actions = len(table.reward), machine.after.shape[1]
    met = here[1]
    for time in range(steps):
        chosen = np.asarray(machine.chosen(time, met), dtype=np.int8)
        if chosen.shape[1] > 1:
            whole = np.zeros((len(chosen), size), dtype=np.int8)
            whole[:, met] = chosen
            chosen = whole
        here = flow(here, edges, into, chosen, actions, table.chance, table.ahead)
        found = np.bincount(here[1], here[2], size)
        met = np.flatnonzero(found)
        yield found


def steady(mdp: BeliefMDP, action: int = ANY) -> Machine:
    """Return how it goes on where one action is done for ever, or any at random."""
    after = np.stack([mdp.after, mdp.after], -1)
    return Machine(after, mdp.atom, mdp.first, lambda time, met: np.full((len(after), 1), action))


def planned(maker: DynamicProgramming, table: Table) -> Machine:
    """Return how it goes on where a plan is followed, which knows all counts of a table."""
    mdp = maker.mdp
    after = np.stack([mdp.after, mdp.after], -1)

    def chosen(time: int, met: Array) -> Array:
        left, counts = maker.horizon - (0 if maker.steps else time), table.counts[met]
        kinds = range(len(after))
        return np.stack([maker.plan.choose(np.full(len(met), kind), counts, left) for kind in kinds])

    return Machine(after, mdp.atom, mdp.first, chosen)


def remembered(controller: RecedingHorizon) -> Machine:
    """Return how a short memory goes on: its states are all that it can remember, and a known state.

    What a step showed is a digit: nothing yet, nothing, or one of an atom's outcomes.
    """
    mdp, memory = controller.maker.mdp, controller.memory
    base, kinds = 2 * mdp.process.atoms + 2, len(mdp.after)
    if base**memory * kinds > 2**62:
        raise ValueOutOfRange(f"{memory} steps are too many to remember")

    def ahead(states: Array) -> tuple[Array, Array]:
        code, kind = states // kinds, states % kinds
        atom, after = (moves[kind, _decided(controller, code, kind, base)] for moves in (mdp.atom, mdp.after))
        digits = np.where(atom < 0, 1, 2 + 2 * atom)[:, None] + np.where(atom < 0, 0, 1)[:, None] * np.arange(2)
        return (code[:, None] * base + digits) % base**memory * kinds + after[:, None], atom

    found = fresh = np.array([mdp.first])
    while len(fresh):
        fresh = np.setdiff1d(ahead(fresh)[0], found)
        found = np.union1d(found, fresh)
    after, atom = ahead(found)
    first = int(np.searchsorted(found, mdp.first))
    nothing = np.zeros((len(found), 1))
    return Machine(np.searchsorted(found, after)[:, None], atom[:, None], first, lambda time, met: nothing)


def _decided(controller: RecedingHorizon, code: Array, kind: Array, base: int) -> Array:
    """The actions (n,) for what is remembered."""
    digits = code[:, None] // base ** np.arange(controller.memory) % base
    every = np.arange(2, base)[:, None]
    counts = (digits[:, None] == every).sum(-1).reshape(len(code), -1, 2)
    seen, actions = (digits > 0).sum(1), np.zeros(len(code), dtype=np.int64)
    for n in np.unique(seen):
        here = seen == n
        actions[here] = controller.maker.plan.choose(kind[here], counts[here], controller.left(int(n)))
    return actions


def _edges(machine: Machine) -> tuple[tuple[Array, ...], Array]:
    """Sources, actions, atoms and outcomes of all moves, sorted by where they lead, and where each state's begin."""
    states, actions, _ = machine.after.shape
    source, action, outcome = (part.ravel() for part in np.indices((states, actions, 2)))
    atom, to = machine.atom[source, action], machine.after.ravel()
    real = np.flatnonzero((atom >= 0) | (outcome == 0))
    order = real[np.argsort(to[real], kind="stable")]
    into = np.searchsorted(to[order], np.arange(states + 1))
    return tuple(part[order] for part in (source, action, atom, outcome)), into
