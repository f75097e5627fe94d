"""Learning to look: a head finds out how its own motors work (thesis sections 6.5.1 to 6.5.4)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

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
from experiments.looking_figure import draw_gains, draw_motors, draw_scenes
from experiments.study import Result, remembered
from inference import RaoBlackwell

# A quick look: seeds, movements.
QUICK = (2, 25)
# What counts as known.
KNOWN = 0.02
# A match is right if it is so near to the truth, pixels.
RIGHT = 10
# Targets looked at after learning.
FIXATIONS = 50


def two_motors(config: Any, folder: Path, console: Console) -> Result:
    """Learn two motors; see ``conf/experiment/learning_to_look/two_motors.yaml``."""
    at = _kept(config)
    found, summary = learned(config, folder, console)
    summary["fixation_error"] = max(summary[f"{name}.fixation_error"] for name in found)
    seen = {}
    for name, settings in config.heads.items():
        setting = [OmegaConf.to_yaml(settings), OmegaConf.to_yaml(config.model), list(config.scenes), config.seed]
        make = lambda s=settings, n=name: _scenes(config, s, n, at)  # noqa: E731
        seen[name] = remembered(folder, f"scene_{name}", setting, make)
    datasets = {**found, **{f"scene_{name}": part for name, part in seen.items()}}
    return Result(summary, datasets, {"two_motors": draw_motors(found, off, KNOWN), "scene": draw_scenes(seen)})


def einstein(config: Any, folder: Path, console: Console) -> Result:
    """Learn five motors; see ``conf/experiment/learning_to_look/einstein.yaml``."""
    found, summary = learned(config, folder, console)
    name = next(iter(found))
    summary = {key.removeprefix(f"{name}."): value for key, value in summary.items()}
    return Result(summary, dict(found), {"einstein": draw_gains(found), "learning": draw_motors(found, off, KNOWN)})


def phantom_limbs(config: Any, folder: Path, console: Console) -> Result:
    """Learn which motors do nothing; see ``conf/experiment/learning_to_look/phantom_limbs.yaml``."""
    if any(settings.get("phantoms", 0) < 1 for settings in config.heads.values()):
        raise ValueOutOfRange("phantom_limbs needs heads with 1 phantom or more")
    found, summary = learned(config, folder, console)
    name, parts = next(iter(found.items()))
    real = parts.sizes["motor"] - config.heads[name].phantoms
    gain = np.sqrt((parts.actuation**2).sum("direction"))
    true = np.sqrt((parts.best**2).sum("direction")).isel(motor=slice(real)).mean("motor")
    # Of the largest of a head's phantoms.
    share = (gain.isel(motor=slice(real, None)).max("motor") / true).transpose("seed", "movement")
    summary = {key.removeprefix(f"{name}."): value for key, value in summary.items()}
    summary |= {
        "phantom_gain": float(share.isel(movement=-1).max()),
        "phantom_gain_median": float(share.isel(movement=-1).median()),
        "phantom_movements": _median([settled(row, KNOWN) for row in share.values]),
    }
    console.print(
        f"what does nothing is found to do {summary['phantom_gain_median']:.2%} of what a motor does (median; worst "
        f"{summary['phantom_gain']:.2%}), then below {KNOWN:.0%} after {_count(summary['phantom_movements'])} movements"
    )
    figures = {"phantom_limbs": draw_gains(found), "learning": draw_motors(found, off, KNOWN)}
    return Result(summary, dict(found), figures)


def learned(config: Any, folder: Path, console: Console) -> tuple[dict[str, xr.Dataset], dict[str, float]]:
    """Let every head of a study learn with every seed: by head, what ``learn`` returns, and a summary."""
    seeds, movements = size(config)
    summary: dict[str, float] = {}
    found = {}
    for name, settings in config.heads.items():
        head = make_head(settings)
        engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=1)
        parts = []
        for seed in tracked(range(seeds), f"{name} learns"):
            setting = [OmegaConf.to_yaml(settings), OmegaConf.to_yaml(config.model), movements, config.reach, seed]
            setting.append(config.seed)
            make = lambda h=head, e=engine, s=seed: learn(h, e, movements, config.reach, config.seed + s)  # noqa: E731
            parts.append(remembered(folder, f"{name}_{seed}", setting, make))
        found[name] = xr.concat(parts, "seed")
        summary |= _summary(name, found[name])
        _tell(console, name, summary)
    return found, summary


def size(config: Any) -> tuple[int, int]:
    """Return a study's seeds and movements, checked."""
    seeds, movements = (min(a, b) for a, b in zip(QUICK, (config.seeds, config.movements), strict=True))
    if not config.quick:
        seeds, movements = config.seeds, config.movements
    if seeds < 1 or movements < 2 or not 0 < config.reach <= 0.5 or not config.get("heads", True):
        # From one end to the other is a command of twice the reach, and none is larger than 1.
        raise ValueOutOfRange(
            f"a head, 1 seed and 2 movements, or more, and a reach in (0, 0.5] are needed, not {config.seeds} seeds, "
            f"{config.movements} movements and {config.reach}"
        )
    return seeds, movements


