"""Learning to look in a world that does not keep still: carried elsewhere, and among people (thesis 6.5.5, 6.5.6)."""

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
from experiments import data
from experiments.looking import KNOWN, RIGHT, astray, first_within, learn, make_head, off, size
from experiments.study import Result, remembered
from hardware import Person, Room
from inference import RaoBlackwell

# A quick look at a kidnapping: after so many movements, and so many more.
QUICK = (15, 10)
# A scene is matched if so many movements on end are.
ON_END = 5


def kidnapped(config: Any, folder: Path, console: Console) -> Result:
    """Carry a head elsewhere while it learns; see ``conf/experiment/learning_to_look/kidnapped.yaml``."""
    seeds, _ = size(config)
    at, after = QUICK if config.quick else (config.kidnapped_after, config.movements - config.kidnapped_after)
    if at < 2 or after < ON_END:
        raise ValueOutOfRange(
            f"a head is carried off after 2 movements or more, and watched for {ON_END} or more, not {at} and {after}"
        )
    if config.photographs < 1:
        raise ValueOutOfRange(f"another room has 1 photograph or more, not {config.photographs}")
    photographs = [str(path) for path in data.scenes()[: config.photographs]]
    elsewhere = Room(photographs)
    head, summary, found = make_head(config.head), {}, {}
    home = head.room
    for name, model in config.models.items():
        engine = RaoBlackwell(instantiate(model, motors=head.motors), particles=1)
        parts = []
        for seed in tracked(range(seeds), f"{name}"):
            setting = [OmegaConf.to_yaml(config.head), OmegaConf.to_yaml(model), at, after, config.reach, seed]
            setting += [config.seed, config.photographs]

            def make(engine: Any = engine, seed: int = seed) -> xr.Dataset:
                head.enter(home)
                carried = {at + 1: lambda body: body.enter(elsewhere)}
                return learn(head, engine, at + after, config.reach, config.seed + seed, carried)

            parts.append(remembered(folder, f"{name}_{seed}", setting, make))
        found[name] = xr.concat(parts, "seed")
        part = _kidnapping(found[name], at)
        summary |= part if name == next(iter(config.models)) else {f"{name}.{key}": part[key] for key in part}
        console.print(
            f"{name}: carried elsewhere, gains are off by {part['worst_gain_error_median']:.1%} at the most "
            f"(median; worst {part['worst_gain_error']:.1%}; before {part['gain_error_before']:.1%}); the "
            f"new scene is matched from the {part['movements_to_match_median']:.0f}. movement on (median; worst "
            f"{part['movements_to_match']:.0f}.)"
        )
    return Result(summary, found, {"kidnapped": _draw_kidnapped(found, at)})


def _kidnapping(found: xr.Dataset, at: int) -> dict[str, float]:
    wrong, far = off(found).transpose("seed", "movement").values, astray(found)
    # A match of which the truth is not known is none that is wrong.
    matches = [first_on_end(~(row[at:] > RIGHT), ON_END) for row in far]
    worst = wrong[:, at:].max(1)
    return {
        "worst_gain_error": float(worst.max()),
        "worst_gain_error_median": float(np.median(worst)),
        "gain_error_before": float(wrong[:, at].max()),
        "movements_to_match": float(max(matches)),
        "movements_to_match_median": float(np.median(matches)),
    }


def first_on_end(right: np.ndarray, count: int) -> float:
    """Return from which (1, 2, ...) on so many are right on end; infinity if never."""
    runs = np.lib.stride_tricks.sliding_window_view(right, count).all(1)
    return float(np.flatnonzero(runs)[0] + 1) if runs.any() else np.inf


def _draw_kidnapped(found: dict[str, xr.Dataset], at: int) -> Any:
    figure, axes = plt.subplots(1, len(found), figsize=(5 * len(found), 4), sharey=True, squeeze=False)
    for axis, (name, learned) in zip(axes[0], found.items(), strict=True):
        wrong = 100 * off(learned).transpose("movement", "seed")
        axis.plot(learned.movement, wrong, color="0.75", lw=0.8)
        axis.plot(learned.movement, wrong.median("seed"), color="C0", label="median")
        axis.axvline(at + 0.5, color="C3", label="kidnapped")
        axis.axhline(5, color="grey", ls=":", label="5 %")
        axis.set(title=name, xlabel="movements", yscale="log")
        axis.legend(fontsize=8)
    axes[0, 0].set_ylabel("error of the gains (%)")
    figure.tight_layout()
    return figure


