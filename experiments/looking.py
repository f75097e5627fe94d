"""Learning to look: a head finds out how its own motors work (thesis sections 6.5 and 6.6)."""

from __future__ import annotations

import time
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
from controllers.gaze_shift import gaze_shift
from experiments import data
from experiments.study import Result, remembered
from inference import RaoBlackwell

# A quick look: seeds, movements.
QUICK = (2, 25)
# What counts as known.
KNOWN = 0.02
# Targets looked at after learning.
FIXATIONS = 50


def two_motors(config: Any, folder: Path, console: Console) -> Result:
    """Learn two motors; see ``conf/experiment/learning_to_look/two_motors.yaml``."""
    seeds, movements = QUICK if config.quick else (config.seeds, config.movements)
    if seeds < 1 or movements < 2 or not 0 < config.reach <= 0.5 or not config.heads:
        # From one end to the other is a command of twice the reach, and none is larger than 1.
        raise ValueOutOfRange("two_motors needs a head, 1 seed, 2 movements, or more, and a reach in (0, 0.5]")
    panorama = data.files("panorama", "*.jpg")[0]
    summary: dict[str, float] = {}
    found = {}
    for name, settings in config.heads.items():
        head = instantiate(settings, panorama=str(panorama))
        engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=1)
        parts = []
        for seed in tracked(range(seeds), f"{name} learns"):
            setting = [OmegaConf.to_yaml(settings), OmegaConf.to_yaml(config.model), movements, config.reach, seed]
            make = lambda h=head, e=engine, s=seed: learn(h, e, movements, config.reach, config.seed + s)  # noqa: E731
            parts.append(remembered(folder, f"{name}_{seed}", setting, make))
        found[name] = xr.concat(parts, "seed")
        summary |= _summary(name, found[name])
        _tell(console, name, summary)
    summary["fixation_error"] = max(summary[f"{name}.fixation_error"] for name in found)
    return Result(summary, dict(found), {"two_motors": _draw(found)})


def learn(head: Any, engine: Any, movements: int, reach: float, seed: int) -> xr.Dataset:
    """Let a head babble, and learn from what it sees how its motors move it.

    Args:
        head: a body with ``turn``, ``look``, ``flow``, ``angles`` and ``motors``.
        engine: of a ``LearningToLook``: what the head believes of itself.
        movements: how many.
        reach: how far from where it began any motor goes, in units.
        seed: of the commands, and of the head.

    Returns:
        By ``movement``: ``command``, ``moved`` (what was found; ``truth``: what really was), ``actuation`` (its mean),
        ``spread`` (its standard deviation), ``seconds``; ``best``, what least squares make of the true movements; and
        ``missed``, by ``fixation``: how far from the middle a target comes that is looked at after learning, as a share
        of the image's width, without the motors' own noise.
    """
    random = np.random.default_rng(seed)
    belief = engine.start()
    head.reset(seed)
    place = np.zeros(head.motors)
    commands, moved, truth, actuation, spread, seconds = [], [], [], [], [], []
    for movement in range(movements + 1):
        # The first look is where it is.
        goal = random.uniform(-reach, reach, head.motors) if movement else place
        command, before = goal - place, head.angles.copy()
        place = goal
        image = head.step(command)
        begin = time.perf_counter()
        belief = engine.update(belief, torch.as_tensor(command, dtype=torch.float32), image)
        seconds.append(time.perf_counter() - begin)
        law = belief.marginal("actuation")
        commands.append(command)
        moved.append(belief.values["motion"][0, 0].numpy())
        truth.append(head.flow(before, head.angles))
        actuation.append(law.mean.numpy())
        spread.append(law.variance.sqrt().numpy())
    missed = _fixations(head, actuation[-1], random)
    u, m = np.stack(commands)[1:], np.stack(truth)[1:]
    seen = np.isfinite(m).all(1)
    best = np.linalg.lstsq(u[seen], m[seen], rcond=None)[0].T
    by = "movement", "direction", "motor"
    return xr.Dataset(
        {
            "command": (("movement", "motor"), np.stack(commands)),
            "moved": (("movement", "direction"), np.stack(moved)),
            "truth": (("movement", "direction"), np.stack(truth)),
            "actuation": (by, np.stack(actuation)),
            "spread": (by, np.stack(spread)),
            "seconds": ("movement", seconds),
            "best": (("direction", "motor"), best),
            "missed": ("fixation", missed),
        },
        coords={"movement": np.arange(movements + 1), "direction": ["horizontal", "vertical"]},
    )


