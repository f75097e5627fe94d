"""The figure of a head's check."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure


def draw(movements: Any, names: list[int]) -> Figure:
    """Return a figure of each motor's images before, after and back, with an arrow of how far what is seen moved."""
    figure = Figure(figsize=(10.5, 3.1 * len(movements)), layout="constrained")
    axes = figure.subplots(len(movements), 3, squeeze=False)
    for row, name, movement in zip(axes, names, movements, strict=True):
        rows, columns = movement.images[0].shape
        titles = f"motor {name}", f"after {movement.command:+.2f} units", "and back"
        for panel, image, title in zip(row, movement.images, titles, strict=True):
            panel.imshow(image, cmap="gray", vmin=0, vmax=1)
            panel.set(title=title, xticks=[], yticks=[])
        middle = ((columns - 1) / 2, (rows - 1) / 2)
        end = middle[0] + movement.pixels[0], middle[1] + movement.pixels[1]
        row[1].annotate("", end, middle, arrowprops={"color": "C1", "width": 2, "headwidth": 8, "headlength": 8})
        row[0].set_ylabel(movement.verdict, wrap=True, fontsize=8)
    return figure
