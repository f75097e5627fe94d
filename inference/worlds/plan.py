"""Which hidden variables get values, world by world, and which are summed or integrated given those.

A world is one assignment of values to the variables that cannot be integrated: a hypothesis, or a particle. Given a
world, what remains falls into groups that know nothing of each other, each with an algebra of its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from apmodels.structure import Arrow, Node, Structure


@dataclass(frozen=True)
class Plan:
    """How the hidden variables of a structure are treated; names in the order in which they happen.

    ``worlds`` are random and have a value in every world; ``computed`` follow from those and from what is known;
    ``finite`` are summed, each group of ``gaussian`` is one joint Gaussian, each of ``fields`` a chain of images of
    independent pixels, each of ``counted`` a set of Beta, Dirichlet or Gamma variables that share outcomes.
    """

    worlds: tuple[str, ...]
    computed: tuple[str, ...]
    finite: tuple[str, ...]
    gaussian: tuple[tuple[str, ...], ...]
    fields: tuple[tuple[str, ...], ...]
    counted: tuple[tuple[str, ...], ...]

    @property
    def integrated(self) -> set[str]:
        """The variables of all Gaussian, field and counted groups."""
        return {name for group in (*self.gaussian, *self.fields, *self.counted) for name in group}


def make_plan(structure: Structure, sampled: Iterable[str] = (), scored: bool = False) -> Plan:
    """Divide the hidden variables, where those ``sampled`` get values whatever could be done with them.

    Where worlds are only ``scored``, and never drawn, finite variables may bear on them and still be summed.
    """
    return _Planner(structure, set(sampled), scored).plan()


class _Planner:
    def __init__(self, structure: Structure, forced: set[str], scored: bool):
        self.structure = structure
        self.scored = forced if scored else set()
        self.nodes = structure.nodes
        self.hidden = {node.name for node in structure.hidden}
        forced |= {node.name for node in structure.planned("sampled") if node.random}
        while True:
            self.algebra = {node.name for node in structure.planned("integrated", "counted")} - forced
            self.algebra -= self._computed(forced)
            self.finite = self._summable(forced)
            self.worlds = {n.name for n in structure.hidden if n.random and n.name not in self.algebra | self.finite}
            self.computed = self._computed(self.worlds)
            missing = self._firsts() - self.worlds
            if not missing:
                break
            forced |= missing
        self.finite -= self.computed
        self.algebra -= self.computed

    def plan(self) -> Plan:
        counted = {name for name in self.algebra if self.nodes[name].plan == "counted"}
        groups = self._groups(self.algebra - counted)
        fields = tuple(group for group in groups if self._is_field(group))
        return Plan(
            self._ordered(self.worlds),
            self._ordered(self.computed),
            self._ordered(self.finite),
            tuple(group for group in groups if group not in fields),
            fields,
            self._groups(counted),
        )

    def _firsts(self) -> set[str]:
        """The random variables that give a world's own variable its value before time began."""
        valued = self.worlds | self.computed
        found = {a.parent for a in self.structure.arrows if a.first and a.child in valued and a.parent in self.hidden}
        waiting = list(found)
        while waiting:
            name = waiting.pop()
            if not self.nodes[name].random:
                more = {a.parent for a in self.structure.into(name) if a.parent in self.hidden} - found
                found |= more
                waiting += more
        return {name for name in found if self.nodes[name].random}

    def _ordered(self, names: set[str]) -> tuple[str, ...]:
        return tuple(name for name in self.nodes if name in names)

    def _summable(self, forced: set[str]) -> set[str]:
        """The finite variables that touch, below them, nothing but each other and observations of the like."""
        members = {node.name for node in self.structure.planned("enumerated")} - forced
        while True:
            kept = {name for name in members if self._stays(name, members)}
            if kept == members:
                return members
            members = kept

    def _stays(self, name: str, members: set[str]) -> bool:
        for arrow in self.structure.out_of(name):
            child = self.nodes[arrow.child]
            mixed = any(other.parent in self.algebra for other in self.structure.into(child.name))
            valued = child.role == "observation" or child.name in self.scored
            if (valued and mixed) or (not valued and child.name not in members):
                return False
        return not any(arrow.parent in self.algebra for arrow in self.structure.into(name))

    def _computed(self, valued: set[str]) -> set[str]:
        """The deterministic variables that follow from those that have values, and from what is known."""
        members = {node.name for node in self.structure.hidden if not node.random}
        while True:
            sources = {name: {a.parent for a in self.structure.into(name)} & self.hidden for name in members}
            kept = {name for name in members if sources[name] <= valued | members}
            if kept == members:
                return members
            members = kept

    def _groups(self, names: set[str]) -> tuple[tuple[str, ...], ...]:
        """Names that depend on each other, or are seen together, in one group."""
        group = {name: {name} for name in names}
        for child in self.nodes:
            family = {arrow.parent for arrow in self.structure.into(child)} & names
            family |= {child} & names
            merged = set().union(*(group[name] for name in family)) if family else set()
            for name in merged:
                group[name] = merged
        return tuple(dict.fromkeys(self._ordered(group[name]) for name in self._ordered(names)))

    def _is_field(self, group: tuple[str, ...]) -> bool:
        """Whether a group is one image that is only ever moved, seen by moved observations.

        Two images would depend on each other, pixel by pixel, once something was seen of either. What one was before
        time began may be another, if nobody asks for that one any more.
        """
        arrows = [arrow for name in group for arrow in self.structure.out_of(name)]
        lasting = [name for name in group if not self._is_first(name)]
        return (
            len(lasting) == 1
            and any(arrow.kind == "moves" for arrow in arrows)
            and all(self._moves(arrow, group) for arrow in arrows)
            and all(self.nodes[name].family in ("Normal", "deterministic") for name in group)
        )

    def _is_first(self, name: str) -> bool:
        """Whether a variable is nothing but what another one was before time began."""
        out = self.structure.out_of(name)
        return bool(out) and all(arrow.first for arrow in out) and name not in self.structure.interest

    def _moves(self, arrow: Arrow, group: tuple[str, ...]) -> bool:
        child: Node = self.nodes[arrow.child]
        if child.role == "observation":
            parents = [a for a in self.structure.into(child.name) if a.parent in group]
            return arrow.kind == "moves" and not arrow.lag and child.family == "Normal" and len(parents) == 1
        return arrow.kind == "moves" and child.name in group
