"""Tables of Normal elements."""

from __future__ import annotations

import torch
from torch import Tensor

from inference.tables.table import Rows, Table, generator, of_rows, summed


class GaussianTable(Table):
    """Normal elements whose spread no hypothesis changes: log ratios (y - middle) · slope (thesis eq. 5.18)."""

    stacked = ("index", "slope", "middle", "location", "scale")

    def __init__(self, index: Tensor | None, slope: Tensor, middle: Tensor, location: Tensor, scale: Tensor):
        self.index, self.slope, self.middle, self.location, self.scale = index, slope, middle, location, scale
        if index is None:
            self.stacked = tuple(name for name in self.stacked if name != "index")

    @classmethod
    def of(cls, index: Tensor | None, here: list[Tensor], baseline: list[Tensor] | None) -> GaussianTable | None:
        """Make the table, or return None where hypotheses change the spread."""
        location, scale = (p.squeeze(-1) for p in here)
        if baseline is None:
            base_location, base_scale = location.mean(1), scale[:, 0]
            at_location, at_scale = base_location[:, None], base_scale[:, None]
        else:
            base_location, base_scale = (p.squeeze(-1) for p in baseline)
            assert index is not None
            at_location, at_scale = (_at(p, index) for p in (base_location, base_scale))
        if not torch.equal(scale, at_scale.expand_as(scale)):
            return None
        slope = (location - at_location) / (scale * scale)
        return cls(index, slope, (location + at_location) / 2, base_location, base_scale)

    def ratio(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | h) - log p(y | baseline), (B, H)."""
        if self.index is None:
            # Centred on the baseline, so that nothing large cancels.
            if isinstance(rows, Tensor) and len(rows) > 1 and rows.stride(0) == 0:
                rows = slice(int(rows[0]), int(rows[0]) + 1)
            residual = y - self.location[rows]
            slope, offset = self.slope[rows], self.middle[rows] - self.location[rows][:, None]
            missing = torch.isnan(residual)
            here = (~missing).to(y.dtype)
            linear = torch.einsum("be,bhe->bh", torch.where(missing, 0.0, residual), slope)
            return linear - torch.einsum("be,bhe->bh", here, slope * offset)
        scores = (self.shown(rows, y) - of_rows(self.flat_middle, rows)) * of_rows(self.flat_slope, rows)
        return summed(scores.nan_to_num(0.0, torch.inf, -torch.inf), self.hypotheses)

    def base(self, rows: Rows, y: Tensor) -> Tensor:
        """Return log p(y | baseline), (B,)."""
        scale = of_rows(self.scale, rows)
        standardised = (y - of_rows(self.location, rows)) / scale
        scores = -0.5 * standardised * standardised - scale.log() - 0.9189385332046727
        return scores.nan_to_num(0.0, torch.inf, -torch.inf).sum(-1)

    def sample(self, rows: Tensor, chosen: Tensor, seed: int) -> Tensor:
        """Draw y (R, S, elements), with common random numbers."""
        elements = self.location.shape[-1]
        noise = torch.randn(chosen.shape[1], elements, generator=generator(seed), dtype=self.location.dtype)
        location = self.location[rows][:, None].expand(-1, chosen.shape[1], -1)
        twice = 2 * self.middle[rows[:, None], chosen]
        if self.index is None:
            location = twice - location
        else:
            index = self.index[rows[:, None], chosen]
            location = location.scatter(2, index, twice - location.gather(2, index))
        return location + self.scale[rows][:, None] * noise

    def divergence(self, rows: Tensor) -> Tensor | None:
        """Return half the squared standardised distance of a hypothesis's means from the baseline's, (R, H)."""
        if self.index is None:
            return None
        apart = self.slope[rows] * _at(self.scale[rows], self.index[rows])
        return 0.5 * (apart * apart).sum(-1)

    def own(self, rows: Tensor) -> Tensor | None:
        """Return d' (R, H) where each hypothesis shows in elements that no other one does."""
        half = self.divergence(rows)
        if half is None or self.index is None:
            return None
        # Elements that do not differ fill up the index: each gets a number of its own, which is none of an element.
        fill = torch.arange(self.index[0].numel()).reshape(self.index.shape[1:])
        shown = torch.where(self.slope[rows] != 0, self.index[rows], -1 - fill).flatten(1).sort(1).values
        return None if bool((shown[:, 1:] == shown[:, :-1]).any()) else (2 * half).sqrt()


def _at(values: Tensor, index: Tensor) -> Tensor:
    """values (K, E) at index (K, H, n)."""
    return values.gather(1, index.flatten(1)).reshape(index.shape)
