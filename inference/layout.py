"""How the joint values of a finite model's hidden variables are laid out as axes, and what is context."""

from __future__ import annotations

from apmodels.laws import Laws
from apmodels.structure import Structure
from inference.slices import Axis, Key, supports


class Layout:
    """Axes of a model whose hidden variables are finite.

    A belief is an array over ``statics`` and ``states``; a step is an array over ``statics``, ``previous`` (the
    states that somebody remembers, a step ago) and ``states``. ``keys`` are the contexts: what is known and bears
    on what is hidden or seen. ``kept`` are the known variables that a later step asks for.
    """

    def __init__(self, laws: Laws, structure: Structure):
        self.laws = laws
        values = supports(laws, structure)
        remembered = laws.model.declaration.remembered
        hidden = [node for node in structure.nodes.values() if node.name in values]
        self.statics = [Axis(n.name, 0, values[n.name]) for n in hidden if n.role == "static"]
        self.states = [Axis(n.name, 0, values[n.name]) for n in hidden if n.role == "state"]
        self.previous = [Axis(axis.name, 1, axis.values) for axis in self.states if axis.name in remembered]
        self.kept = [name for name in remembered if name not in values]
        self.axes = self.statics + self.states
        self.step_axes = self.statics + self.previous + self.states
        self.sizes = tuple(axis.size for axis in self.axes)
        self.keys = self._keys(structure)

    def _keys(self, structure: Structure) -> list[Key]:
        known = {node.name for node in structure.planned("given", "known", "observed")}
        keys: dict[Key, None] = {}
        for variable in self.laws.model.declaration.variables.values():
            if variable.role == "action" or structure.nodes[variable.name].plan == "known":
                continue
            for parent in variable.parents:
                if parent.name in known:
                    keys[parent.name, parent.lag] = None
        return list(keys)

    def varies(self, name: str) -> bool:
        """Tell whether a law differs between contexts, by itself or by way of deterministic variables."""
        own = {axis.name for axis in self.axes}
        for parent in self.laws.variables[name].parents:
            if (parent.name, parent.lag) in self.keys:
                return True
            if parent.lag == 0 and parent.name not in own and self.varies(parent.name):
                return True
        return False

    def without_past(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Drop the dimensions of ``previous`` from a step's shape."""
        return shape[: len(self.statics)] + shape[len(self.statics) + len(self.previous) :]

    def past(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the dimensions of ``previous`` of a step's shape."""
        return shape[len(self.statics) : len(self.statics) + len(self.previous)]
