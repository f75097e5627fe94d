"""What is known about one step, world by world: the context in which laws are evaluated."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from apmodels.laws import Law, Laws

Key = tuple[str, int]

# So many contexts are remembered before a memory starts again.
MOST = 4096


class Frame:
    """Values by (name, lag), each (B or 1, N or 1, *shape): rows of a batch, and worlds of a row."""

    def __init__(self, values: dict[Key, Tensor] | None = None):
        self.values = dict(values or {})

    def lead(self, keys: Iterable[Key] | None = None) -> tuple[int, int]:
        """Return the (rows, worlds) over which some of the values vary, all of them by default."""
        sizes = [self.values[key].shape[:2] for key in (self.values if keys is None else keys)]
        rows, worlds = torch.broadcast_shapes((1, 1), *sizes)
        return rows, worlds

    def evaluate(self, laws: Laws, name: str, points: dict[str, Tensor] | None = None) -> Law:
        """Return a law in every world: batch shape (b, n, points), where ``points`` (P, *shape) are by argument."""
        points = points or {}
        many = max((len(value) for value in points.values()), default=1)
        parents = {}
        for parent in laws.variables[name].parents:
            if parent.argument in points:
                parents[parent.argument] = points[parent.argument][None, None]
            else:
                parents[parent.argument] = _in(laws, self.values[parent.name, parent.lag])[:, :, None]
        leads = [value.shape[:2] for value in parents.values()]
        return laws.many(name, parents, (*torch.broadcast_shapes((1, 1), *leads), many))

    def draw(self, laws: Laws, name: str, lead: tuple[int, int]) -> tuple[Law, Tensor]:
        """Return a law with batch shape ``lead``, and a draw from it, or its value."""
        law = self.in_all(laws, name, lead)
        return law, (law if isinstance(law, Tensor) else law.sample())

    def in_all(self, laws: Laws, name: str, lead: tuple[int, int]) -> Law:
        """Return a law whose batch shape is ``lead``."""
        parents = {}
        for parent in laws.variables[name].parents:
            value = _in(laws, self.values[parent.name, parent.lag])
            parents[parent.argument] = value
        return laws.many(name, parents, lead)

    def score(self, laws: Laws, name: str, value: Tensor, lead: tuple[int, int]) -> Tensor:
        """Return log p(value) in every world, nats, ``lead``; ``value`` is (B or 1, N or 1, *shape)."""
        parents = {}
        for parent in laws.variables[name].parents:
            parents[parent.argument] = _in(laws, self.values[parent.name, parent.lag])
        return laws.score(name, parents, value, lead)

    def check(self, laws: Laws, names: Iterable[str]) -> None:
        """Raise ValueOutOfRange, naming the law, where a parameter is out of range, which scoring does not look at."""
        for name in names:
            self.in_all(laws, name, self.lead([(p.name, p.lag) for p in laws.variables[name].parents]))


def _in(laws: Laws, value: Tensor) -> Tensor:
    return value.to(laws.dtype) if value.is_floating_point() else value


class Memory:
    """Tables by context: what ``build`` makes of a frame, (b, n, ...) tensors, made once for every context met.

    A law that varies over whole numbers alone (actions, hypotheses) is evaluated once for each of them, however many
    rows and worlds there are; over a continuum it is evaluated where it is asked for.
    """

    def __init__(self, keys: Iterable[Key], build: Callable[[Frame], tuple[Tensor, ...]]):
        self.keys = list(keys)
        self.build = build
        self.made: dict[bytes, tuple[Tensor, ...]] = {}

    def __call__(self, frame: Frame) -> tuple[Tensor, ...]:
        """Return the tables of every row and world of a frame."""
        values = {key: frame.values[key] for key in self.keys}
        lead = frame.lead(self.keys)
        if any(value.requires_grad for value in values.values()):
            return self.build(Frame(values))
        if lead == (1, 1):
            return self._remembered(values)
        if any(value.is_floating_point() for value in values.values()):
            return self.build(Frame(values))
        columns = [v.expand(*lead, *v.shape[2:]).reshape(lead[0] * lead[1], -1) for v in values.values()]
        table, rows = torch.unique(torch.cat(columns, 1), dim=0, return_inverse=True)
        split = table.split([column.shape[1] for column in columns], 1)
        shapes = [value.shape[2:] for value in values.values()]
        few = {
            key: part.reshape(len(table), 1, *s).to(v.dtype)
            for (key, v), part, s in zip(values.items(), split, shapes, strict=True)
        }
        parts = self._remembered(few)
        return tuple(
            part.expand(len(table), *part.shape[1:])[rows, 0].reshape(*lead, *part.shape[2:]) for part in parts
        )

    def _remembered(self, values: dict[Key, Tensor]) -> tuple[Tensor, ...]:
        mark = repr([value.shape for value in values.values()]).encode()
        mark += b"".join(value.detach().contiguous().numpy().tobytes() for value in values.values())
        if mark not in self.made:
            if len(self.made) >= MOST:
                self.made.clear()
            made = self.build(Frame(values))
            if any(part.requires_grad for part in made):
                return made
            self.made[mark] = made
        return self.made[mark]