def make_head(settings: Any, **more: Any) -> Any:
    """Return the head of a configuration, in the park's panorama."""
    panorama = str(data.files("panorama", "*.jpg")[0])
    if "head" in settings:
        return instantiate(settings, head=make_head(settings.head, **more))
    given = "panorama" if settings["_target_"].endswith("PanoramaHead") else "scene"
    return instantiate(settings, **{given: panorama}, **more)


def learn(
    head: Any,
    engine: Any,
    movements: int,
    reach: float,
    seed: int,
    events: Mapping[int, Callable[[Any], None]] | None = None,
    keep: Sequence[int] = (),
) -> xr.Dataset:
    """Let a head babble, and learn from what it sees how its motors move it.

    Args:
        head: a body with ``turn``, ``look``, ``flow``, ``angles`` and ``motors``.
        engine: of a ``LearningToLook``: what the head believes of itself.
        movements: how many.
        reach: how far from where it began any motor goes, in units.
        seed: of the commands, and of the head.
        events: what befalls the head before a movement, by the movement's number.
        keep: after which movements what it remembers of the scene is kept.

    Returns:
        By ``movement``: ``command``, ``moved`` (what was found; ``truth``: what really was; ``expected``: what had been
        expected), ``actuation`` (its mean), ``spread`` (its standard deviation), ``evidence`` (log p of the image, nats
        a pixel), ``seconds``; ``best``, what least squares make of the true movements; and ``missed``, by ``fixation``:
        how far from the middle a target comes that is looked at after learning, as a share of the image's width,
        without the motors' own noise. ``scene``, (kept, row, column), if it was to be kept.
    """
    random = np.random.default_rng(seed)
    belief = engine.start()
    head.reset(seed)
    place = np.zeros(head.motors)
    found: dict[str, list[Any]] = {name: [] for name in (*BY_MOVEMENT, "scene")}
    actuation = np.zeros((2, head.motors))
    for movement in range(movements + 1):
        if events and movement in events:
            events[movement](head)
        # The first look is where it is.
        goal = random.uniform(-reach, reach, head.motors) if movement else place
        command, before = goal - place, head.angles.copy()
        place = goal
        image = head.step(command)
        begin = time.perf_counter()
        after = engine.update(belief, torch.as_tensor(command, dtype=torch.float32), image)
        seconds = time.perf_counter() - begin
        law = after.marginal("actuation")
        found["expected"].append(actuation @ command)
        found["evidence"].append(float(after.log_evidence - belief.log_evidence) / image.numel())
        belief, actuation = after, law.mean[:, : head.motors].numpy()
        found["seconds"].append(seconds)
        found["command"].append(command)
        found["moved"].append(belief.values["motion"][0, 0].numpy())
        found["truth"].append(head.flow(before, head.angles))
        found["actuation"].append(actuation)
        found["spread"].append(law.variance.sqrt()[:, : head.motors].numpy())
        if movement in keep:
            found["scene"].append(belief.marginal("scene").mean.numpy().astype(np.float32))
    missed = _fixations(head, actuation, random)
    best = by_least_squares(np.stack(found["command"])[1:], np.stack(found["truth"])[1:])
    values: dict[str, Any] = {name: (by, np.stack(found[name])) for name, by in BY_MOVEMENT.items()}
    if found["scene"]:
        values["scene"] = (("kept", "row", "column"), np.stack(found["scene"]))
    return xr.Dataset(
        values | {"best": (("direction", "motor"), best), "missed": ("fixation", missed)},
        coords={"movement": np.arange(movements + 1), "direction": ["horizontal", "vertical"]},
    )


