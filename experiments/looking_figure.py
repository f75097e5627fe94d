"""Figures of learning to look (thesis Figs 6.5, 6.6, 6.8 and 6.9)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr


def draw_motors(found: dict[str, xr.Dataset], off: Callable[[xr.Dataset], xr.DataArray], known: float) -> Any:
    """Gains, their error, how far movements end from where they were expected, and how probable images are."""
    figure, axes = plt.subplots(4, len(found), figsize=(5.5 * len(found), 12), squeeze=False, layout="constrained")
    for column, (name, learned) in zip(axes.T, found.items(), strict=True):
        _gains(column[0], name, learned)
        column[1].plot(learned.movement, 100 * off(learned).transpose("movement", "seed"), color="0.75", lw=0.8)
        column[1].plot(learned.movement, 100 * off(learned).median("seed"), color="C0", label="median")
        column[1].axhline(100 * known, color="grey", ls=":", label=f"{known:.0%}")
        column[1].set(ylabel="error of the gains (%)", yscale="log")
        column[1].legend(fontsize=8)
        apart = np.hypot(*(learned.moved - learned.expected).transpose("direction", ...).values)
        _spread(column[2], learned.movement[1:], apart[:, 1:])
        column[2].set(ylabel="found from expected (pixels)", yscale="log")
        _spread(column[3], learned.movement[1:], learned.evidence.transpose("seed", "movement").values[:, 1:])
        column[3].set(xlabel="movements", ylabel="log evidence (nats a pixel)")
    return figure


def _gains(axis: Any, name: str, learned: xr.Dataset) -> None:
    one = learned.isel(seed=0)
    colours = plt.get_cmap("tab10")
    for d, direction in enumerate(one.direction.values):
        for k in range(one.sizes["motor"]):
            mean, spread = (one[v].isel(direction=d, motor=k) for v in ("actuation", "spread"))
            axis.plot(one.movement, mean, color=colours(k), ls=("-", "--")[d], label=f"motor {k + 1}, {direction}")
            axis.fill_between(one.movement, mean - 2 * spread, mean + 2 * spread, color=colours(k), alpha=0.15, lw=0)
            axis.axhline(float(one.best.isel(direction=d, motor=k)), color=colours(k), ls=":", lw=0.8)
    axis.set(title=f"{name} (gains: seed 0)", ylabel="pixels a unit (dotted: true)")
    axis.set_ylim(1.6 * float(one.best.min()) - 50, 1.6 * float(max(one.best.max(), 0)) + 50)
    axis.legend(fontsize=7, ncols=2)


def _spread(axis: Any, across: Any, values: np.ndarray) -> None:
    low, middle, high = np.nanquantile(values, [0.1, 0.5, 0.9], axis=0)
    axis.plot(across, middle, color="C0")
    axis.fill_between(across, low, high, color="C0", alpha=0.2, lw=0, label="10 to 90 % of seeds")
    axis.legend(fontsize=8)


def draw_scenes(seen: dict[str, xr.Dataset]) -> Any:
    """What each head remembers of the scene, as it goes on (Fig. 6.6)."""
    kept = max(part.sizes["kept"] for part in seen.values())
    figure, axes = plt.subplots(kept, len(seen), figsize=(4.6 * len(seen), 3.4 * kept), squeeze=False)
    for column, (name, part) in zip(axes.T, seen.items(), strict=True):
        for axis, at in zip(column, part.kept.values, strict=True):
            axis.imshow(part.scene.sel(kept=at), cmap="gray", vmin=0, vmax=255)
            axis.set(title=f"{name}, after {at} movements", xticks=[], yticks=[])
    figure.tight_layout()
    return figure


def draw_gains(found: dict[str, xr.Dataset]) -> Any:
    """How much each motor contributes to movements in each direction (Figs 6.8 and 6.9)."""
    figure, axes = plt.subplots(2, len(found), figsize=(7 * len(found), 6), squeeze=False, layout="constrained")
    for column, (name, learned) in zip(axes.T, found.items(), strict=True):
        for axis, direction in zip(column, learned.direction.values, strict=True):
            gain = np.abs(learned.actuation.sel(direction=direction)).median("seed")
            for k in range(learned.sizes["motor"]):
                line = axis.plot(learned.movement, gain.isel(motor=k), label=f"motor {k + 1}")[0]
                true = float(np.abs(learned.best.sel(direction=direction).isel(motor=k)).median())
                axis.axhline(true, color=line.get_color(), ls=":", lw=0.8)
            axis.set(title=f"{name}, {direction} gain", ylabel="pixels a unit (median; dotted: true)")
            axis.legend(fontsize=8)
        column[-1].set_xlabel("movements")
    return figure
