"""Affine laws as matrices: evaluated where all their Gaussian parents are zero, and at each unit vector."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels import DeclarationError
from apmodels.distributions import base_of
from apmodels.laws import Law, Laws
from inference.worlds.frame import Frame, Key


class Linear:
    """The laws of one model as matrices, in double precision where its fields can be had in it."""

    def __init__(self, model: Any, shapes: dict[str, tuple[int, ...]]):
        self.laws = Laws(model, torch.float64)
        self.model = model
        self.shapes = shapes

    def size(self, name: str) -> int:
        """How many numbers a variable has."""
        return torch.Size(self.shapes[name]).numel()

    def parents(self, name: str, among: set[str]) -> list[Key]:
        """Return a variable's parents among these, by (name, lag)."""
        return [(p.name, p.lag) for p in self.laws.variables[name].parents if p.name in among]

    def others(self, name: str, among: set[str]) -> list[Key]:
        """Return a variable's other parents: the context of its law."""
        return [(p.name, p.lag) for p in self.laws.variables[name].parents if p.name not in among]

    def read(self, name: str, frame: Frame, among: set[str]) -> tuple[dict[Key, Tensor], Tensor, Tensor]:
        """Return a law as matrices by parent (b, n, m, d), an offset (b, n, m) and a covariance (b, n, m, m)."""
        wanted = [p for p in self.laws.variables[name].parents if p.name in among]
        sizes = [self.size(p.name) for p in wanted]
        steps = torch.cat([torch.zeros(1, sum(sizes)), torch.eye(sum(sizes))]).double()
        split = steps.split(sizes, 1) if sizes else []
        points = {p.argument: s.reshape(-1, *self.shapes[p.name]) for p, s in zip(wanted, split, strict=True)}
        law = self._evaluate(name, frame, points)
        centre, noise = _moments(law)
        offset, slopes = centre[:, :, 0], (centre[:, :, 1:] - centre[:, :, :1]).mT
        parts = slopes.split(sizes, -1) if sizes else []
        return {(p.name, p.lag): s for p, s in zip(wanted, parts, strict=True)}, offset, noise[:, :, 0]

    def _evaluate(self, name: str, frame: Frame, points: dict[str, Tensor]) -> Law:
        try:
            return frame.evaluate(self.laws, name, {k: v.to(self.laws.dtype) for k, v in points.items()})
        except DeclarationError as error:
            # A field that is not a dataclass (a network, say) may keep its own precision.
            if self.laws.dtype == torch.get_default_dtype() or not any(w in str(error) for w in ("dtype", "same type")):
                raise
            self.laws = Laws(self.model)
            return self._evaluate(name, frame, points)


def _moments(law: Law) -> tuple[Tensor, Tensor]:
    """The mean (b, n, points, m) and covariance (b, n, points, m, m) of a Gaussian or deterministic law."""
    if not isinstance(law, Distribution):
        centre = law.reshape(*law.shape[:3], -1).double()
        return centre, centre.new_zeros(*centre.shape, centre.shape[-1])
    base, _ = base_of(law)
    if type(base).__name__ == "MultivariateNormal":
        rows = base.loc.shape[3:].numel()
        centre = base.loc.reshape(*base.loc.shape[:3], rows).double()
        blocks = base.covariance_matrix.double()
        blocks = blocks.reshape(*blocks.shape[:3], -1, *blocks.shape[-2:])
        if blocks.shape[3] == 1:
            return centre, blocks[:, :, :, 0]
        whole = torch.stack([torch.block_diag(*some) for some in blocks.flatten(0, 2)])
        return centre, whole.reshape(*blocks.shape[:3], rows, rows)
    centre = base.loc.reshape(*base.loc.shape[:3], -1).double()
    scale = base.scale.reshape(*base.scale.shape[:3], -1).double()
    return centre, torch.diag_embed(scale * scale)
