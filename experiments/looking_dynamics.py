"""When motors begin to move and how they go on, and looking at what moves (thesis sections 6.6.1 and 6.6.2)."""

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

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from experiments.looking import make_head, size
from experiments.study import Result, remembered
from inference import RaoBlackwell

# Images a second (the thesis's).
RATE = 30.0
# A movement begins when it has gone so much of its way, and has ended when it stays so near to its end.
BEGUN, ENDED = 0.1, 0.1
# A quick look: movements, frames of each.
QUICK = (12, 20)


def dynamics(config: Any, folder: Path, console: Console) -> Result:
    """Learn how motors move, frame by frame; see ``conf/experiment/learning_to_look/dynamics.yaml``."""
    seeds, _ = size(config)
    head = make_head(config.head)
    parts = [watched(config, folder, head, seed) for seed in tracked(range(1 if config.quick else seeds), "seeds")]
    found = xr.concat(parts, "seed")
    true = courses(head, found.sizes["frame"])
    learned, real = course(found.actuation), course(true)
    summary = {}
    for what, measure in (("latency", latency), ("settling", settling), ("recoil", recoil)):
        seen, is_so = measure(learned), measure(real)
        unit = 1.0 if what == "recoil" else 1e3
        name = what if what == "recoil" else f"{what}_error_ms"
        summary[f"{name}{'_error' if what == 'recoil' else ''}"] = float(np.abs(seen - is_so).max()) * unit
        for k in range(head.motors):
            key = f"{what}{'_ms' if unit > 1 else ''}"
            summary[f"motor_{k + 1}.{key}"] = float(seen.isel(motor=k).median()) * unit
            summary[f"motor_{k + 1}.true_{key}"] = float(is_so.isel(motor=k)) * unit
    for k, joint in enumerate(head.joints):
        s = {key.partition(".")[2]: value for key, value in summary.items() if key.startswith(f"motor_{k + 1}.")}
        console.print(
            f"{joint.name}: begins after {s['latency_ms']:.0f} ms ({s['true_latency_ms']:.0f} is true), is there after "
            f"{s['settling_ms']:.0f} ({s['true_settling_ms']:.0f}), having gone {s['recoil']:.0%} too far "
            f"({s['true_recoil']:.0%})"
        )
    console.print(
        f"the largest error of a latency: {summary['latency_error_ms']:.0f} ms ({found.sizes['seed']} seeds, "
        f"{head.motors} motors)"
    )
    datasets = {"dynamics": found, "truth": true.to_dataset(name="actuation")}
    return Result(summary, datasets, {"dynamics": _draw(learned, real, head)})


def watched(config: Any, folder: Path, head: Any, seed: int) -> xr.Dataset:
    """Let a head babble and watch every movement of its own, frame by frame; what a study's folder has is kept.

    Returns:
        ``actuation`` (frame, direction, motor): what a unit of command is believed to have moved what is seen by a
        frame, pixels; ``spread``, its standard deviation; ``moved`` and ``truth`` (movement, frame, direction).
    """
    movements, frames = (config.movements, config.model.frames) if not config.quick else QUICK
    if frames < 2:
        raise ValueOutOfRange(f"a movement is watched for 2 frames or more, not {frames}")
    setting = [OmegaConf.to_yaml(config.head), OmegaConf.to_yaml(config.model), movements, frames, config.reach]
    setting += [config.seed, seed]
    engine: Any = None

    def make() -> xr.Dataset:
        nonlocal engine
        model = instantiate(config.model, motors=head.motors, frames=frames)
        engine = engine or RaoBlackwell(model, particles=1)
        return _watch(head, engine, movements, frames, config.reach, config.seed + seed)

    return remembered(folder, f"watched_{seed}", setting, make)


