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
from inference.records.record import alike, folded

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

    def along(self, actions: Values, seen: Values, steps: int, rows: int) -> tuple[Context, list[Values]]:
        """Move the known variables along a record, (steps, rows or 1, *shape) by name.

        Returns:
            Everything known by (name, lag), (steps, rows or 1, *shape), and what is kept after each step.
        """
        if not self.kept:
            wide = max((value.shape[1] for value in actions.values()), default=1)
            _, context = self.move({}, {n: folded(value, wide) for n, value in actions.items()}, steps * wide)
            return {key: value.unflatten(0, (steps, wide)) for key, value in context.items()}, [{}] * steps
        kept, contexts, after = self.first(rows), [], []
        for t in range(steps):
            act, see = ({n: v[t].expand(rows, *v.shape[2:]) for n, v in some.items()} for some in (actions, seen))
            known, context = self.move(kept, act, rows)
            kept = self.keep(known | act, {name: value.reshape(rows, -1) for name, value in see.items()})
            contexts.append(context)
            after.append(kept)
        return {key: alike(torch.stack([some[key] for some in contexts])) for key in contexts[0]}, after

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
