"""The figure of what becomes of beliefs in worlds that are not as an agent believes."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from experiments.contingency_worlds import BURSTY, World

MARKS = ("C0o", "C4s", "C2D", "C3*", "C1<", "C1>", "C5^", "C6v")


def draw(data: xr.Dataset, worlds: list[World]) -> Any:
    """Return the courses of beliefs, and below them decisions, surprises and calls by world."""
    rows = 0.27 * len(worlds)
    figure = plt.figure(figsize=(14, 4.5 + rows), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[4, rows])
    above, below = parts
    left, right = above.subplots(1, 2, sharey=True)
    _draw_courses(left, data, [w.name for w in worlds if w.truth and not w.name.startswith(BURSTY)])
    _draw_courses(right, data, [w.name for w in worlds if not w.truth])
    left.set(title="somebody is there", ylabel="P(truth), mean of planned sessions")
    right.set(title="nobody is there")
    decisions, surprises, calls = below.subplots(1, 3, sharey=True)
    there = data.sel(rates="fixed").drop_vars("course").mean("episode")
    y = np.arange(len(worlds))
    _draw_decisions(decisions, there.sel(agent="planned"), y)
    for agent, style in zip(data.agent.values.tolist(), cycle(MARKS), strict=False):
        surprises.plot(there.surprise.sel(agent=agent), y, style, ms=5, label=agent)
        calls.plot(there.calls.sel(agent=agent), y, style, ms=5, label=agent)
    surprises.plot(there.entropy.sel(agent="planned"), y, "k|", ms=9, label="planned believes")
    surprises.set(xscale="log", xlabel="−log₂ P(truth) in the end, mean (bits)")
    calls.set(xlabel="calls in a session, mean", xlim=(0, None))
    decisions.set_yticks(y, data.world.values.tolist())
    decisions.set_ylim(len(worlds) - 0.4, -0.6)
    for axis in (decisions, surprises, calls):
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3, fontsize=9)
        axis.grid(axis="y", alpha=0.3)
    return figure


def _draw_courses(axis: Any, data: xr.Dataset, names: list[str]) -> None:
    colours = plt.get_cmap("tab20")
    for i, name in enumerate(names):
        axis.plot(data.time, data.course.sel(world=name, rates="fixed", agent="planned"), color=colours(i), label=name)
    axis.set(xlabel="step", ylim=(-0.02, 1.02))
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=9)


def _draw_decisions(axis: Any, shares: xr.Dataset, y: np.ndarray) -> None:
    left = np.zeros(len(y))
    for name, colour in (("right", "C2"), ("undecided", "lightgrey"), ("wrong", "C3")):
        axis.barh(y, shares[name], left=left, color=colour, label=name)
        left = left + shares[name].values
    axis.plot(shares.in_the_sand, y, "kx", ms=5, clip_on=False, label="head in the sand")
    axis.set(xlabel="share of planned sessions, in the end", xlim=(0, 1))
