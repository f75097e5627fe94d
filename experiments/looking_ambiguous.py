"""One guess or many, where one place looks like another: repeated lamp posts (thesis section 6.3, Fig. 6.3)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from hydra.utils import instantiate
from omegaconf import OmegaConf
from rich.console import Console

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from experiments import data
from experiments.looking import learn, off, size
from experiments.study import Result, remembered
from hardware import read_photo
from inference import RaoBlackwell
from inference.rao_blackwell import DepletionWarning

# A quick look: movements.
QUICK = 8


def lamp_posts(config: Any, folder: Path, console: Console) -> Result:
    """Learn where the scene repeats itself; see ``conf/experiment/learning_to_look/lamp_posts.yaml``."""
    seeds, movements = size(config)
    movements = min(movements, QUICK) if config.quick else movements
    if not 1 <= config.repeats <= 72 or not config.particles or not 0 <= config.unlike <= 1:
        raise ValueOutOfRange(
            "a scene repeats itself 1 to 72 times, mixed with a share in [0, 1] of what was there, and particles are "
            f"needed, not {config.repeats}, {config.unlike} and {list(config.particles)}"
        )
    scene = repeated(read_photo(data.files("panorama", "*.jpg")[0]), config.repeats, config.unlike)
    head = instantiate(config.head, panorama=scene)
    found, summary = {}, {}
    for particles in config.particles:
        engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=particles)
        parts = []
        for seed in tracked(range(seeds), f"{particles} particles"):
            setting = [OmegaConf.to_yaml(config.head), OmegaConf.to_yaml(config.model), movements, config.reach]
            setting += [config.repeats, config.unlike, config.seed, seed, particles]
            make = lambda e=engine, s=seed: learn(head, e, movements, config.reach, config.seed + s)  # noqa: E731
            with warnings.catch_warnings():
                # Whether particles are enough is what the study is about.
                warnings.simplefilter("ignore", DepletionWarning)
                parts.append(remembered(folder, f"{particles}_{seed}", setting, make))
        name = f"particles_{particles}"
        found[name] = xr.concat(parts, "seed")
        last = off(found[name]).isel(movement=-1).values
        summary |= {
            f"{name}.right": float(np.mean(last < config.right)),
            f"{name}.last_error": float(np.median(last)),
            f"{name}.step_ms": float(found[name].seconds[..., 1:].median()) * 1e3,
        }
        console.print(
            f"{particles} particles: {summary[f'{name}.right']:.0%} of {seeds} seeds end within {config.right:.0%} of "
            f"the truth (median error {summary[f'{name}.last_error']:.1%}); {summary[f'{name}.step_ms']:.0f} ms a step"
        )
    return Result(summary, found, {"lamp_posts": _draw(found, head, config.right)})


def repeated(panorama: np.ndarray, times: int, unlike: float) -> np.ndarray:
    """Return a panorama of which one strip stands side by side, mixed with so much of what was there."""
    grey = cv2.cvtColor(cv2.resize(panorama, (2400, 1200), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    wide = grey.shape[1] // times
    strip = grey[:, :wide]
    tiled = np.tile(strip, (1, times + 1))[:, : grey.shape[1]]
    return cv2.addWeighted(tiled, 1 - unlike, grey, unlike, 0.0)


def _draw(found: dict[str, xr.Dataset], head: Any, right: float) -> Any:
    figure, axes = plt.subplots(1, len(found) + 1, figsize=(5 * (len(found) + 1), 4), layout="constrained")
    head.reset(0)
    axes[0].imshow(head.render(np.zeros(2)), cmap="gray", vmin=0, vmax=1)
    axes[0].set(title="what it sees", xticks=[], yticks=[])
    for axis, (name, part) in zip(axes[1:], found.items(), strict=True):
        wrong = 100 * off(part).transpose("movement", "seed")
        axis.plot(part.movement, wrong, color="0.75", lw=0.8)
        axis.plot(part.movement, wrong.median("seed"), color="C0")
        axis.axhline(100 * right, color="grey", ls=":")
        axis.set(title=name.replace("_", ": "), xlabel="movements", ylabel="error of the gains (%)", yscale="log")
    return figure
