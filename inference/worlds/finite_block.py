"""Variables with finitely many values that touch nothing but observations and each other, given a world."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from apmodels.distributions import log_prob_of, picked, tensors, with_tensors
from apmodels.laws import Laws
from apmodels.structure import Structure
from inference.tables.slices import Axis, Slice, contract, supports
from inference.worlds.frame import Frame, Key


class FiniteBlock:
    """Log probabilities (rows, *sizes) over the joint values of a group, a row for every world of every belief."""

    def __init__(self, laws: Laws, structure: Structure, names: tuple[str, ...], seen: list[str]):
        self.laws, self.names = laws, names
        values = {name: found for name, found in supports(laws, structure).items() if name in names}
        roles = {name: structure.nodes[name].role for name in (*values, *seen)}
        self.early = [name for name in seen if roles[name] == "static"]
        self.seen = [name for name in seen if name not in self.early]
        remembered = laws.model.declaration.remembered
        self.statics = [Axis(name, 0, values[name]) for name in values if roles[name] == "static"]
        self.states = [Axis(name, 0, values[name]) for name in values if roles[name] == "state"]
        self.previous = [Axis(axis.name, 1, axis.values) for axis in self.states if axis.name in remembered]
        self.axes = self.statics + self.states
        self.sizes = tuple(axis.size for axis in self.axes)
        own = {p for name in (*names, *seen) for p in self._contexts(name)}
        self.keys: list[Key] = sorted(own)

    def _contexts(self, name: str) -> list[Key]:
        return [(p.name, p.lag) for p in self.laws.variables[name].parents if p.name not in self.names]

    def start(self, frame: Frame, befores: dict[str, str | Tensor], lead: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return the prior given the statics of the worlds, (*lead, *sizes), and how probable it makes those, lead."""
        known = [key for key in self.keys if not key[1] and key in frame.values]
        mesh = Slice(self.laws, self.axes, self._flat(frame, known, lead))
        logs = torch.zeros((1,) * (1 + len(self.axes)), dtype=self.laws.dtype)
        for axis in self.statics:
            logs = logs + mesh.transition(axis)
        for axis in self.states:
            logs = logs + self._before(mesh, axis, befores.get(axis.name), lead)
        for name in self.early:
            logs = logs + self._score(mesh, name, frame.values[name, 0], lead)
        logs = logs.expand(lead[0] * lead[1], *self.sizes).reshape(*lead, *self.sizes)
        total = logs.flatten(2).logsumexp(2)
        return logs - total.reshape(*lead, *[1] * len(self.sizes)), total

    def _before(self, mesh: Slice, axis: Axis, before: str | Tensor | None, lead: tuple[int, int]) -> Tensor:
        if before is None:
            return torch.tensor(-math.log(axis.size), dtype=self.laws.dtype)
        here = mesh.along(axis, axis.values)
        dims = 1 + len(self.axes)
        if isinstance(before, str):
            there = mesh.value(before)
        else:
            wide = before.expand(*lead, *before.shape[2:]).flatten(0, 1)
            there = wide.reshape(len(wide), *(1,) * len(self.axes), *wide.shape[1:]).to(here.dtype)
        same = here == there
        same = same.flatten(dims).all(-1) if same.dim() > dims else same
        return same.to(self.laws.dtype).log()

    def step(self, logs: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
        """Move on and condition on what is seen; return normalised log probabilities and the score, (b, n)."""
        lead = torch.broadcast_shapes(
            logs.shape[:2], frame.lead(self.keys), *(frame.values[name, 0].shape[:2] for name in self.seen)
        )
        logs = logs.expand(*lead, *self.sizes)
        axes = self.statics + self.previous + self.states
        mesh = Slice(self.laws, axes, self._flat(frame, self.keys, lead))
        rows = lead[0] * lead[1]
        past = self._past(logs.reshape(rows, *self.sizes))
        top = past.flatten(1).amax(1)
        factors = [(past - top.reshape(-1, *[1] * (past.dim() - 1))).exp()]
        factors += [mesh.transition(axis).exp() for axis in self.states]
        shift = top
        for name in self.seen:
            score = self._score(mesh, name, frame.values[name, 0], lead)
            most = score.flatten(1).amax(1)
            most = torch.where(torch.isfinite(most), most, 0.0)
            factors.append((score - most.reshape(-1, *[1] * (score.dim() - 1))).exp())
            shift = shift + most
        joint = contract(factors, len(self.statics), len(self.previous))
        joint = joint.expand(rows, *joint.shape[1:])
        total = joint.flatten(1).sum(1)
        logs = joint.log() - total.log().clamp(min=-1e30).reshape(-1, *[1] * (joint.dim() - 1))
        return logs.reshape(*lead, *self.sizes), (total.log() + shift).reshape(lead)

    def imagine(self, logs: Tensor, frame: Frame, lead: tuple[int, int]) -> dict[str, Tensor]:
        """Draw what would be seen after a step, (*lead, *shape) by name."""
        rows = lead[0] * lead[1]
        mesh, joint = self._joint(logs.expand(*lead, *self.sizes), frame)
        flat = joint.expand(rows, *joint.shape[1:]).flatten(1)
        cell = (flat.log() - torch.log(-torch.log(torch.rand(flat.shape, dtype=flat.dtype)))).argmax(1)
        at = torch.unravel_index(cell, joint.shape[1:])
        seen = {}
        for name in self.seen:
            law = mesh.distribution(name)
            shape = law.batch_shape
            index = [torch.arange(rows) if shape[0] > 1 else torch.zeros(rows, dtype=torch.int64)]
            index += [i if size > 1 else torch.zeros_like(i) for i, size in zip(at, shape[1:], strict=True)]
            drawn = picked(law, tuple(index), (rows,), len(shape)).sample()
            seen[name] = drawn.reshape(*lead, *drawn.shape[1:]).to(self.laws.dtype)
        return seen

    def predicted(self, name: str, logs: Tensor, frame: Frame) -> tuple[Tensor, Any]:
        """Return weights (rows, cells) of what could be so, and the law of what would be seen there."""
        rows = logs.shape[0] * logs.shape[1]
        mesh, joint = self._joint(logs, frame)
        law = mesh.distribution(name)
        gone = [d for d in range(1, joint.dim()) if law.batch_shape[d] == 1]
        weights = joint.sum(gone, keepdim=True) if gone else joint
        cells = weights.shape[1:].numel()
        parts = [p.expand(rows, *p.shape[1:]) for p in tensors(law)]
        parts = [p.reshape(rows, cells, *p.shape[joint.dim() :]) for p in parts]
        return weights.expand(rows, *weights.shape[1:]).reshape(rows, cells), with_tensors(
            law, parts, (rows, cells), joint.dim()
        )

    def _joint(self, logs: Tensor, frame: Frame) -> tuple[Slice, Tensor]:
        """The mesh of a step, and p(statics, states before, states now) on it."""
        lead = logs.shape[:2]
        mesh = Slice(self.laws, self.statics + self.previous + self.states, self._flat(frame, self.keys, lead))
        joint = self._past(logs.reshape(lead[0] * lead[1], *self.sizes)).exp()
        for axis in self.states:
            joint = joint * mesh.transition(axis).exp()
        return mesh, joint

    def _past(self, logs: Tensor) -> Tensor:
        kept = {axis.name for axis in self.previous}
        first = 1 + len(self.statics)
        gone = [first + i for i, axis in enumerate(self.states) if axis.name not in kept]
        past = logs.logsumexp(gone) if gone else logs
        return past.reshape(*past.shape, *[1] * len(self.states))

    def _score(self, mesh: Slice, name: str, value: Tensor, lead: tuple[int, ...]) -> Tensor:
        law = mesh.distribution(name)
        wide = value.expand(*lead, *value.shape[2:]).flatten(0, 1)
        wide = wide.reshape(len(wide), *(1,) * len(mesh.axes), *wide.shape[1:])
        shape = torch.broadcast_shapes(law.batch_shape, wide.shape[: 1 + len(mesh.axes)])
        return log_prob_of(law, wide.expand(*shape, *wide.shape[1 + len(mesh.axes) :]))

    def _flat(self, frame: Frame, keys: list[Key], lead: tuple[int, ...]) -> dict[Key, Tensor]:
        """Contexts as a mesh has them, one dimension for rows and worlds."""
        if frame.lead(keys) == (1, 1):
            return {key: frame.values[key][0] for key in keys}
        wide = {key: frame.values[key] for key in keys}
        return {key: value.expand(*lead, *value.shape[2:]).flatten(0, 1) for key, value in wide.items()}

    def values(self, frame: Frame, name: str, lead: tuple[int, int]) -> Tensor:
        """Return a variable's values on the mesh, (1 or rows, sizes or 1, *shape)."""
        known = [key for key in self.keys if not key[1] and key in frame.values]
        return Slice(self.laws, self.axes, self._flat(frame, known, lead)).value(name)
