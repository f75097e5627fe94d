"""The figure of learning to find out whether anybody answers (thesis Fig. 4.6)."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

LABELS = {"best": "best plan", "infomax": "learned", "random": "calling at random", "silent": "never calling"}


def draw(found: xr.Dataset, curves: dict[float, list[tuple[int, float]]], config: Any, thesis: dict[int, int]) -> Any:
    """Draw what is learned by calls, calls by horizon, information and right guesses by step."""
    figure, axes = plt.subplots(2, 2, figsize=(13, 9.4), layout="constrained")
    _shares(axes[0, 0], found, curves, config)
    _powers(axes[0, 1], found, config, thesis)
    _known(axes[1, 0], found, config)
    _right(axes[1, 1], found, config)
    return figure


def _shares(axes: Any, found: xr.Dataset, curves: dict[float, list[tuple[int, float]]], config: Any) -> None:
    for optimism, curve in curves.items():
        done, share = zip(*curve[1:], strict=True)
        axes.plot(done, share, lw=1, label=f"12 steps, optimism {optimism:g}: information")
    for memory in config.memory:
        there = found.sel(memory=memory)
        mean = there.receding_calls.mean("run")
        label = f"{found.step.size} steps, {memory} remembered"
        line = axes.plot(mean, there.receding_reward.mean("run"), "o-", ms=4, label=f"{label}: reward")
        axes.plot(
            mean, there.receding_share.mean("run"), "o:", ms=4, color=line[0].get_color(), label=f"{label}: information"
        )
    axes.axvline(config.calls, color="grey", ls=":")
    axes.axhline(config.share, color="grey", ls=":")
    axes.set(xscale="log", xlim=(min(900, config.calls / 2), 1.5 * config.calls), ylim=(0.8, 1.005))
    axes.set(xlabel="calls since birth", ylabel="share of the best policy's", title="A: learning")
    axes.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)


def _powers(axes: Any, found: xr.Dataset, config: Any, thesis: dict[int, int]) -> None:
    for optimism in found.optimism.values.tolist():
        mean = found.calls.sel(optimism=optimism).mean("run")
        axes.plot(found.horizon, mean, "o-", label=f"optimism {optimism:g}")
    axes.plot(list(thesis), list(thesis.values()), "k^", label="thesis")
    axes.set(xscale="log", yscale="log", xlabel="steps of a trial", ylabel=f"calls to {config.share:.1%}")
    ticks = found.horizon.values.tolist()
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(title="calls needed, by horizon")
    axes.legend()


def _known(axes: Any, found: xr.Dataset, config: Any) -> None:
    steps = np.arange(1, found.step.size + 1)
    axes.plot(steps, found.best_information, label=f"best over {found.step.size} steps")
    for memory in config.memory:
        label = f"{memory} remembered, {config.lookahead} ahead"
        axes.plot(steps, found.receding_information.sel(memory=memory), "--", label=label)
    axes.set(xlabel="step", ylabel="expected information (bits)", title="B: a short memory")
    axes.legend()


def _right(axes: Any, found: xr.Dataset, config: Any) -> None:
    steps = np.arange(1, found.waited.size + 1)
    for name, label in LABELS.items():
        right = found[f"{name}_accuracy"].values
        there = np.flatnonzero(right >= config.accuracy.share)
        reached = f"step {there[0] + 1}" if len(there) else "not reached"
        axes.plot(steps, right, "--" if name == "infomax" else "-", label=f"{label}: {reached}")
    axes.axhline(config.accuracy.share, color="grey", ls=":")
    axes.set(xlabel="step", ylabel="share of right guesses", title=f"C: steps to {config.accuracy.share:.0%}")
    axes.set_ylim(0.48, 1.02)
    axes.legend(title=f"someone answers in {config.accuracy.presence:.0%} of cases")
