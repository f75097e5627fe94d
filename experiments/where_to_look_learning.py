"""Learning where to look: what is learned, how fast, and on what it depends (thesis sections 5.5.3 to 5.5.8)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from omegaconf import OmegaConf
from rich.console import Console

from apmodels import ValueOutOfRange, WanderingSearch
from apmodels.progress import tracked
from controllers import Fixated, Information, LogisticPolicy
from experiments.searching import engine_of, error_of, fixations_to, kernel, learned, search
from experiments.study import Result, remembered

QUICK_UPDATES, QUICK_TRIALS = 12, 2


def _settings(config: Any) -> tuple[Any, int, int]:
    """Settings of learning, runs and trials; fewer for a quick look."""
    if config.runs < 1 or config.trials < 1 or config.learning.updates < 1 or not 0 < config.share < 1:
        raise ValueOutOfRange("where_to_look needs 1 run, 1 trial, 1 update and a share in (0, 1), or more")
    if not config.quick:
        return config.learning, config.runs, config.trials
    quick = {"updates": QUICK_UPDATES, "batch": min(128, config.learning.batch), "steps": 12}
    return OmegaConf.merge(config.learning, quick), 1, QUICK_TRIALS


def _kernels(config: Any, folder: Path, models: dict[str, Any], rewards: dict[str, Any] | None = None) -> xr.Dataset:
    """Kernels that are learned for models, (model, run, distance), and the seconds it took."""
    settings, runs, _ = _settings(config)
    parts = []
    for name, model in tracked(models.items(), "learning"):
        engine = engine_of(model)
        reward = (rewards or {}).get(name)

        def make(model: Any = model, engine: Any = engine, reward: Any = reward) -> xr.Dataset:
            found, seconds = [], []
            for run in range(runs):
                learner, _, took = learned(engine, settings, config.seed + run, reward)
                distances, weights = kernel(learner)
                # A constant added to all weights times a belief changes no policy.
                found.append(weights - weights[-1])
                seconds.append(took)
            return xr.Dataset(
                {"weight": (("run", "distance"), np.stack(found)), "seconds": ("run", seconds)},
                coords={"distance": distances.astype(np.float64)},
            )

        parts.append(remembered(folder, name, [repr(model), str(settings), runs, config.seed, repr(reward)], make))
    return xr.concat(parts, dim="model").assign_coords(model=list(models))


def _shape(data: xr.Dataset, name: str) -> dict[str, float]:
    """Weight at the centre, the largest one, and where that is, with errors over runs."""
    part = data.weight.sel(model=name)
    mean, runs = part.mean("run"), max(1, data.run.size)
    at = int(mean.argmax())
    return {
        "centre": float(mean[0]),
        "centre.se": float(part[:, 0].std()) / runs**0.5,
        "peak": float(mean[at]),
        "peak.se": float(part[:, at].std()) / runs**0.5,
        "peak_at": float(data.distance[at]),
    }


def _shapes(console: Console, data: xr.Dataset) -> dict[str, float]:
    """Tell the shape of every model's kernel, and return them all."""
    summary: dict[str, float] = {}
    for name in data.model.values.tolist():
        shape = _shape(data, name)
        summary |= {f"{name}.{key}": value for key, value in shape.items()}
        _told(console, name, shape)
    return summary


def _draw(data: xr.Dataset, models: dict[str, Any]) -> Any:
    figure, axes = plt.subplots(2, len(models), figsize=(3.6 * len(models), 6), squeeze=False, layout="constrained")
    for (above, below), (name, model) in zip(axes.T, models.items(), strict=True):
        eccentricity = np.linspace(0, float(data.distance.max()), 200)
        above.plot(eccentricity, model.acuity(torch.tensor(eccentricity, dtype=torch.float32)))
        above.set(title=name, ylabel="d'", xlabel="eccentricity (cells)", ylim=(0, None))
        below.plot(data.distance, data.weight.sel(model=name).T, color="0.8", lw=0.8)
        below.plot(data.distance, data.weight.sel(model=name).mean("run"), "o-", ms=3)
        below.axhline(0, color="grey", lw=0.8)
        below.set(xlabel="distance (cells)", ylabel="weight, mean over runs")
    return figure


