"""The picture of a search: the photograph and its fixations, the belief, and what the last look saw."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

FACE = "#00d0ff"
RIVAL = "#ffb000"
GAZE = "#ff2d78"
# Photographs are drawn no larger than this.
LONGEST = 1600


def draw(search: Any) -> Figure:
    """Return the figure of a finished search (as figures 5.10 and 5.13)."""
    height, width = search.photo.shape[:2]
    tall = min(max(4.6 * height / width, 3.0), 8.0)
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(14.5, tall + 1.1), gridspec_kw={"width_ratios": [1, 1, 1]}, layout="constrained"
    )
    extent = (0, search.grid.columns, search.grid.rows, 0)
    ratio = (height / search.grid.rows) / (width / search.grid.columns)
    for axes, title in ((left, "fixations"), (middle, "belief"), (right, "what the last look saw")):
        axes.set_title(title)
        axes.set_xlabel("column (cells)")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    left.set_ylabel("row (cells)")
    left.imshow(_small(search.photo), extent=extent, aspect=ratio)
    _gaze(left, search)
    _boxes(left, search)
    belief = search.data["marginal"].values[0, -1].reshape(search.grid.rows, search.grid.columns)
    image = middle.imshow(belief, extent=extent, aspect=ratio, cmap="magma", vmin=0, vmax=max(belief.max(), 1e-9))
    figure.colorbar(image, ax=middle, label="probability of the face's cell", shrink=0.8)
    last = search.eye.fixations[-1]
    right.imshow(_small(search.eye.reconstruct(last)), extent=extent, aspect=ratio)
    found = "found" if search.box is not None else "not found"
    figure.suptitle(
        f"face {found}: {search.data.sizes['time']} fixations, {search.milliseconds:.0f} ms"
        + (f" (whole image: {search.rival_milliseconds:.0f} ms)" if np.isfinite(search.rival_milliseconds) else "")
    )
    return figure


def _small(photo: np.ndarray) -> np.ndarray:
    step = max(1, int(np.ceil(max(photo.shape[:2]) / LONGEST)))
    return photo[::step, ::step]


def _gaze(axes: Axes, search: Any) -> None:
    rows, columns = np.divmod(np.array(search.eye.fixations), search.grid.columns)
    axes.plot(columns + 0.5, rows + 0.5, "-", color=GAZE, linewidth=1.2, alpha=0.8)
    numbers: dict[tuple[int, int], list[str]] = {}
    for i, (row, column) in enumerate(zip(rows, columns, strict=True), 1):
        numbers.setdefault((int(row), int(column)), []).append(str(i))
    for (row, column), labels in numbers.items():
        axes.plot(column + 0.5, row + 0.5, "o", markersize=15, color=GAZE, markeredgecolor="white")
        axes.text(
            column + 0.5,
            row + 0.5,
            ",".join(labels),
            color="white",
            ha="center",
            va="center",
            fontsize=8,
            weight="bold",
        )


def _boxes(axes: Axes, search: Any) -> None:
    scale = np.array([search.grid.rows / search.photo.shape[0], search.grid.columns / search.photo.shape[1]])
    for box, colour, label in ((search.rival, RIVAL, "whole image"), (search.box, FACE, "the eye")):
        if box is not None:
            (row, column), (height, width) = box[:2] * scale, box[2:] * scale
            style = "--" if colour == RIVAL else "-"
            axes.add_patch(
                Rectangle((column, row), width, height, fill=False, ec=colour, lw=2.2, ls=style, label=label)
            )
    if search.rival is not None or search.box is not None:
        axes.legend(loc="lower right", fontsize=8)
