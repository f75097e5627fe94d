"""Where looking ahead pays: tree search beside the greedy controller (thesis section 1.1's dilemma)."""

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
from controllers import GreedyInfomax, TreeSearch, rollout
from experiments.study import Result, remembered
from hardware import Simulated
from inference import choose

QUICK_EPISODES = 8


def looking_ahead(config: Any, folder: Path, console: Console) -> Result:
    """Compare both in worlds; see ``conf/experiment/where_to_look/looking_ahead.yaml``."""
    if not config.worlds or any(w.steps < 1 or w.episodes < 2 for w in config.worlds.values()):
        raise ValueOutOfRange("looking_ahead needs a world or more, with 1 step and 2 episodes or more in each")
    found, summary = {}, {}
    for name, world in tracked(config.worlds.items(), "searching"):
        episodes = QUICK_EPISODES if config.quick else world.episodes
        setting = [OmegaConf.to_yaml(world), episodes, config.seed]
        data = remembered(folder, name, setting, lambda w=world, n=episodes: _both(w, n, config.seed))
        found[name] = data
        summary |= _compared(console, name, data)
    return Result(summary, dict(found), {"looking_ahead": _draw(found)})


def _both(world: Any, episodes: int, seed: int) -> xr.Dataset:
    """Entropies, nats, (controller, episode, time), in the same episodes, and seconds of a choice (controller)."""
    model = instantiate(world.model)
    engine = choose(model)
    made = {"greedy": GreedyInfomax(engine), "ahead": TreeSearch(engine, **world.search)}
    parts = [rollout(Simulated(model, episodes), engine, c, world.steps, seed=seed) for c in made.values()]
    both = xr.concat([part[["entropy", "act_seconds"]] for part in parts], "controller")
    return both.assign_coords(controller=list(made))


def _compared(console: Console, name: str, data: xr.Dataset) -> dict[str, float]:
    """How much less is unknown with looking ahead, nats: in the mean over steps, and at the end."""
    less = data.entropy.sel(controller="greedy") - data.entropy.sel(controller="ahead")
    figures = {}
    for key, values in {"gain": less.mean("time").values, "last.gain": less.isel(time=-1).values}.items():
        error = float(values.std(ddof=1)) / len(values) ** 0.5
        figures |= {f"{name}.{key}": float(values.mean()), f"{name}.{key}.se": error}
        figures[f"{name}.{key}.z"] = float(values.mean()) / error if error else 0.0
    seconds = data.act_seconds.mean("time")
    figures[f"{name}.ms"] = float(seconds.sel(controller="ahead")) * 1e3 / less.sizes["episode"]
    console.print(
        f"{name}: {figures[f'{name}.gain']:.3f} ± {figures[f'{name}.gain.se']:.3f} nats less are unknown in the mean "
        f"(z = {figures[f'{name}.gain.z']:.1f}), {figures[f'{name}.last.gain']:.3f} ± "
        f"{figures[f'{name}.last.gain.se']:.3f} at the end, for {figures[f'{name}.ms']:.3g} ms a choice"
    )
    return figures


def _draw(found: dict[str, xr.Dataset]) -> Any:
    figure, axes = plt.subplots(1, len(found), figsize=(3.4 * len(found), 3.4), squeeze=False, layout="constrained")
    for axis, (name, data) in zip(axes[0], found.items(), strict=True):
        steps = np.arange(1, data.sizes["time"] + 1)
        for controller in data.controller.values.tolist():
            values = data.entropy.sel(controller=controller)
            mean, error = values.mean("episode"), values.std("episode") / values.sizes["episode"] ** 0.5
            axis.fill_between(steps, mean - 2 * error, mean + 2 * error, alpha=0.2)
            axis.plot(steps, mean, label=controller)
        axis.set(title=name, xlabel="step", ylim=(0, None))
    axes[0, 0].set_ylabel("uncertainty (nats)")
    axes[0, 0].legend()
    return figure
