"""A policy that does the same wherever it is: weights are tied by distance (thesis section 5.5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from apmodels import Grid, ValueOutOfRange
from controllers.policy import Policy, sizes
from controllers.rewards import interest_of
from inference import Engine, Refusal


class ConvolutionalPolicy(Policy):
    """logits = Σ_f K_f ∗ φ_f(b), with kernels K_f(|i - k|) of the distance between cells (thesis section 5.5.3).

    Where kernels meet many cells they are convolved by FFT.

    Args:
        grid: its cells are the actions and the values of the interest alike.
        width: how far a kernel reaches, in cells; over the whole grid by default.
        features: see Policy; the belief itself by default.
        spread: see Policy.
        seed: see Policy.
        spacing: of the distances that have a weight, in cells, from 0 on; between them kernels are straight lines. By
            default each distance between two cells has a weight, as in the thesis; on large grids those are many, and
            few weights are learned with less noise.

    ``weights`` are (F, R), one for each of ``knots`` (R,), in cells; ``kernels`` (F, D), at ``distances`` (D,), follow.
    """

    # Up to so many cells a product of matrices is quicker than FFT.
    DENSE = 500
    distances: Tensor
    knots: Tensor
    lines: Tensor
    lookup: Tensor
    places: Tensor

    def __init__(
        self,
        grid: Grid,
        width: float | None = None,
        features: Sequence[str] = ("belief",),
        spread: float = 0.0,
        seed: int = 0,
        spacing: float | None = None,
    ):
        if spacing is not None and not 0 < spacing < float("inf"):
            raise ValueOutOfRange(f"the distances that have a weight are some way apart, not {spacing} cells")
        if width is not None and not width >= 0:
            raise ValueOutOfRange(f"a kernel is 0 cells wide or more, not {width}")
        squares = _squares(torch.arange(grid.rows), torch.arange(grid.columns))
        reach = float("inf") if width is None else width**2
        tied = torch.unique(squares[squares <= reach])
        distances = tied.to(torch.get_default_dtype()).sqrt()
        knots, lines = _between_knots(distances, spacing)
        super().__init__((len(knots),), features, spread, seed)
        self.grid, self.width, self.spacing = grid, width, spacing
        for name, value in {"distances": distances, "knots": knots, "lines": lines}.items():
            self.register_buffer(name, value, persistent=False)
        # Which weight belongs to offsets (rows, columns); beyond the width one that is always zero.
        lookup = torch.where(squares <= reach, torch.searchsorted(tied, squares), len(tied))
        self.register_buffer("lookup", lookup, persistent=False)
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay the kernel out as forward reads it: cells by cells, or around a circle that is long enough."""
        if self.grid.size <= self.DENSE:
            self.register_buffer("places", between(self.grid, self.lookup), persistent=False)
            return
        from scipy.fft import next_fast_len

        sides = (self.grid.rows, self.grid.columns)
        reach = [n if self.width is None else min(int(self.width) + 1, n) for n in sides]
        self.shape = [int(next_fast_len(n + r - 1) or 0) for n, r in zip(sides, reach, strict=True)]
        padded = torch.full(self.shape, len(self.distances))
        rows, columns = (torch.minimum(torch.arange(n), n - torch.arange(n)) for n in self.shape)
        inside = (rows < reach[0])[:, None] & (columns < reach[1])
        padded[inside] = self.lookup[rows.clamp(max=reach[0] - 1)][:, columns.clamp(max=reach[1] - 1)][inside]
        self.register_buffer("places", padded.flatten(), persistent=False)

    def forward(self, probs: Tensor) -> Tensor:
        """Return the logits of actions, (*batch, N)."""
        kernels = nn.functional.pad(self.kernels, (0, 1)).index_select(1, self.places)
        seen = self.featured(probs)
        if self.grid.size <= self.DENSE:
            return seen.flatten(-2) @ kernels.reshape(-1, self.grid.size)
        images = seen.unflatten(-1, (self.grid.rows, self.grid.columns))
        product = torch.fft.rfft2(images, s=self.shape) * torch.fft.rfft2(kernels.unflatten(1, self.shape))
        whole = torch.fft.irfft2(product.sum(-3), s=self.shape)
        return whole[..., : self.grid.rows, : self.grid.columns].flatten(-2)

    @property
    def kernels(self) -> Tensor:
        """The weights of all distances, (F, D)."""
        return self.weights if self.spacing is None else self.weights @ self.lines

    @property
    def filters(self) -> Tensor:
        """The kernels as images, (F, 2 rows - 1, 2 columns - 1), their centres in the middle."""
        rows, columns = (torch.arange(1 - n, n).abs() for n in self.lookup.shape)
        places = self.lookup[rows][:, columns].to(self.weights.device)
        return nn.functional.pad(self.kernels.detach(), (0, 1))[:, places]

    def about(self) -> dict[str, Any]:
        """Return what it was made with, but for the weights."""
        grid = [self.grid.rows, self.grid.columns]
        made = {"grid": grid, "width": self.width, "spacing": self.spacing}
        return {"states": self.grid.size, "actions": self.grid.size, **made}

    def serves(self, engine: Engine) -> None:
        """Raise Refusal where the action is no cell of the grid, or the interest has other values."""
        states, space = sizes(engine)
        action, interest = engine.model.action_names[0], interest_of(engine)
        if space != self.grid:
            raise Refusal(f"ConvolutionalPolicy looks at the cells of {self.grid}, but {action} is of {space}")
        if not torch.equal(states.double().cpu(), space.values().double().cpu()):
            raise Refusal(
                f"ConvolutionalPolicy needs an interest whose values are the cells of {self.grid}, "
                f"and {interest} has other values"
            )

    def plot(self) -> Any:
        """Return a figure of the kernels: weight by distance, and the filters that they make."""
        import matplotlib.pyplot as plt

        count = len(self.features)
        figure, panels = plt.subplots(1, 1 + count, figsize=(4 + 4 * count, 4), layout="constrained")
        knots, filters = self.knots.cpu().numpy(), self.filters.cpu().numpy()
        for panel, name, weights, image in zip(
            panels[1:], self.features, self.weights.detach().cpu().numpy(), filters, strict=True
        ):
            panels[0].plot(knots, weights, "o-", markersize=3, label=name)
            (rows, columns), most = image.shape, float(abs(image).max())
            box = (-columns / 2, columns / 2, rows / 2, -rows / 2)
            shown = panel.imshow(image, extent=box, cmap="RdBu_r", vmin=-most, vmax=most)
            panel.set(title=name, xlabel="cells", ylabel="cells")
            figure.colorbar(shown, ax=panel, label="weight")
        panels[0].axhline(0, color="grey", linewidth=0.8)
        panels[0].set(xlabel="distance (cells)", ylabel="weight")
        if count > 1:
            panels[0].legend()
        return figure


def between(grid: Grid, lookup: Tensor) -> Tensor:
    """Return which weight lies between any two cells, (size²,), by that of any offset, (rows, columns)."""
    cells = grid.values()
    offset = grid.offset(cells[:, None], cells).abs()
    return lookup[offset[..., 0], offset[..., 1]].flatten()


def _between_knots(distances: Tensor, spacing: float | None) -> tuple[Tensor, Tensor]:
    """Return the distances that have a weight, (R,), and how much each counts at all distances, (R, D)."""
    if spacing is None:
        return distances, torch.empty(0)
    knots = torch.arange(int(torch.ceil(distances.max() / spacing)) + 1).to(distances) * spacing
    return knots, (1 - (distances - knots[:, None]).abs() / spacing).clamp(min=0)


def _squares(rows: Tensor, columns: Tensor) -> Tensor:
    """Return the squared length of offsets (rows, columns), whole numbers: equal ones are equal."""
    return rows[:, None] ** 2 + columns**2