def crowd(config: Any, folder: Path, console: Console) -> Result:
    """Let a head learn among people; see ``conf/experiment/learning_to_look/crowd.yaml``."""
    seeds, movements = size(config)
    distances = [float(distance) for distance in config.distances]
    if not distances or min(distances) <= 0 or sorted(distances) != distances:
        raise ValueOutOfRange(f"people stand at one distance or more, above 0 and growing, not at {distances}")
    if config.people.count < 1:
        raise ValueOutOfRange(f"a crowd is 1 or more, not {config.people.count}")
    portraits = data.files("tabler", "avatars/*.jpg")
    if config.people.count > len(portraits):
        raise ValueOutOfRange(f"there are {len(portraits)} portraits, too few for {config.people.count} people")
    if len(config.room) != 3 or min(config.room) <= 0 or min(config.people.height, config.people.sway) < 0:
        raise ValueOutOfRange(
            f"a room has a width, a depth and a height, and people a height and a sway, not {list(config.room)}, "
            f"{config.people.height} and {config.people.sway}"
        )
    head = make_head(config.head)
    head.enter(Room(str(data.files("panorama", "*.jpg")[0]), tuple(config.room)))
    if max(distances) > min(config.room[:2]) / 2:
        raise ValueOutOfRange(f"people stand in the room, and not {max(distances):g} m away in {list(config.room)} m")
    engine = RaoBlackwell(instantiate(config.model, motors=head.motors), particles=1)
    parts: list[xr.Dataset] = []
    summary: dict[str, float] = {}
    for distance in tracked(distances, "distances"):
        setting = [OmegaConf.to_yaml(part) for part in (config.head, config.model, config.people)]
        setting += [seeds, movements, config.reach, config.seed, distance, list(config.room)]

        def make(distance: float = distance) -> xr.Dataset:
            learned: list[xr.Dataset] = []
            for seed in range(seeds):
                random = np.random.default_rng([config.seed, seed])
                head.gather(_people(config.people, distance, portraits, random))
                covered = _covered(head)
                part = learn(head, engine, movements, config.reach, config.seed + seed)
                learned.append(part.assign(covered=covered))
            return xr.concat(learned, "seed")

        parts.append(remembered(folder, f"{distance:g}", setting, make))
    found = xr.concat(parts, xr.DataArray(distances, dims="distance", name="distance"))
    for distance in distances:
        part = found.sel(distance=distance)
        wrong, far = off(part), astray(part)
        counts = [first_within(wrong.sel(seed=seed).values, KNOWN) for seed in part.seed]
        summary |= {
            f"{distance:g}m.movements": float(np.median(counts)),
            f"{distance:g}m.last_error": float(wrong.isel(movement=-1).max()),
            f"{distance:g}m.last_error_median": float(wrong.isel(movement=-1).median()),
            f"{distance:g}m.wrong_matches": float(np.mean(far[np.isfinite(far)] > RIGHT)),
            f"{distance:g}m.covered": float(part.covered.mean()),
        }
        console.print(
            f"people {distance:g} m away, over {summary[f'{distance:g}m.covered']:.0%} of the image: in the end off by "
            f"{summary[f'{distance:g}m.last_error_median']:.1%} (median; worst "
            f"{summary[f'{distance:g}m.last_error']:.1%}), {summary[f'{distance:g}m.wrong_matches']:.0%} of movements "
            "matched wrongly"
        )
    # How near, and from there on all is well.
    well = [summary[f"{distance:g}m.last_error"] <= config.well for distance in distances]
    near = [d for i, d in enumerate(distances) if all(well[i:])]
    summary["nearest"] = near[0] if near else np.inf
    return Result(summary, {"crowd": found}, {"crowd": _draw_crowd(found, head, config, portraits)})


def _people(settings: Any, distance: float, portraits: list[Path], random: np.random.Generator) -> list[Person]:
    """People side by side, who talk and gesture, each in their own time."""
    chosen = random.choice(len(portraits), settings.count, replace=False)
    bearings = (np.arange(settings.count) - (settings.count - 1) / 2) * settings.apart
    return [
        Person(
            str(portraits[i]),
            distance=distance,
            bearing=float(bearing),
            height=settings.height,
            sway=settings.sway,
            phase=float(random.uniform(0, 100)),
        )
        for i, bearing in zip(chosen, bearings, strict=True)
    ]


def _covered(head: Any) -> float:
    """Which share of the image people are in front of."""
    head.reset(0)
    people, middle = head.people, np.zeros(head.motors)
    among = head.render(middle)
    head.gather([])
    alone = head.render(middle)
    head.gather(people)
    return float(np.mean(np.abs(among - alone) > 0))


def _draw_crowd(found: xr.Dataset, head: Any, config: Any, portraits: list[Path]) -> Any:
    figure, axes = plt.subplots(1, 3, figsize=(15, 4), layout="constrained")
    wrong = 100 * off(found).isel(movement=-1).transpose("distance", "seed")
    axes[0].plot(found.distance, wrong, color="0.7", marker=".", ls="")
    axes[0].plot(found.distance, wrong.median("seed"), color="C0", marker="o", label="median")
    axes[0].axhline(100 * config.well, color="grey", ls=":", label=f"{config.well:.0%}")
    axes[0].set(xlabel="distance of people (m)", ylabel="error of the gains in the end (%)", yscale="log", xscale="log")
    axes[0].legend(fontsize=8)
    axes[1].plot(found.distance, 100 * found.covered.mean("seed"), color="C1", marker="o")
    axes[1].set(xlabel="distance of people (m)", ylabel="of the image they are in front of (%)", xscale="log")
    distance = float(found.distance[len(found.distance) // 2])
    head.reset(0)
    head.gather(_people(config.people, distance, portraits, np.random.default_rng([config.seed, 0])))
    axes[2].imshow(head.render(np.zeros(head.motors)), cmap="gray", vmin=0, vmax=1)
    axes[2].set(title=f"people {distance:g} m away", xticks=[], yticks=[])
    return figure
