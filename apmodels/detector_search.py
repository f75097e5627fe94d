"""Where is the object?  Visual search with an object detector for an eye, MI-POMDP (thesis ch. 5, section 5.6.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pyro.distributions import Categorical
from torch import Tensor

from apmodels.errors import ValueOutOfRange
from apmodels.planted import Planted
from apmodels.spaces import Grid
from apmodels.variables import observation
from apmodels.visual_search import VisualSearch


@dataclass(frozen=True, eq=False)
class CountModel:
    """How many boxes a detector returns in a cell, P(c | object here or not, offset from the fixation).

    ``present`` and ``absent`` are weights (rows, columns, max_count + 1) by the absolute offset of the cell from
    the fixation; an offset beyond the table uses its last row or column, so (1, 1, max_count + 1) is the same
    everywhere.
    """

    present: Tensor
    absent: Tensor

    def __post_init__(self) -> None:
        if self.present.dim() != 3 or self.absent.dim() != 3 or self.present.shape[-1] != self.absent.shape[-1]:
            raise ValueOutOfRange(
                "a count model needs two tables (rows, columns, counts) with the same counts, not "
                f"{tuple(self.present.shape)} and {tuple(self.absent.shape)}"
            )

    @classmethod
    def untrained(cls, max_count: int = 9) -> CountModel:
        """Return what one believes before any data: P(c | object) ∝ 5c + 0.999, flat otherwise."""
        counts = torch.arange(max_count + 1.0)
        return cls((5 * counts + 0.999).reshape(1, 1, -1), torch.ones(1, 1, max_count + 1))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, CountModel)
            and torch.equal(self.present, other.present)
            and torch.equal(self.absent, other.absent)
        )

    def __hash__(self) -> int:
        return hash((self.present.shape, self.absent.shape))

    def __repr__(self) -> str:
        return f"CountModel(present={tuple(self.present.shape)}, absent={tuple(self.absent.shape)})"


def _at(table: Tensor, offset: Tensor) -> Tensor:
    """The weights (..., counts) at absolute offsets (..., 2)."""
    row, column = offset.abs().unbind(-1)
    return table[row.clamp(max=table.shape[0] - 1), column.clamp(max=table.shape[1] - 1)]


class DetectorSearch(VisualSearch):
    """Where is the object?  A detector's boxes, counted in each cell, per fixation.  (thesis ch. 5, eqs 5.21-5.23)"""

    grid: Grid = Grid(21, 21)
    counts: CountModel = CountModel.untrained()

    @observation
    def glimpse(self, target, fixation):
        """The number of boxes centred in each cell, up to the largest that the tables know."""
        here = _at(self.counts.present, self.grid.offset(target, fixation))
        elsewhere = _at(self.counts.absent, self.grid.offset(self.grid.values(), fixation))
        return Planted(target, Categorical(here), Categorical(elsewhere))
