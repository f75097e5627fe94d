"""Which motors can be relied upon, and how then best to look (thesis section 6.6.5, Fig. 6.12, Table 6.2)."""

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
from rich.table import Table

import inference
from apmodels import MotorErrors, NoisyMotors, ValueOutOfRange
from apmodels.progress import tracked
from controllers.gaze_shift import gaze_shift
from experiments.looking import RIGHT, astray, learn, make_head, size
from experiments.study import Result, remembered
from inference import Kalman, RaoBlackwell

# What the thesis's Einstein makes of his motors (Table 6.2), %: eyes left/right, head left/right, eyes up/down, upper
# nod, lower nod.
THESIS = {"horizontal": (2.4, 96.8, 0.0, 0.3, 0.0), "vertical": (0.0, -0.3, 1.3, 3.4, 95.5)}
# A quick look: movements.
QUICK = 40
# While motors themselves are learned, errors tell little of their noise: so large a part of the movements is left out.
WARM = 0.2


def noise(config: Any, folder: Path, console: Console) -> Result:
    """Learn how far motors stray; see ``conf/experiment/learning_to_look/noise.yaml``."""
    seeds, movements = size(config)
    seeds, movements = (1, QUICK) if config.quick else (seeds, movements)
    if not config.slip > 0:
        raise ValueOutOfRange(f"a movement strays by more than 0 pixels, not {config.slip}")
    head = make_head(config.head)
    engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=1)
    parts: list[xr.Dataset] = []
    for seed in tracked(range(seeds), "seeds"):
        setting = [OmegaConf.to_yaml(config.head), OmegaConf.to_yaml(config.model), movements, config.reach, seed]
        setting += [config.seed, config.slip]
        make = lambda s=seed: _learned(config, head, engine, movements, s)  # noqa: E731
        parts.append(remembered(folder, f"noise_{seed}", setting, make))
    found = xr.concat(parts, "seed")
    summary: dict[str, float] = {}
    shares = {}
    for how in ("true", "kalman", "fitted"):
        straying = found[how]
        wrong = np.sqrt(((straying - found.true) ** 2).sum(("direction", "motor")) / (found.true**2).sum())
        if how != "true":
            summary[f"noise_error.{how}"] = float((wrong * len(found.seed) ** 0.5).median())
        shares[how] = np.median([_shares(part.best.values, part[how].values) for part in parts], axis=0)
        for d, direction in enumerate(("horizontal", "vertical")):
            for k in range(head.motors):
                summary[f"{how}.{direction}.motor_{k + 1}"] = float(shares[how][d, k])
    for direction, row in THESIS.items():
        summary |= {f"thesis.table_6_2.{direction}.motor_{k + 1}": share / 100 for k, share in enumerate(row)}
    summary["wrong_matches"] = float(np.mean(astray(found)[np.isfinite(astray(found))] > RIGHT))
    _tell(console, head, shares, summary)
    return Result(summary, {"noise": found}, {"noise": _draw(found, head)})


def _learned(config: Any, head: Any, engine: Any, movements: int, seed: int) -> xr.Dataset:
    """Movements that were found, and three accounts of how far motors stray, (direction, motor), pixels a unit."""
    part = learn(head, engine, movements, config.reach, config.seed + seed)
    warm = int(WARM * movements)
    by = ("direction", "motor")
    straying = {
        "true": np.abs(part.best.values) * head.noise,
        "kalman": as_the_thesis(part, warm),
        "fitted": by_evidence(part, config.slip),
    }
    return part.assign({name: (by, value) for name, value in straying.items()})


def as_the_thesis(part: xr.Dataset, warm: int) -> np.ndarray:
    """Return how far motors stray, (direction, motor), by a Kalman filter on |m - Au|, whose mean is made right.

    Args:
        part: what ``learn`` returns.
        warm: how many movements to leave out first.
    """
    model = MotorErrors(motors=part.sizes["motor"])
    engine = Kalman(model)
    belief = engine.start()
    errors = np.abs(part.moved - part.expected).values
    for command, error in zip(part.command.values[warm + 1 :], errors[warm + 1 :], strict=True):
        belief = engine.update(belief, torch.as_tensor(command), torch.as_tensor(error))
    return np.maximum(belief.marginal("straying").mean.numpy(), 0)


def by_evidence(part: xr.Dataset, slip: float) -> np.ndarray:
    """Return how far motors stray, (direction, motor), where it makes the movements that were found most probable."""
    begin = 0.1 * np.abs(part.actuation.values[-1]) + 5.0
    model = NoisyMotors(motors=part.sizes["motor"], slip=slip, straying=torch.as_tensor(begin))
    record = {
        "command": torch.as_tensor(part.command.values[1:]),
        "motion": torch.as_tensor(part.moved.values[1:], dtype=torch.float64),
    }
    return np.abs(np.asarray(inference.fit(model, record, {"straying": "real"}).values["straying"]))


def _shares(actuation: np.ndarray, straying: np.ndarray) -> np.ndarray:
    """What each motor contributes to the best gaze shift in each direction, (direction, motor), of the way it goes."""
    shares = []
    for d in range(2):
        goal = 100.0 * np.eye(2)[d]
        command = gaze_shift(*map(torch.as_tensor, (actuation, straying, goal))).numpy()
        shares.append(actuation[d] * command / (actuation[d] @ command))
    return np.stack(shares)


def _tell(console: Console, head: Any, shares: dict[str, np.ndarray], summary: dict[str, float]) -> None:
    table = Table(title="What each motor contributes to the best gaze shift (Table 6.2)")
    for name in ("", *(joint.name for joint in head.joints)):
        table.add_column(name, justify="right")
    for d, direction in enumerate(("horizontal", "vertical")):
        for how, share in shares.items():
            about = {"true": "truth", "kalman": "as the thesis learns", "fitted": "by evidence"}[how]
            table.add_row(f"{direction}, {about}", *(f"{value:.1%}" for value in share[d]))
        table.add_row(f"{direction}, the thesis's Einstein", *(f"{value:.1f}%" for value in THESIS[direction]))
    console.print(table)
    console.print(
        f"noise that is learned is off by {summary['noise_error.kalman']:.0%} as the thesis learns it, by "
        f"{summary['noise_error.fitted']:.0%} by evidence (medians)"
    )


def _draw(found: xr.Dataset, head: Any) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4), sharey=True, layout="constrained")
    names = [joint.name for joint in head.joints]
    for axis, direction in zip(axes, ("horizontal", "vertical"), strict=True):
        for i, (how, label) in enumerate(
            (("true", "true"), ("kalman", "learned as in the thesis"), ("fitted", "learned by evidence"))
        ):
            value = found[how].sel(direction=direction).transpose("seed", "motor").values
            place = np.arange(len(names)) + 0.27 * (i - 1)
            axis.bar(place, np.median(value, 0), 0.25, label=label, color=f"C{i}")
            axis.plot(place, value.T, "k.", ms=3)
        axis.set_xticks(range(len(names)), names, rotation=20)
        axis.set(title=f"{direction} noise", ylabel="pixels a unit of command (s.d.)")
    axes[0].legend(fontsize=8)
    return figure