def _told(console: Console, name: str, shape: dict[str, float]) -> None:
    where = "at the target" if not shape["peak_at"] else f"{shape['peak_at']:.1f} cells beside it"
    console.print(
        f"{name}: weight {shape['centre']:.1f} ± {shape['centre.se']:.1f} at the centre, "
        f"{shape['peak']:.1f} ± {shape['peak.se']:.1f} at most: look {where}"
    )


def kernels(config: Any, folder: Path, console: Console) -> Result:
    """Learn a kernel; see ``conf/experiment/where_to_look/kernel.yaml``."""
    models = {"calibrated": instantiate(config.model)}
    data = _kernels(config, folder, models)
    summary = _shape(data, "calibrated") | {"learning_seconds": float(data.seconds.mean())}
    _told(console, "kernel", summary)
    figure, (line, image) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    mean = data.weight.sel(model="calibrated").mean("run")
    line.plot(data.distance, data.weight.sel(model="calibrated").T, color="0.8", lw=0.8)
    line.plot(data.distance, mean, "o-", ms=3)
    line.axhline(0, color="grey", lw=0.8)
    line.set(xlabel="distance (cells)", ylabel="weight")
    reach = models["calibrated"].grid.rows - 1
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    places = np.searchsorted(data.distance.values, np.hypot(rows, columns) - 1e-6)
    shown = mean.values[places]
    most = float(np.abs(shown).max())
    drawn = image.imshow(shown, cmap="RdBu_r", vmin=-most, vmax=most, extent=(-reach, reach, reach, -reach))
    image.set(xlabel="cells", ylabel="cells")
    figure.colorbar(drawn, ax=image, label="weight")
    return Result(summary, {"kernel": data}, {"kernel": figure})


