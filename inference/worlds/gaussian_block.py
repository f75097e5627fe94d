"""A group of variables that are jointly Gaussian, given a world (thesis eqs 6.17 to 6.29)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from inference.worlds.frame import Frame, Key, Memory
from inference.worlds.gaussian import Gaussian, condition, move
from inference.worlds.linear import Linear

# Matrices by variable, (b, n, rows, columns), before they are put side by side.
Blocks = dict[Key, Tensor]


@dataclass
class Stage:
    """Part of a step: a move from one layout to another, and then what is drawn or seen there (names, perhaps none)."""

    start: list[Key]
    extend: list[str]
    end: list[Key]
    seen: list[str]
    moves: Memory
    views: Memory


class GaussianBlock:
    """The joint Gaussian of a group, moved on stage by stage.

    Args:
        linear: the laws as matrices.
        names: the group, in order.
        drawn: the random variables with values in every world, or seen, that have a parent in the group, in order;
            observations come last.
        roles: of all variables.
        remembered: variable -> its value before time began, for those of which some law asks a step late.
    """

    def __init__(self, linear: Linear, names: tuple[str, ...], drawn: list[str], roles: dict[str, str], remembered):
        self.linear, self.names, self.roles = linear, names, roles
        self.group = set(names)
        self.statics = [(name, 0) for name in names if roles[name] == "static"]
        self.states = [name for name in names if roles[name] == "state"]
        self.carried = [name for name in self.states if name in remembered]
        self.first = [*self.statics, *((name, 0) for name in self.carried)]
        self.last = [*self.statics, *((name, 0) for name in self.states)]
        self.seen = [name for name in drawn if roles[name] == "observation"]
        self.drawn = [name for name in drawn if roles[name] != "observation"]
        order = list(linear.laws.variables)
        timed = sorted([*self.states, *(d for d in self.drawn if roles[d] == "state")], key=order.index)
        early = sorted([n for n in [*names, *self.drawn] if roles[n] == "static"], key=order.index)
        self.steps = self._program(self.last, timed, self.seen, self.last)
        self.births = self._program([], early, [], self.statics)

    def _program(self, start: list[Key], order: list[str], seen: list[str], end: list[Key]) -> dict[str, Stage]:
        """Divide a step at each draw; the last stage, under "", ends with what is seen."""
        here = [key if self.roles[key[0]] == "static" else (key[0], 1) for key in start]
        here = [key for key in here if not key[1] or key[0] in self.carried]
        stages: dict[str, Stage] = {}
        waiting: list[str] = []
        for i, name in enumerate([*order, ""]):
            if name in self.group:
                waiting.append(name)
                continue
            # A value of a step ago is dropped as soon as nobody asks for it any more.
            asked = {key for n in (*order[i:], *seen) for key in self.linear.parents(n, self.group)}
            grown = [*here, *((n, 0) for n in waiting)]
            kept = [key for key in grown if not key[1] or key in asked]
            stages[name] = self._stage(here, waiting, kept, seen if name == "" else [name])
            here, waiting = kept, []
        assert [key for key in here if not key[1]] == end or not order
        return stages

    def _stage(self, start: list[Key], extend: list[str], end: list[Key], seen: list[str]) -> Stage:
        contexts = [key for name in extend for key in self.linear.others(name, self.group)]
        views = [key for name in seen for key in self.linear.others(name, self.group)]
        stage = Stage(list(start), list(extend), list(end), list(seen), None, None)  # type: ignore[arg-type]
        stage.moves = Memory(dict.fromkeys(contexts), lambda frame: self._moves(stage, frame))
        stage.views = Memory(dict.fromkeys(views), lambda frame: self._views(stage, frame))
        return stage

    def _width(self, layout: list[Key]) -> list[int]:
        return [self.linear.size(name) for name, _ in layout]

    def _moves(self, stage: Stage, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """The matrix, offset and noise that lead from a stage's first layout to its last."""
        lead = frame.lead()
        layout, widths = list(stage.start), self._width(stage.start)
        total = sum(widths)
        matrix = torch.eye(total, dtype=torch.float64).expand(*lead, total, total)
        offset, noise = matrix.new_zeros(*lead, total), matrix.new_zeros(*lead, total, total)
        for name in stage.extend:
            slopes, shift, spread = self.linear.read(name, frame, self.group)
            row = self._row(slopes, layout, shift)
            here, shift = row @ matrix, (row @ offset[..., None])[..., 0] + shift
            cross = row @ noise
            spread = cross @ row.mT + spread
            noise = torch.cat([torch.cat([noise, cross.mT], -1), torch.cat([cross, spread], -1)], -2)
            matrix, offset = torch.cat([matrix, here], -2), torch.cat([offset, shift], -1)
            layout.append((name, 0))
        kept = self._places(layout, stage.end)
        return matrix[..., kept, :], offset[..., kept], noise[..., kept, :][..., kept]

    def _views(self, stage: Stage, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """The matrix, offset and noise of what is drawn or seen at the end of a stage."""
        lead, rows, offsets, noises = frame.lead(), [], [], []
        for name in stage.seen:
            slopes, shift, spread = self.linear.read(name, frame, self.group)
            rows.append(self._row(slopes, stage.end, shift).expand(*lead, -1, -1))
            offsets.append(shift.expand(*lead, -1))
            noises.append(spread.expand(*lead, -1, -1))
        return torch.cat(rows, -2), torch.cat(offsets, -1), _block_diagonal(noises)

    def _row(self, slopes: Blocks, layout: list[Key], like: Tensor) -> Tensor:
        parts = []
        for key, width in zip(layout, self._width(layout), strict=True):
            parts.append(slopes.get(key, like.new_zeros(*like.shape, width)))
        return torch.cat(parts, -1) if parts else like.new_zeros(*like.shape, 0)

    def _places(self, layout: list[Key], wanted: list[Key]) -> Tensor:
        starts = dict(zip(layout, torch.tensor([0, *self._width(layout)]).cumsum(0).tolist(), strict=False))
        spans = [torch.arange(starts[key], starts[key] + self.linear.size(key[0])) for key in wanted]
        return torch.cat(spans) if spans else torch.zeros(0, dtype=torch.int64)

    # What the bank asks for.

    def advance(self, belief: Gaussian, frame: Frame, upto: str = "", birth: bool = False) -> Gaussian:
        """Move on to where ``upto`` is drawn, or to the end of the step."""
        stage = (self.births if birth else self.steps)[upto]
        matrix, offset, noise = stage.moves(frame)
        if not birth and belief.mean.shape[-1] != matrix.shape[-1]:
            raise AssertionError(f"a belief over {belief.mean.shape[-1]} numbers meets {tuple(matrix.shape)}")
        return move(belief, matrix, offset, noise)

    def enter(self, belief: Gaussian, time: int) -> Gaussian:
        """Return what a step begins with: the statics, and those states of a step ago that are remembered."""
        if not time or self.first == self.last:
            return belief
        return self.take(belief, self.last, self.first)

    def view(self, frame: Frame, at: str = "", birth: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return the matrix, offset and noise of what is drawn or seen at the end of a stage."""
        matrix, offset, noise = (self.births if birth else self.steps)[at].views(frame)
        return matrix, offset, noise

    def leave(self, belief: Gaussian, birth: bool = False) -> Gaussian:
        """Drop what belongs to the step before."""
        layout = (self.births if birth else self.steps)[""].end
        wanted = self.statics if birth else self.last
        return belief if layout == wanted else self.take(belief, layout, wanted)

    def take(self, belief: Gaussian, layout: list[Key], wanted: list[Key]) -> Gaussian:
        """Return the marginal of some variables."""
        at = self._places(layout, wanted)
        return Gaussian(belief.mean[..., at], belief.covariance[..., at, :][..., at])

    def layout(self, time: int) -> list[Key]:
        """Return what a belief is about at the end of a step, or before the first one."""
        return self.last if time else self.first

    def begin(self, belief: Gaussian, befores: dict[str, str | Tensor], lead: tuple[int, int]) -> Gaussian:
        """Add the remembered states before time began: a static of the group, or a value (b, n, *shape)."""
        dtype = belief.mean.dtype
        mean, covariance = belief.mean.expand(*lead, -1), belief.covariance
        for name in self.carried:
            before, width = befores[name], self.linear.size(name)
            if isinstance(before, str):
                rows = covariance.new_zeros(width, covariance.shape[-1])
                rows[torch.arange(width), self._places(self.statics, [(before, 0)])] = 1.0
                value = mean.new_zeros(width)
            else:
                rows = covariance.new_zeros(width, covariance.shape[-1])
                value = before.to(dtype).reshape(*before.shape[:2], width)
            rows = torch.cat([torch.eye(covariance.shape[-1], dtype=rows.dtype), rows])
            first = mean.new_zeros(*torch.broadcast_shapes(value.shape[:-1], (1, 1)), mean.shape[-1])
            offset = torch.cat([first, value.expand(*first.shape[:-1], width)], -1)
            belief = move(Gaussian(mean, covariance), rows, offset, covariance.new_zeros(len(rows), len(rows)))
            mean, covariance = belief
        return Gaussian(mean, covariance)


def seen_by(belief: Gaussian, view: tuple[Tensor, Tensor, Tensor], value: Tensor) -> tuple[Gaussian, Tensor]:
    """Condition on a value (b, n, m) of what a view shows; return the belief and its score (b, n)."""
    return condition(belief, *view, value)


def predicted(belief: Gaussian, view: tuple[Tensor, Tensor, Tensor]) -> Gaussian:
    """Return the predictive Gaussian of what a view shows."""
    return move(belief, *view)


def _block_diagonal(parts: list[Tensor]) -> Tensor:
    if len(parts) == 1:
        return parts[0]
    sizes = [part.shape[-1] for part in parts]
    whole = parts[0].new_zeros(*parts[0].shape[:-2], sum(sizes), sum(sizes))
    at = 0
    for part, size in zip(parts, sizes, strict=True):
        whole[..., at : at + size, at : at + size] = part
        at += size
    return whole