def _watch(head: Any, engine: Any, movements: int, frames: int, reach: float, seed: int) -> xr.Dataset:
    random = np.random.default_rng(seed)
    head.reset(seed)
    belief = engine.start()
    place, moved, truth = np.zeros(head.motors), [], []
    still = torch.zeros(head.motors)
    belief = engine.update(belief, {"command": still, "begin": torch.tensor(0)}, head.look())
    for _ in tracked(range(movements), "movements"):
        goal = random.uniform(-reach, reach, head.motors)
        command, before = goal - place, head.angles.copy()
        place = goal
        given = torch.as_tensor(command, dtype=torch.float32)
        head.send(command)
        seen, was = [], []
        for frame in range(frames):
            head.wait(1 / RATE)
            begin = torch.tensor(int(frame == 0))
            belief = engine.update(belief, {"command": given, "begin": begin}, head.look())
            seen.append(belief.values["motion"][0, 0].numpy())
            was.append(head.flow(before, head.angles))
        moved.append(np.stack(seen))
        truth.append(np.stack(was))
    law = belief.marginal("actuation")
    by = "frame", "direction", "motor"
    each = "movement", "frame", "direction"
    return xr.Dataset(
        {
            "actuation": (by, law.mean.numpy()),
            "spread": (by, law.variance.sqrt().numpy()),
            "moved": (each, np.stack(moved)),
            "truth": (each, np.stack(truth)),
        },
        coords={"frame": (np.arange(frames) + 1) / RATE, "direction": ["horizontal", "vertical"]},
    )


def courses(head: Any, frames: int) -> xr.DataArray:
    """Return how a unit of each motor alone moves what is seen, from the middle, (frame, direction, motor), pixels."""
    part, found = 0.2, np.zeros((frames, 2, head.motors))
    with head.noiseless():
        for k in range(head.motors):
            head.reset(0)
            before = head.angles.copy()
            head.send(part * np.eye(head.motors)[k])
            for frame in range(frames):
                head.wait(1 / RATE)
                found[frame, :, k] = head.flow(before, head.angles) / part
    times = (np.arange(frames) + 1) / RATE
    return xr.DataArray(
        found,
        dims=("frame", "direction", "motor"),
        coords={"frame": times, "direction": ["horizontal", "vertical"]},
    )


def course(actuation: xr.DataArray) -> xr.DataArray:
    """Return which share of its way a motor has gone, along its own direction, by frame."""
    last = actuation.isel(frame=slice(-3, None)).mean("frame")
    return (actuation * last).sum("direction") / (last**2).sum("direction")


def latency(gone: xr.DataArray) -> xr.DataArray:
    """Return when a tenth of the way has been gone for good, between frames by straight lines, seconds."""
    return _crossing(gone, BEGUN)


def settling(gone: xr.DataArray) -> xr.DataArray:
    """Return when a motor comes to stay near its end, seconds."""
    return xr.apply_ufunc(lambda row: _stays(row, gone.frame.values), gone, input_core_dims=[["frame"]], vectorize=True)


def recoil(gone: xr.DataArray) -> xr.DataArray:
    """Return by which share of its way a motor goes too far."""
    return gone.max("frame") - 1


def _crossing(gone: xr.DataArray, level: float) -> xr.DataArray:
    def first(row: np.ndarray) -> float:
        times = gone.frame.values
        below = np.flatnonzero(row < level)
        # After the last frame below it that comes before the middle of the way is reached.
        half = int(np.argmax(row >= 0.5))
        below = below[below < half]
        if not len(below):
            return float(times[0])
        i = int(below[-1])
        return float(times[i] + (level - row[i]) / (row[i + 1] - row[i]) * (times[i + 1] - times[i]))

    return xr.apply_ufunc(first, gone, input_core_dims=[["frame"]], vectorize=True)


def _stays(row: np.ndarray, times: np.ndarray) -> float:
    far = np.flatnonzero(np.abs(row - 1) > ENDED)
    return float(times[min(far[-1] + 1, len(times) - 1)]) if len(far) else float(times[0])


def _draw(learned: xr.DataArray, real: xr.DataArray, head: Any) -> Any:
    figure, axes = plt.subplots(1, head.motors, figsize=(3.4 * head.motors, 3.2), sharey=True, squeeze=False)
    for k, (axis, joint) in enumerate(zip(axes[0], head.joints, strict=True)):
        for seed in learned.seed:
            line = learned.sel(seed=seed).isel(motor=k)
            axis.plot(1e3 * learned.frame, line, color="C0", lw=1, label="learned" if seed == 0 else None)
        axis.plot(1e3 * real.frame, real.isel(motor=k), color="k", ls=":", label="true")
        axis.set(title=joint.name, xlabel="ms since the command", ylim=(-0.3, 1.6))
    axes[0, 0].set_ylabel("share of the way")
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    return figure