BY_MOVEMENT = {
    "command": ("movement", "motor"),
    "moved": ("movement", "direction"),
    "truth": ("movement", "direction"),
    "expected": ("movement", "direction"),
    "actuation": ("movement", "direction", "motor"),
    "spread": ("movement", "direction", "motor"),
    "evidence": ("movement",),
    "seconds": ("movement",),
}


def by_least_squares(commands: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return what a unit of each motor moves, (2, motors), by commands (n, motors) and true movements (n, 2)."""
    # Of movements after which nothing is seen that was seen before, nothing true is known.
    seen = np.isfinite(truth).all(1)
    return np.linalg.lstsq(commands[seen], truth[seen], rcond=None)[0].T


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


def _kept(config: Any) -> list[int]:
    """After which movements scenes are kept."""
    at = sorted({movement for movement in config.scenes if movement <= QUICK[1] or not config.quick})
    if not at or at[0] < 1:
        raise ValueOutOfRange(f"scenes are kept after 1 movement or more, not {list(config.scenes)}")
    return at


def _scenes(config: Any, settings: Any, name: str, at: list[int]) -> xr.Dataset:
    """What a head remembers of the scene on the way, every second pixel (Fig. 6.6)."""
    head = make_head(settings)
    engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=1)
    part = learn(head, engine, at[-1], config.reach, config.seed, keep=at)
    scene = part.scene[:, ::2, ::2].assign_coords(kept=at)
    return xr.Dataset({"scene": (scene * 255).clip(0, 255).astype(np.uint8)}, attrs={"head": name})


def off(found: xr.Dataset) -> xr.DataArray:
    """Return how far what is believed is from the truth, as a share of it, by movement."""
    wrong = np.sqrt(((found.actuation - found.best) ** 2).sum(("direction", "motor")))
    return wrong / np.sqrt((found.best**2).sum(("direction", "motor")))


def first_within(wrong: np.ndarray, share: float) -> float:
    """Return after how many movements an error (movements,) is first within a share; infinity if never."""
    within = np.flatnonzero(wrong <= share)
    return float(within[0]) if len(within) else np.inf


def settled(wrong: np.ndarray, share: float) -> float:
    """Return after how many movements an error (movements,) stays within a share; infinity if it does not."""
    outside = np.flatnonzero(wrong > share)
    last = outside[-1] + 1 if len(outside) else 0
    return float(last) if last < len(wrong) else np.inf


def astray(found: xr.Dataset) -> np.ndarray:
    """Return how far the movements that were found are from the true ones, pixels, (..., movements); NaN: not known."""
    # The image where a movement was never seen before lies outside the last one; there nothing true is known of it.
    return np.abs(found.moved - found.truth).max("direction", skipna=False).values[..., 1:]


def _median(values: list[float]) -> float:
    return float(np.median(values))


def _count(movements: float) -> str:
    return f"{movements:.0f}" if np.isfinite(movements) else "never"


def _summary(name: str, found: xr.Dataset) -> dict[str, float]:
    wrong = off(found)
    counts = [first_within(wrong.sel(seed=s).values, KNOWN) for s in found.seed]
    far = astray(found)
    return {
        f"{name}.movements": _median(counts),
        f"{name}.movements_worst": float(max(counts)),
        f"{name}.last_error": float(wrong.isel(movement=-1).max()),
        f"{name}.last_error_median": float(wrong.isel(movement=-1).median()),
        f"{name}.wrong_matches": float(np.mean(far[np.isfinite(far)] > RIGHT)),
        f"{name}.fixation_error": float(found.missed.median()),
        f"{name}.step_ms": float(found.seconds.isel(movement=slice(1, None)).median()) * 1e3,
    }


def _tell(console: Console, name: str, summary: dict[str, float]) -> None:
    s = {key.partition(".")[2]: value for key, value in summary.items() if key.startswith(f"{name}.")}
    first, worst = _count(s["movements"]), _count(s["movements_worst"])
    console.print(
        f"{name}: within {KNOWN:.0%} of the truth first after {first} movements (median; worst {worst}); in the end "
        f"{s['last_error_median']:.2%} (median; worst {s['last_error']:.2%}); "
        f"{s['wrong_matches']:.1%} of movements matched wrongly; what is looked at then comes within "
        f"{s['fixation_error']:.2%} of the image's width (median); {s['step_ms']:.0f} ms a step"
    )
