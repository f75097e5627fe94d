"""One time slice of a model, evaluated on the mesh of all its hidden values at once.

Dimension 0 of everything is the context (what is known: actions, known states); every axis, a hidden variable of
this step or the step before, has a dimension of its own, of size 1 where a law does not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from pyro.distributions import Delta
from torch import Tensor
from torch.distributions import Distribution

from apmodels import ValueOutOfRange
from apmodels.distributions import picked
from apmodels.laws import Laws
from apmodels.structure import Structure
from apmodels.supports import support_of
from apmodels.variables import Variable

LARGEST_SUPPORT = 4096
Key = tuple[str, int]
Context = dict[Key, Tensor]


@dataclass(frozen=True)
class Axis:
    """A variable with finitely many values, (size, *shape), now (lag 0) or a step ago (lag 1)."""

    name: str
    lag: int
    values: Tensor

    @property
    def size(self) -> int:
        """The number of values."""
        return len(self.values)


class Slice:
    """The laws of one time slice on a mesh of axes, in some contexts (name, lag) -> (K, *shape)."""

    def __init__(self, laws: Laws, axes: list[Axis], context: Context):
        self.laws = laws
        self.axes = axes
        self.dim = {(axis.name, axis.lag): 1 + i for i, axis in enumerate(axes)}
        self.contexts = max((len(value) for value in context.values()), default=1)
        self.memo: dict[Key, Tensor] = {}
        singles = (1,) * len(axes)
        for key, value in context.items():
            self.memo[key] = value.reshape(len(value), *singles, *value.shape[1:])
        for axis in axes:
            self.memo[axis.name, axis.lag] = self.along(axis, axis.values)

    def along(self, axis: Axis, values: Tensor) -> Tensor:
        """Put values (n, *shape) along an axis's dimension."""
        at = self.dim[axis.name, axis.lag]
        return values.reshape(*(1,) * at, len(values), *(1,) * (len(self.axes) - at), *values.shape[1:])

    def value(self, name: str, lag: int = 0) -> Tensor:
        """Return the values of a variable on the mesh, (K or 1, sizes or 1, *shape)."""
        if (name, lag) not in self.memo:
            if lag or self.laws.variables[name].role in ("action", "observation"):
                raise KeyError(name)
            law = self.law(name)
            if not isinstance(law, Tensor):
                raise ValueOutOfRange(f"{name} has no axis and is random")
            self.memo[name, lag] = law
        return self.memo[name, lag]

    def law(self, name: str) -> Any:
        """Return a variable's law on the mesh: values, or a distribution with batch shape (K or 1, sizes or 1)."""
        variable: Variable = self.laws.variables[name]
        parents = {p.argument: self.value(p.name, p.lag) for p in variable.parents}
        dims = 1 + len(self.axes)
        leads = [value.shape[:dims] for value in parents.values()] or [torch.Size((1,) * dims)]
        return self.laws.many(name, parents, tuple(torch.broadcast_shapes(*leads)))

    def distribution(self, name: str) -> Any:
        """Return an observation's law; a deterministic one as the distribution that has no noise."""
        law = self.law(name)
        if not isinstance(law, Tensor):
            return law
        lead = 1 + len(self.axes)
        return Delta(law.to(self.laws.dtype), event_dim=law.dim() - lead, validate_args=False)

    def transition(self, axis: Axis) -> Tensor:
        """Return log p(value | parents) of a hidden variable, with its own values along its own dimension."""
        law = self.law(axis.name)
        if isinstance(law, Tensor):
            same = _equal(law, self.along(axis, axis.values), axis.values.dim() - 1)
            return same.to(self.laws.dtype).log()
        support = axis.values[: _own(law)]
        scores = self._scores(law, axis, support)
        missing = axis.size - len(support)
        if missing:
            dim = self.dim[axis.name, axis.lag]
            shape = list(scores.shape)
            shape[dim] = missing
            scores = torch.cat([scores, scores.new_full(shape, -torch.inf)], dim)
        return scores

    def _scores(self, law: Any, axis: Axis, support: Tensor) -> Tensor:
        """log p of an axis's own values, along its own dimension, in which what cannot be is minus infinity."""
        dim = self.dim[axis.name, axis.lag]
        kind = type(law).__name__
        if kind not in ("Categorical", "Bernoulli"):
            return law.log_prob(self.along(axis, support)).to(self.laws.dtype)
        # Their own log_prob rounds a probability of 0 up.
        probs = law.probs if kind == "Categorical" else torch.stack([1 - law.probs, law.probs], -1)
        return probs.movedim(-1, dim).squeeze(dim + 1).log()


