"""Marginals and entropies of variables, or of functions of them, under weights on a mesh of hidden values."""

from __future__ import annotations

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.errors import nearest
from apmodels.laws import Laws
from apmodels.structure import Structure
from inference.tables.layout import Layout
from inference.tables.slices import Slice

# The names asked for, and either the dimensions to keep or the group of each cell of the mesh.
Plan = tuple[dict[str, Tensor], list[int] | None, Tensor | None]


class Projections:
    """How to sum log probabilities (B, *sizes) to those of some variables; worked out once for each set of names."""

    def __init__(self, laws: Laws, structure: Structure, layout: Layout):
        self.laws, self.structure, self.layout = laws, structure, layout
        self.plans: dict[tuple[str, ...], Plan] = {}

    def marginal(self, log_probs: Tensor, names: tuple[str, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """Return name -> values (n, *shape) of the joint outcomes, and their log probabilities (B, n)."""
        if not names:
            return {}, log_probs.reshape(len(log_probs), -1).logsumexp(1, keepdim=True)
        if names not in self.plans:
            self.plans[names] = self._plan(names)
        values, dims, groups = self.plans[names]
        if dims is not None:
            if len(dims) == log_probs.dim() - 1:
                return values, log_probs if log_probs.dim() == 2 else log_probs.flatten(1)
            gone = [d for d in range(1, log_probs.dim()) if d not in dims]
            return values, log_probs.logsumexp(gone).flatten(1)
        assert groups is not None
        probs = log_probs.flatten(1).exp()
        count = len(next(iter(values.values())))
        return values, probs.new_zeros(len(probs), count).index_add(1, groups, probs).log()

    def entropy(self, log_probs: Tensor, names: tuple[str, ...]) -> Tensor:
        """Return the joint entropy of variables, nats, (B,)."""
        _, logs = self.marginal(log_probs, names)
        return -(logs.exp() * logs.clamp(min=torch.finfo(logs.dtype).min)).sum(-1)

    def _plan(self, names: tuple[str, ...]) -> Plan:
        at = {axis.name: 1 + i for i, axis in enumerate(self.layout.axes)}
        if all(name in at for name in names) and [at[n] for n in names] == sorted(at[n] for n in names):
            values = [self.layout.axes[at[name] - 1].values for name in names]
            picked = torch.cartesian_prod(*[torch.arange(len(v)) for v in values]).reshape(-1, len(values))
            return (
                {n: v[picked[:, i]] for i, (n, v) in enumerate(zip(names, values, strict=True))},
                [at[n] for n in names],
                None,
            )
        mesh = Slice(self.laws, self.layout.axes, {})
        columns, shapes = [], []
        for name in names:
            value = self._on_mesh(mesh, name)
            shapes.append((value.dtype, value.shape[1 + len(at) :]))
            wide = value.expand(1, *self.layout.sizes, *shapes[-1][1])
            columns.append(wide.reshape(torch.Size(self.layout.sizes).numel(), -1).double())
        joint, groups = torch.unique(torch.cat(columns, 1), dim=0, return_inverse=True)
        split = joint.split([column.shape[1] for column in columns], 1)
        values = {
            name: part.reshape(-1, *shape).to(dtype)
            for name, part, (dtype, shape) in zip(names, split, shapes, strict=True)
        }
        return values, None, groups

    def _on_mesh(self, mesh: Slice, name: str) -> Tensor:
        hidden = [node.name for node in self.structure.hidden]
        if name not in (*hidden, "interest"):
            node = self.structure.nodes.get(name)
            if node is None:
                raise ValueOutOfRange(f"there is no variable {name}{nearest(name, hidden)}")
            raise ValueOutOfRange(f"{name} is {node.plan}, and no belief is held about it: see belief.known")
        if name in {axis.name for axis in self.layout.spent}:
            raise ValueOutOfRange(f"{name} only says how a state begins, and is forgotten; let it be of interest")
        try:
            return mesh.value(name)
        except KeyError as missing:
            raise ValueOutOfRange(
                f"{name} depends on {missing.args[0]}, which a belief does not keep; let a state remember it"
            ) from missing
