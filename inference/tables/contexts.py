"""Numbering contexts: the combinations of known values for which laws have been tabulated."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from inference.tables.slices import Context, Key

# Beyond so many contexts the known values are as good as a continuum, and the table starts again; and beyond so many
# numbers, contexts by hypotheses.
MOST, NUMBERS = 1 << 16, 1 << 28


class Contexts:
    """Rows of a table by context; rows that are missing are made by ``build`` when they are first asked for.

    ``size`` is how many hypotheses each row has.
    """

    def __init__(self, keys: list[Key], size: int, build: Callable[[Context | None], None], forget: Callable[[], None]):
        self.keys = keys
        self.most = max(1, min(MOST, NUMBERS // size))
        self.build = build
        self.forget = forget
        self.clear()

    def clear(self) -> None:
        """Forget all contexts and their tables."""
        self.seen: dict[tuple, int] = {}
        self.singles: dict[int, Tensor] = {}
        self.lookup = torch.full((0,), -1, dtype=torch.int64)
        self.forget()

    def rows(self, context: Context) -> Tensor:
        """Return the row of each of B contexts, int64 (B,)."""
        if not self.keys:
            if not self.seen:
                self.build(None)
                self.seen[()] = 0
            return torch.zeros(1, dtype=torch.int64)
        if len(self.keys) == 1:
            values = context[self.keys[0]]
            if values.dim() == 1 and not values.dtype.is_floating_point:
                return self._by_one(values, context) if len(values) == 1 else self._by_number(values, context)
        return self._by_value(context)

    def _by_one(self, values: Tensor, context: Context) -> Tensor:
        """One belief at a time is the commonest case, and a dictionary is quicker than tensors."""
        row = self.singles.get(int(values))
        if row is None:
            row = self.singles[int(values)] = self._by_number(values, context)
        return row

    def _by_number(self, values: Tensor, context: Context) -> Tensor:
        """One whole number, which every grid and every finite action is: a table look-up."""
        low, high = torch.aminmax(values)
        if low < 0 or high >= self.most:
            return self._by_value(context)
        if high >= len(self.lookup):
            self.lookup = torch.nn.functional.pad(self.lookup, (0, int(high) + 1 - len(self.lookup)), value=-1)
        rows = self.lookup[values]
        if bool((rows < 0).any()):
            new = torch.unique(values[rows < 0])
            self.build({self.keys[0]: new})
            self.lookup[new] = torch.arange(len(self.seen), len(self.seen) + len(new))
            self.seen.update({(value,): len(self.seen) + i for i, value in enumerate(new.tolist())})
            rows = self.lookup[values]
        return rows

    def _by_value(self, context: Context) -> Tensor:
        columns = [context[key].reshape(len(context[key]), -1).double() for key in self.keys]
        table, inverse = torch.unique(torch.cat(columns, 1), dim=0, return_inverse=True)
        first = torch.zeros(len(table), dtype=torch.int64).scatter(0, inverse, torch.arange(len(inverse)))
        keys = [tuple(row) for row in table.tolist()]
        if len(self.seen) + len(keys) > self.most:
            self.clear()
        new = [i for i, key in enumerate(keys) if key not in self.seen]
        if new:
            self.build({key: context[key][first[new]] for key in self.keys})
            for i in new:
                self.seen[keys[i]] = len(self.seen)
        return torch.tensor([self.seen[key] for key in keys], dtype=torch.int64)[inverse]