def _own(law: Distribution) -> int:
    """How many values a batch of laws has; the same for each of them."""
    lead = len(law.batch_shape)
    values = support_of(picked(law, (0,) * lead, (), lead))
    return 0 if values is None else len(values)


def _equal(values: Tensor, others: Tensor, event: int) -> Tensor:
    same = values == others
    same = same.flatten(-event).all(-1) if event else same
    return same


def supports(laws: Laws, structure: Structure) -> dict[str, Tensor]:
    """Return the values of every hidden finite variable that needs an axis: name -> (size, *shape).

    Random ones have the values of their law, and the value before time began. Deterministic ones that are
    remembered have whatever can be reached from there.
    """
    remembered = laws.model.declaration.remembered
    found: dict[str, Tensor] = {}
    for node in structure.planned("enumerated"):
        if node.values is not None:
            found[node.name] = node.values.to(laws.dtype) if node.values.is_floating_point() else node.values
    for name in remembered:
        if name in found:
            before = laws.before(name)
            first = _first(laws, name, found) if isinstance(before, Variable) else before[None]
            found[name] = _union(found[name], first)
    searched = [n.name for n in structure.planned("enumerated", "known") if _needs_search(n, remembered)]
    if any(structure.nodes[name].plan == "enumerated" for name in searched):
        reached = _reach(laws, structure, found, searched)
        found |= {name: reached[name] for name in searched if structure.nodes[name].plan == "enumerated"}
    return found


def _needs_search(node: Any, remembered: dict) -> bool:
    return node.values is None and node.role == "state" and node.name in remembered


def _reach(laws: Laws, structure: Structure, fixed: dict[str, Tensor], searched: list[str]) -> dict[str, Tensor]:
    remembered = laws.model.declaration.remembered
    found = {name: _first(laws, name, fixed) for name in searched}
    while True:
        axes = [Axis(name, 1, values) for name, values in (fixed | found).items() if name in remembered]
        axes += [Axis(name, 0, values) for name, values in fixed.items()]
        for node in structure.planned("given"):
            if node.values is None:
                raise ValueOutOfRange(f"{node.name} is a continuum, so the values of {searched} cannot be listed")
            axes.append(Axis(node.name, 0, node.values))
            if node.name in remembered:
                axes.append(Axis(node.name, 1, _union(node.values, laws.before(node.name)[None])))
        mesh = Slice(laws, axes, {})
        grown = {name: _union(found[name], _rows(mesh.value(name), 1 + len(axes))) for name in searched}
        if all(len(grown[name]) == len(found[name]) for name in searched):
            return found
        for name, values in grown.items():
            if len(values) > LARGEST_SUPPORT:
                raise ValueOutOfRange(f"{name} reaches more than {LARGEST_SUPPORT} values; bound it, with clamp say")
        found = grown


def _first(laws: Laws, name: str, fixed: dict[str, Tensor]) -> Tensor:
    before = laws.before(name)
    if not isinstance(before, Variable):
        return before[None]
    statics = [n for n in laws.model.declaration.names["static"] if n in fixed]
    axes = [Axis(static, 0, fixed[static]) for static in statics]
    return torch.unique(_rows(Slice(laws, axes, {}).value(before.name), 1 + len(axes)), dim=0)


def _rows(values: Tensor, lead: int) -> Tensor:
    return values.reshape(-1, *values.shape[lead:])


def _union(values: Tensor, more: Tensor) -> Tensor:
    """The values, followed by those of ``more`` that are not among them."""
    flat, extra = values.reshape(len(values), -1), more.reshape(len(more), -1).to(values.dtype)
    new = extra[~(extra[:, None] == flat[None]).all(-1).any(-1)]
    if not len(new):
        return values
    new = torch.unique(new, dim=0)
    return torch.cat([values, new.reshape(-1, *values.shape[1:])])


def contract(factors: list[Tensor], statics: int, previous: int) -> Tensor:
    """Multiply factors (B, statics, previous, states) and sum over the previous states."""
    dims = list(range(factors[0].dim()))
    operands: list[Any] = []
    for factor in factors:
        kept = [d for d in dims if factor.shape[d] > 1]
        operands += [factor.reshape([factor.shape[d] for d in kept]), kept]
    out = [d for d in dims if not 1 + statics <= d < 1 + statics + previous]
    sizes = [max(factor.shape[d] for factor in factors) for d in out]
    held = {d for subscripts in operands[1::2] for d in subscripts}
    result = torch.einsum(*operands, [d for d in out if d in held])
    return result.reshape(sizes)