def large(config: Any, folder: Path, console: Console) -> Result:
    """Learn for information, and for looking at it; see ``conf/experiment/where_to_look/large.yaml``."""
    model = instantiate(config.model)
    engine = engine_of(model)
    settings, _, trials = _settings(config)
    rewards = {"information": Information(), "fixated": Fixated()}
    parts, summary = [], {"thesis.information": 18.0, "thesis.fixated": 20.0}
    for name, reward in tracked(rewards.items(), "learning"):

        def make(reward: Any = reward) -> xr.Dataset:
            learner, _, seconds = learned(engine, settings, config.seed, reward)
            found = search(model, engine, learner, trials, config.fixations, config.seed + 1)
            distances, weights = kernel(learner)
            return found.assign(weight=("distance", weights - weights[-1]), learning=seconds).assign_coords(
                distance=distances.astype(np.float64)
            )

        setting = [repr(model), str(settings), trials, config.fixations, config.seed, repr(reward)]
        parts.append(remembered(folder, name, setting, make))
        summary[name] = fixations_to(parts[-1].correct.values, config.share)
        summary[f"{name}.se"] = error_of(parts[-1].correct.values, config.share)
        theirs = summary[f"thesis.{name}"]
        console.print(f"{name}: {summary[name]:.2f} ± {summary[f'{name}.se']:.2f} fixations (thesis {theirs:g})")
    data = xr.concat(parts, dim="reward").assign_coords(reward=list(rewards))
    summary["learning_seconds"] = float(data.learning.sel(reward="information"))
    console.print(f"learned in {summary['learning_seconds']:.0f} s")
    figure, (line, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for name in rewards:
        line.plot(data.distance, data.weight.sel(reward=name), "o-", ms=3, label=name)
        right.plot(data.fixation, data.correct.sel(reward=name).mean("trial"), label=name)
    line.set(xlabel="distance (cells)", ylabel="weight")
    right.axhline(config.share, color="grey", ls=":")
    right.set(xlabel="fixations", ylabel="share of right searches", ylim=(0, 1.01))
    line.legend()
    return Result(summary, {"large": data}, {"large": figure})


def acuities(config: Any, folder: Path, console: Console) -> Result:
    """Learn with other eyes; see ``conf/experiment/where_to_look/acuities.yaml``."""
    base = instantiate(config.model)
    models = {name: type(base)(grid=base.grid, acuity=instantiate(eye)) for name, eye in config.eyes.items()}
    if not models:
        raise ValueOutOfRange("acuities needs an eye or more: eyes.NAME={_target_: apmodels.Camera}")
    data = _kernels(config, folder, models)
    summary = _shapes(console, data)
    return Result(summary, {"acuities": data}, {"acuities": _draw(data, models)})


def dynamics(config: Any, folder: Path, console: Console) -> Result:
    """Learn where targets wander; see ``conf/experiment/where_to_look/dynamics.yaml``."""
    still = instantiate(config.model)
    models: dict[str, Any] = {"still": still}
    for chance in config.restless:
        models[f"restless_{chance:g}"] = WanderingSearch(grid=still.grid, acuity=still.acuity, restless=chance)
    data = _kernels(config, folder, models)
    summary = _shapes(console, data)
    # The one that wanders least speaks for all: the thesis says that little motion is enough.
    moving = next(name for name in models if name != "still") if len(models) > 1 else None
    summary["moving.peak_at"] = summary[f"{moving}.peak_at"] if moving else np.nan
    return Result(summary, {"dynamics": data}, {"dynamics": _draw(data, models)})


def weight_sharing(config: Any, folder: Path, console: Console) -> Result:
    """Learn with all weights free, and with few; see ``conf/experiment/where_to_look/weight_sharing.yaml``."""
    model = instantiate(config.model)
    engine = engine_of(model)
    settings, _, _ = _settings(config)
    free = OmegaConf.merge(settings, {"updates": config.free_updates, "rate": config.free_rate})
    if config.quick:
        free = OmegaConf.merge(free, {"updates": 2 * QUICK_UPDATES})

    def shared() -> xr.Dataset:
        _, course, _ = learned(engine, settings, config.seed)
        return course.assign(weights=len(_distances(model)))

    def loose() -> xr.Dataset:
        cells = model.grid.size
        _, course, _ = learned(engine, free, config.seed, policy=LogisticPolicy(cells, cells))
        return course.assign(weights=cells**2)

    found = {
        "shared": remembered(folder, "shared", [repr(model), str(settings), config.seed], shared),
        "free": remembered(folder, "free", [repr(model), str(free), config.seed], loose),
    }
    last = {name: float(course.worth[-5:].mean()) / settings.steps for name, course in found.items()}
    summary: dict[str, float] = {}
    for name, course in found.items():
        summary |= {f"{name}.weights": float(course.weights), f"{name}.uncertainty": -last[name]}
        console.print(
            f"{name}: {int(course.weights):,} weights, {-last[name]:.3f} nats unknown in the mean "
            f"after {course.sizes['update'] * settings.batch:,} trials"
        )
    reached = np.flatnonzero(found["shared"].worth.values / settings.steps >= last["free"])
    ratio = found["free"].sizes["update"] / (reached[0] + 1) if len(reached) else np.nan
    summary["trials_over_shared"] = float(ratio)
    console.print(f"tied weights are as good after 1/{ratio:.0f} of the trials")
    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, course in found.items():
        trials = course["update"] * settings.batch
        axis.plot(trials, -course.worth / settings.steps, label=f"{int(course.weights):,} weights ({name})")
    axis.set(xscale="log", xlabel="trials", ylabel="uncertainty, mean over a trial (nats)")
    axis.legend()
    data = xr.Dataset({f"{name}_worth": (f"{name}_update", course.worth.values) for name, course in found.items()})
    return Result(summary, {"weight_sharing": data}, {"weight_sharing": figure})


def _distances(model: Any) -> np.ndarray:
    rows, columns = np.meshgrid(np.arange(model.grid.rows), np.arange(model.grid.columns))
    return np.unique(rows**2 + columns**2)
