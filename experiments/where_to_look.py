"""Where to look?  How controllers search, beside each other (thesis sections 5.4 and 5.5)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from hydra.utils import instantiate
from omegaconf import OmegaConf
from rich.console import Console

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from controllers import Constant, EntropyLimit, GreedyInfomax, MostProbable, PercentCorrect, Random, rollout
from experiments.searching import engine_of, error_of, fixations_to, learned, search
from experiments.study import Result, remembered
from hardware import Simulated

# Table 5.1, and the share of its last line.
THESIS = {"learned": 7.86, "percent_correct": 8.96, "most_probable": 9.25, "random": 11.33}
# A quick look learns and tries so often.
QUICK_UPDATES, QUICK_TRIALS = 15, 4


def table_5_1(config: Any, folder: Path, console: Console) -> Result:
    """Count fixations until most searches are right; see ``conf/experiment/where_to_look/table_5_1.yaml``."""
    data, summary = _race(config, folder)
    for name in data.controller.values.tolist():
        found, error = summary[name], summary[f"{name}.se"]
        beside = f" (thesis {THESIS[name]})" if name in THESIS else ""
        console.print(
            f"{name:16} {found:6.2f} ± {error:.2f} fixations{beside}, {summary[f'{name}.ms']:.3g} ms a decision"
            if np.isfinite(found)
            else f"{name:16} does not get there in {data.fixation.size} fixations{beside}"
        )
    console.print(
        f"learned in {summary['learning_seconds']:.0f} s; in the same trials percent_correct needs "
        f"{summary['percent_correct.later']:+.2f} ± {summary['percent_correct.later.se']:.2f} fixations more, and "
        f"{summary['percent_correct.ms'] / summary['learned.ms']:,.0f} times as long for a decision"
    )
    return Result(summary, {"table_5_1": data}, {"table_5_1": _bars(data, summary)})


def curves(config: Any, folder: Path, console: Console) -> Result:
    """Draw how many searches are right after every fixation; see ``conf/experiment/where_to_look/curves.yaml``."""
    data, summary = _race(config, folder)
    best = data.correct.mean("trial")
    ahead = (data.correct.sel(controller="learned") - data.correct.sel(controller="percent_correct")).values
    lead, at = ahead.mean(0), int(np.abs(ahead.mean(0)).argmax())
    error = float(ahead[:, at].std()) / len(ahead) ** 0.5
    summary |= {"lead": float(lead[at]), "lead.se": error, "lead_at": at + 1.0}
    for name in data.controller.values.tolist():
        shares = ", ".join(f"{float(best.sel(controller=name, fixation=t)):.2f}" for t in (1, 2, 4, 8, 12))
        console.print(f"{name:16} right after 1, 2, 4, 8, 12 fixations: {shares}")
    console.print(
        f"learned and percent_correct are farthest apart after {at + 1} fixations, by {lead[at]:+.3f} ± {error:.3f}"
    )
    figure, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    for name in data.controller.values.tolist():
        axis.plot(data.fixation, best.sel(controller=name), "o-", ms=3, label=name)
    axis.axhline(config.share, color="grey", ls=":")
    axis.set(xlabel="fixations", ylabel="share of right searches", ylim=(0, 1.01))
    axis.legend()
    return Result(summary, {"curves": data}, {"curves": figure})


def _race(config: Any, folder: Path) -> tuple[xr.Dataset, dict[str, float]]:
    """All controllers in the same trials: shares of right ones, and fixations until enough are."""
    trials = QUICK_TRIALS if config.quick else config.trials
    updates = QUICK_UPDATES if config.quick else config.learning.updates
    if trials < 1 or config.fixations < 12 or not 0 < config.share < 1 or updates < 1:
        raise ValueOutOfRange("where_to_look needs 1 trial, 12 fixations, 1 update and a share in (0, 1), or more")
    model = instantiate(config.model)
    engine = engine_of(model)
    learner, _, seconds = learned(engine, OmegaConf.merge(config.learning, {"updates": updates}), config.seed)
    made = {"learned": learner} | _rivals(engine, config)
    parts = []
    for name in tracked(made, "searching"):
        how = [updates, str(config.learning)] if name == "learned" else config.samples
        setting = [repr(model), trials, config.fixations, how, config.seed]
        make = lambda name=name: search(model, engine, made[name], trials, config.fixations, config.seed + 1)  # noqa: E731
        parts.append(remembered(folder, name, setting, make))
    data = xr.concat(parts, dim="controller").assign_coords(controller=list(made))
    summary: dict[str, float] = {f"thesis.{name}": value for name, value in THESIS.items()}
    for name in made:
        part = data.sel(controller=name)
        summary[name] = fixations_to(part.correct.values, config.share)
        summary[f"{name}.se"] = error_of(part.correct.values, config.share)
        summary[f"{name}.ms"] = float(part.seconds.mean()) * 1e3 / data.trial.size
        if name != "learned":
            best = data.correct.sel(controller="learned").values
            summary[f"{name}.later"] = summary[name] - summary["learned"]
            summary[f"{name}.later.se"] = error_of(part.correct.values, config.share, best)
    summary["learning_seconds"] = seconds
    return data, summary


def _rivals(engine: Any, config: Any) -> dict[str, Any]:
    grid = engine.model.grid
    return {
        "percent_correct": PercentCorrect(engine, samples=config.samples),
        "greedy_infomax": GreedyInfomax(engine, samples=config.samples),
        "entropy_limit": EntropyLimit(engine),
        "most_probable": MostProbable(engine),
        "random": Random(engine),
        "constant": Constant(engine, int(grid.cell(grid.rows // 2, grid.columns // 2))),
    }


def _bars(data: xr.Dataset, summary: dict[str, float]) -> Any:
    names = [name for name in data.controller.values.tolist() if np.isfinite(summary[name])]
    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    axis.barh(
        names[::-1], [summary[n] for n in names[::-1]], xerr=[summary[f"{n}.se"] for n in names[::-1]], color="C0"
    )
    theirs = [(THESIS[name], len(names) - 1 - i) for i, name in enumerate(names) if name in THESIS]
    axis.plot([x for x, _ in theirs], [y for _, y in theirs], "k|", ms=18, mew=2, label="thesis")
    axis.set(xlabel="fixations until most searches are right")
    axis.legend()
    return figure


def search_one(config: Any, folder: Path, console: Console) -> Result:
    """Search once, and show every step; see ``conf/experiment/where_to_look/search.yaml``."""
    if config.fixations < 1:
        raise ValueOutOfRange("search needs 1 fixation or more")
    model = instantiate(config.model)
    engine = engine_of(model)
    controller = instantiate(config.controller)(engine)
    data = rollout(Simulated(model), engine, controller, config.fixations, seed=config.seed).isel(episode=0)
    target = int(data.truth_target[-1])
    sure = data.marginal.values[:, target]
    for step, (look, chance) in enumerate(zip(data.fixation.values, sure, strict=True), 1):
        row, column = divmod(int(look), model.grid.columns)
        console.print(f"fixation {step}: row {row}, column {column}; P(target's cell) = {chance:.3f}")
    summary = {"target": float(target), "sure": float(sure[-1]), "fixations": float(config.fixations)}
    return Result(summary, {"search": data}, {"search": _panels(data, model, target)})


def _panels(data: xr.Dataset, model: Any, target: int) -> Any:
    import torch

    grid, steps = model.grid, data.time.size
    figure, axes = plt.subplots(4, steps, figsize=(2.1 * steps, 8.4), squeeze=False, layout="constrained")
    titles = ("signal", "signal + noise", "likelihood", "belief")
    cells = torch.arange(grid.size)
    for step in range(steps):
        look, glimpse = int(data.fixation[step]), data.glimpse.values[step]
        signal = model.acuity(grid.distance(cells, torch.tensor(look))).numpy()
        images = (
            signal * (np.arange(grid.size) == target),
            glimpse,
            np.exp(signal * (glimpse - signal / 2)),
            data.marginal.values[step],
        )
        for row, (image, title) in enumerate(zip(images, titles, strict=True)):
            axis = axes[row, step]
            axis.imshow(image.reshape(grid.rows, grid.columns), cmap="magma" if row == 3 else "gray")
            axis.plot(look % grid.columns, look // grid.columns, "o", mfc="none", mec="C0", ms=9)
            axis.plot(target % grid.columns, target // grid.columns, "s", mfc="none", mec="C1", ms=11)
            axis.set(xticks=[], yticks=[])
            if not step:
                axis.set_ylabel(title)
        axes[0, step].set_title(f"fixation {step + 1}")
    figure.supxlabel("circle: where it looks; square: where the target is")
    return figure
