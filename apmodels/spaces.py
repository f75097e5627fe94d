"""Spaces: what an action may be. A space is a value: it prints, compares, pickles and can be a model's field."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor

from apmodels.errors import ValueOutOfRange, nearest


@dataclass(frozen=True)
class Space:
    """What every space can do. ``size`` is the number of values, None where they are a continuum."""

    @property
    def size(self) -> int | None:
        """The number of values, or None."""
        return None

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one value."""
        return ()

    def values(self) -> Tensor:
        """Return all values, (size, *shape); finite spaces only."""
        raise ValueOutOfRange(f"{self} has no list of values")

    def sample(self, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw values uniformly, (*shape, *self.shape)."""
        raise NotImplementedError

    def check(self, value: Any, name: str = "action") -> Tensor:
        """Return ``value`` as a tensor (*batch, *shape); ValueOutOfRange where it is not in the space."""
        raise NotImplementedError


@dataclass(frozen=True)
class Finite(Space):
    """The whole numbers 0 ... count - 1, with names where they have some: ``Finite(3, ("left", "right", "cross"))``."""

    count: int
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueOutOfRange(f"a finite space needs at least one value, not {self.count}")
        if self.names and len(self.names) != self.count:
            raise ValueOutOfRange(f"{self.count} values have {len(self.names)} names")

    @property
    def size(self) -> int:
        """The number of values."""
        return self.count

    def values(self) -> Tensor:
        """Return 0 ... size - 1, int64, (size,)."""
        return torch.arange(self.size)

    def sample(self, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw values uniformly, int64, ``shape``."""
        return torch.randint(self.size, shape)

    def check(self, value: Any, name: str = "action") -> Tensor:
        """Return ``value`` as int64 (*batch,); ValueOutOfRange where it is not in the space."""
        if isinstance(value, str):
            return self._named(value, name)
        given = torch.as_tensor(value)
        if given.dim() == 0 and not given.dtype.is_floating_point and 0 <= int(given) < self.size:
            return given.to(torch.int64)
        whole = given if not given.dtype.is_floating_point else _whole(given, name, self)
        whole = whole.to(torch.int64)
        low, high = torch.aminmax(whole) if whole.numel() else (0, 0)
        if low < 0 or high >= self.size:
            raise ValueOutOfRange(f"{name} is {int(low if low < 0 else high)}, outside {self}: 0 to {self.size - 1}")
        return whole

    def _named(self, value: str, name: str) -> Tensor:
        names = getattr(self, "names", ())
        if value not in names:
            raise ValueOutOfRange(f"{name} is {value!r}, which is no name of a value of {self}{nearest(value, names)}")
        return torch.tensor(names.index(value))


def _whole(given: Tensor, name: str, space: Space) -> Tensor:
    if torch.isnan(given).any():
        raise ValueOutOfRange(f"{name} is NaN; an action must be known: a value of {space}")
    if not torch.equal(given, given.round()):
        raise ValueOutOfRange(f"{name} has a fraction, but {space} has whole values only")
    return given


@dataclass(frozen=True)
class Binary(Finite):
    """Zero or one."""

    count: int = field(default=2, init=False)
    names: tuple[str, ...] = field(default=(), init=False)

    def __repr__(self) -> str:
        return "Binary()"


@dataclass(frozen=True)
class Grid(Space):
    """The cells of a grid, numbered row by row: the value of cell (row, column) is row * columns + column."""

    rows: int
    columns: int

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueOutOfRange(f"a grid needs at least one row and one column, not {self.rows}x{self.columns}")

    @property
    def size(self) -> int:
        """The number of cells."""
        return self.rows * self.columns

    values = Finite.values
    sample = Finite.sample
    check = Finite.check
    _named = Finite._named

    def uniform(self) -> dist.Categorical:
        """Return the uniform distribution over cells."""
        return dist.Categorical(torch.full((self.size,), 1.0 / self.size))

    def position(self, cell: Tensor | int) -> Tensor:
        """Return the (row, column) of cells, (*batch, 2)."""
        cell = torch.as_tensor(cell)
        return torch.stack([cell // self.columns, cell % self.columns], -1)

    def cell(self, row: Tensor | int, column: Tensor | int) -> Tensor:
        """Return the cell at (row, column)."""
        return torch.as_tensor(row) * self.columns + torch.as_tensor(column)

    def offset(self, cell: Tensor, origin: Tensor) -> Tensor:
        """Return by how many (rows, columns) cells lie from ``origin``, int64 (*batch, 2)."""
        return self.position(cell) - self.position(origin)

    def distance(self, cell: Tensor, origin: Tensor) -> Tensor:
        """Return the Euclidean distance between cells, in cells."""
        offset = self.offset(cell, origin)
        return (offset * offset).sum(-1).to(torch.get_default_dtype()).sqrt()

    def one_hot(self, cell: Tensor) -> Tensor:
        """Return an array over the grid that is 1 at the cell and 0 elsewhere, (*batch, size)."""
        return (torch.arange(self.size) == cell.unsqueeze(-1)).to(torch.get_default_dtype())


@dataclass(frozen=True)
class Box(Space):
    """Vectors between ``low`` and ``high``, of the given shape: ``Box(-1, 1, (2,))`` for two motors."""

    low: float
    high: float
    dims: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "dims", tuple(self.dims))
        if not self.low < self.high:
            raise ValueOutOfRange(f"a box needs low < high, not {self.low} and {self.high}")

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one value."""
        return self.dims

    def sample(self, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw values uniformly, (*shape, *dims)."""
        return torch.rand((*shape, *self.dims)) * (self.high - self.low) + self.low

    def check(self, value: Any, name: str = "action") -> Tensor:
        """Return ``value`` as floats (*batch, *dims); ValueOutOfRange where it is not in the space."""
        given = torch.as_tensor(value, dtype=torch.get_default_dtype())
        if self.dims and tuple(given.shape[-len(self.dims) :]) != self.dims:
            raise ValueOutOfRange(f"{name} has shape {tuple(given.shape)}; {self} needs (..., {str(self.dims)[1:-1]})")
        if torch.isnan(given).any():
            raise ValueOutOfRange(f"{name} is NaN; an action must be known: a value of {self}")
        if given.numel() and (given.min() < self.low or given.max() > self.high):
            raise ValueOutOfRange(f"{name} reaches from {given.min():g} to {given.max():g}, outside {self}")
        return given