def _fixations(head: Any, actuation: np.ndarray, random: np.random.Generator) -> list[float]:
    """Look at things that are seen anywhere in the image, from the middle of all that can be seen."""
    half, missed = (np.array(head.size[::-1]) - 1) / 2, []
    middle = np.zeros_like(head.angles)
    with head.noiseless():
        for _ in range(FIXATIONS):
            head.angles = middle
            target = random.uniform(-0.9, 0.9, 2) * half
            # What is to be seen in the middle must move there.
            command = gaze_shift(torch.as_tensor(actuation), torch.zeros(actuation.shape), torch.as_tensor(-target))
            head.turn(command.numpy())
            missed.append(float(np.hypot(*head.follow(target, middle, head.angles))) / head.size[1])
    return missed


def off(learned: xr.Dataset) -> xr.DataArray:
    """Return how far what is believed is from the truth, as a share of it, by movement."""
    wrong = np.sqrt(((learned.actuation - learned.best) ** 2).sum(("direction", "motor")))
    return wrong / np.sqrt((learned.best**2).sum(("direction", "motor")))


def first_within(wrong: np.ndarray, share: float) -> float:
    """Return after how many movements an error (movements,) is first within a share; NaN if never."""
    within = np.flatnonzero(wrong <= share)
    return float(within[0]) if len(within) else np.nan


def _summary(name: str, learned: xr.Dataset) -> dict[str, float]:
    wrong = off(learned)
    counts = np.array([first_within(wrong.sel(seed=s).values, KNOWN) for s in learned.seed])
    # The image where a movement was never seen before lies outside the last one; there nothing true is known of it.
    astray = np.abs(learned.moved - learned.truth).max("direction").values[:, 1:]
    return {
        f"{name}.movements": float(np.median(np.where(np.isnan(counts), np.inf, counts))),
        f"{name}.movements_worst": float(np.max(np.where(np.isnan(counts), np.inf, counts))),
        f"{name}.last_error": float(wrong.isel(movement=-1).max()),
        f"{name}.last_error_median": float(wrong.isel(movement=-1).median()),
        f"{name}.wrong_matches": float(np.mean(astray[np.isfinite(astray)] > 10)),
        f"{name}.fixation_error": float(learned.missed.median()),
        f"{name}.step_ms": float(learned.seconds.isel(movement=slice(1, None)).median()) * 1e3,
    }


def _tell(console: Console, name: str, summary: dict[str, float]) -> None:
    s = {key.partition(".")[2]: value for key, value in summary.items() if key.startswith(f"{name}.")}
    console.print(
        f"{name}: within 2 % of the truth first after {s['movements']:.0f} movements (median; worst "
        f"{s['movements_worst']:.0f}); in the end {s['last_error_median']:.2%} (median; worst {s['last_error']:.2%}); "
        f"{s['wrong_matches']:.1%} of movements matched wrongly; what is looked at then comes within "
        f"{s['fixation_error']:.2%} of the image's width (median); {s['step_ms']:.0f} ms a step"
    )


def _draw(found: dict[str, xr.Dataset]) -> Any:
    figure, axes = plt.subplots(2, len(found), figsize=(5 * len(found), 7), squeeze=False, layout="constrained")
    for (above, below), (name, learned) in zip(axes.T, found.items(), strict=True):
        one = learned.isel(seed=0)
        for d, direction in enumerate(one.direction.values):
            for k in range(one.sizes["motor"]):
                colour = f"C{2 * d + k}"
                mean, spread = (one[v].isel(direction=d, motor=k) for v in ("actuation", "spread"))
                above.plot(one.movement, mean, color=colour, label=f"motor {k + 1}, {direction}")
                above.fill_between(one.movement, mean - 2 * spread, mean + 2 * spread, color=colour, alpha=0.2)
                above.axhline(float(one.best.isel(direction=d, motor=k)), color=colour, ls=":")
        above.set(title=name, xlabel="movements", ylabel="pixels a unit of command")
        above.set_ylim(1.6 * float(one.best.min()), 1.6 * float(max(one.best.max(), -0.3 * one.best.min())))
        above.legend(fontsize=8)
        below.plot(learned.movement, 100 * off(learned).T, color="0.75", lw=0.8)
        below.plot(learned.movement, 100 * off(learned).median("seed"), color="C0")
        below.axhline(100 * KNOWN, color="grey", ls=":")
        below.set(xlabel="movements", ylabel="error of the gains (%)", yscale="log")
    return figure
