"""What an agent need not infer, because it follows from what was done and sensed; but must remember."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.laws import Laws
from apmodels.simulation import Values
from apmodels.structure import Structure
from apmodels.variables import Variable

Context = dict[tuple[str, int], Tensor]


class Known:
    """The known variables of a model: ``computed`` every step, and ``kept`` for a later one that asks for them."""

    def __init__(self, laws: Laws, structure: Structure):
        self.laws, self.structure = laws, structure
        self.computed = [node.name for node in structure.planned("known")]
        known = {node.name for node in structure.planned("known", "given", "observed")}
        self.kept = [name for name in laws.model.declaration.remembered if name in known]

    def first(self, rows: int) -> Values:
        """Return the kept values before time began, (rows, *shape)."""
        firsts = {name: self._first(name) for name in self.kept}
        return {name: value.expand(rows, *value.shape) for name, value in firsts.items()}

    def _first(self, name: str) -> Tensor:
        before = self.laws.before(name)
        return self._static(before.name) if isinstance(before, Variable) else before

    def _static(self, name: str) -> Tensor:
        parents = {p.argument: self._static(p.name) for p in self.laws.variables[name].parents}
        value: Any = self.laws.one(name, parents)
        return value

    def move(self, kept: Values, actions: Values, count: int) -> tuple[Values, Context]:
        """Move the known variables on; return them, and everything known by (name, lag), (count, *shape)."""
        context: Context = {(name, 1): value for name, value in kept.items()}
        for (name, _), value in context.items():
            if value.is_floating_point() and bool(torch.isnan(value).any()):
                raise ValueOutOfRange(f"{name} was missing a step ago, but a law asks for prev_{name}")
        context |= {(name, 0): value for name, value in actions.items()}
        known = {}
        for name in self.computed:
            parents = {p.argument: context[p.name, p.lag] for p in self.laws.variables[name].parents}
            law = self.laws.many(name, parents, (count,))
            assert isinstance(law, Tensor)
            known[name] = context[name, 0] = law
        return known, context

    def keep(self, known: Values, seen: Values) -> Values:
        """Return what later steps ask for, of known values and of observations (B, elements)."""
        now = {}
        for name in set(seen) & set(self.kept):
            node, y = self.structure.nodes[name], seen[name]
            y = y.reshape(len(y), *node.shape)
            # Observations are held as floats; a law that indexes with one wants it back as it was.
            whole = node.family == "Categorical" and not bool(torch.isnan(y).any())
            now[name] = y.to(torch.int64) if whole else y
        return {name: (known | now)[name] for name in self.kept}
