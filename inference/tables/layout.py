"""How the joint values of a finite model's hidden variables are laid out as axes, and what is context."""

from __future__ import annotations

import torch
from torch import Tensor

from apmodels.laws import Laws
from apmodels.structure import Structure
from inference.tables.slices import Axis, Key, supports


class Layout:
    """Axes of a model whose hidden variables are finite.

    A belief is an array over ``statics`` and ``states``; a step is an array over ``statics``, ``previous`` (the
    states that somebody remembers, a step ago) and ``present`` (the states now). ``keys`` are the contexts: what is
    known and bears on what is hidden or seen. ``spent`` are statics that only say how a state begins, which nobody
    asks about: they are summed out before the first step.
    """

    def __init__(self, laws: Laws, structure: Structure):
        self.laws = laws
        values = supports(laws, structure)
        own = {node.name: len(node.values) for node in structure.hidden if node.values is not None}
        remembered = laws.model.declaration.remembered
        hidden = [node for node in structure.nodes.values() if node.name in values]
        statics = [Axis(n.name, 0, values[n.name]) for n in hidden if n.role == "static"]
        bears = {parent.name for variable in laws.variables.values() for parent in variable.parents}
        self.statics = [axis for axis in statics if axis.name in bears or axis.name in structure.interest]
        kept = {axis.name for axis in self.statics}
        self.spent = [axis for axis in statics if axis.name not in kept]
        self.states = [Axis(n.name, 0, values[n.name]) for n in hidden if n.role == "state"]
        self.previous = [Axis(axis.name, 1, axis.values) for axis in self.states if axis.name in remembered]
        # A state never comes back to a value that only its time before the first step had.
        self.present = [Axis(a.name, 0, a.values[: own.get(a.name, a.size)]) for a in self.states]
        self.axes = self.statics + self.states
        self.step_axes = self.statics + self.previous + self.present
        self.sizes = tuple(axis.size for axis in self.axes)
        self.present_sizes = tuple(axis.size for axis in self.statics + self.present)
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

    def padded(self, log_probs: Tensor) -> Tensor:
        """Return log probabilities (B, *present_sizes) as a belief's, (B, *sizes)."""
        if self.sizes == self.present_sizes:
            return log_probs
        # From the last dimension to the first, as padding is written.
        pairs = zip(reversed(self.sizes), reversed(self.present_sizes), strict=True)
        missing = [n for size, now in pairs for n in (0, size - now)]
        return torch.nn.functional.pad(log_probs, missing, value=-torch.inf)

    def without_past(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Drop the dimensions of ``previous`` from a step's shape."""
        return shape[: len(self.statics)] + shape[len(self.statics) + len(self.previous) :]

    def past(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the dimensions of ``previous`` of a step's shape."""
        return shape[len(self.statics) : len(self.statics) + len(self.previous)]
