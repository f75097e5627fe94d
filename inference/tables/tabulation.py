"""All tables of one model: its observations' and its transitions', by context."""

from __future__ import annotations

import torch
from torch import Tensor

from apmodels.distributions import tensors, with_tensors
from apmodels.laws import Laws
from apmodels.progress import progress
from inference.tables.contexts import Contexts
from inference.tables.families import tabulate
from inference.tables.layout import Layout
from inference.tables.slices import Context, Slice
from inference.tables.table import Misfit, Rows, Table

# How many numbers of a law's table are evaluated at a time.
CHUNK = 40_000_000


class Tabulation:
    """Tables that are made for a context when it is first met.

    ``tables`` are the observations', by name; ``shapes`` the sizes of their hypotheses in a step's axes, of which
    those that an observation does not depend on are 1, and ``now_shapes`` the same without the past. ``late`` are the
    observations that depend on the present alone, and not on how it came about.
    """

    def __init__(self, laws: Laws, layout: Layout):
        self.laws = laws
        self.layout = layout
        self.names: list[str] = laws.model.observation_names
        self.level = 0
        self.contexts = Contexts(layout.keys, torch.Size(layout.sizes).numel(), self._tabulate, self._forget)

    def rows(self, context: Context, count: int) -> Rows:
        """Return the rows of a batch's contexts; a view for a single one, which copies nothing and wakes no threads."""
        rows = self.find(context)
        if count == 1:
            return slice(int(rows), int(rows) + 1)
        return rows.expand(count)

    def find(self, context: Context) -> Tensor:
        """Return the rows of contexts, (B,), or (1,) where all are alike."""
        try:
            return self.contexts.rows(context)
        except Misfit:
            # Some later context has another structure than the first: begin again, with what serves them all.
            self.level += 1
            self.contexts.clear()
            return self.find(context)
        except Exception:
            # A law that failed half way may have left half a table.
            self.contexts.clear()
            raise

    def transitions(self, rows: Rows) -> list[Tensor]:
        """Return p(value | parents) of each state, in a step's axes, (B or 1, sizes or 1)."""
        pairs = zip(self.layout.present, self._transitions, strict=True)
        return [factor[rows] if self.layout.varies(axis.name) else factor for axis, factor in pairs]

    def _forget(self) -> None:
        self.tables: dict[str, Table] = {}
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.now_shapes: dict[str, tuple[int, ...]] = {}
        self.late: set[str] = set()
        self._transitions: list[Tensor] = []

    def _tabulate(self, context: Context | None) -> None:
        """Add the tables of K new contexts, a chunk at a time."""
        count = 1 if context is None else len(next(iter(context.values())))
        nodes = self.laws.model.structure.nodes
        shape = max(torch.Size(nodes[name].shape).numel() for name in self.names)
        # What a context needs is known when one has been evaluated; before, the most that it may need.
        needs, done = max(1, shape * torch.Size(self.layout.sizes).numel()), 0
        with progress(show=CHUNK // needs < count // 3) as bar:
            task = bar.add_task("tabulating", total=count)
            while done < count:
                step = max(1, CHUNK // needs)
                mesh = Slice(
                    self.laws,
                    self.layout.step_axes,
                    {key: value[done : done + step] for key, value in (context or {}).items()},
                )
                self._append_transitions(mesh)
                needs = max(1, *(self._append_observation(mesh, name) for name in self.names))
                done += step
                bar.update(task, completed=done)

    def _append_transitions(self, mesh: Slice) -> None:
        for i, axis in enumerate(self.layout.present):
            new = mesh.transition(axis).exp()
            if self.layout.varies(axis.name):
                new = new.expand(mesh.contexts, *new.shape[1:])
            if i == len(self._transitions):
                self._transitions.append(new)
            elif self.layout.varies(axis.name):
                self._transitions[i] = torch.cat([self._transitions[i], new])

    def _append_observation(self, mesh: Slice, name: str) -> int:
        """Add an observation's tables of a mesh's contexts, and return how many numbers its law holds for each."""
        law = mesh.distribution(name)
        held = max(p.untyped_storage().nbytes() // p.element_size() for p in tensors(law))
        shape = tuple(law.batch_shape[1 : 1 + len(mesh.axes)])
        flat, contexts = torch.Size(shape).numel(), mesh.contexts
        parts = [p.expand(contexts, *p.shape[1:]) for p in tensors(law)]
        parts = [p.reshape(contexts, flat, *p.shape[1 + len(shape) :]) for p in parts]
        table = tabulate(with_tensors(law, parts, (contexts, flat), 1 + len(shape)), contexts, flat, self.level)
        if name in self.tables:
            self.tables[name].append(table)
        else:
            self.tables[name], self.shapes[name] = table, shape
            self.now_shapes[name] = self.layout.without_past(shape)
            if all(n == 1 for n in self.layout.past(shape)):
                self.late.add(name)
        self.tables[name].settle()
        return max(held // contexts, flat)
