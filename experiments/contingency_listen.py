"""``apmodels contingency listen=FILE.wav calls=FILE.csv``: was anybody answering, in a recording?"""

from __future__ import annotations

import csv
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from yaml import YAMLError

from apmodels import ValueOutOfRange
from experiments import cli
from experiments.contingency_session import draw, verdict
from experiments.study import Result
from hardware import TwoMeans, read_sound
from hardware.sound import decibels
from hardware.sound_file import clipped
from inference import Exact

USAGE = """Was anybody answering, in a recording?

usage: apmodels contingency listen=FILE.wav calls=FILE.csv [key=value ...]

  listen=FILE      the recording: WAV, FLAC, OGG, of any rate, width and number of channels
  calls=FILE       a CSV: seconds at which each call began, in a column 'seconds' or in the first one
  folder=DIR       also write summary.json, contingency.nc and contingency.png there
  model=NAME       {models} [{model}]
  model.KEY=VALUE  a parameter of it, such as model.presence=0.5 or model.window=[1,4]
  certain=0.975    who is so certain has decided
  exponent=0.3     levels are averaged as power to this exponent
"""
MODELS = ("uncertain_window", "contingency")
# Clipping is worth a word from this share of samples on.
MUCH = 0.001


def main() -> None:
    """Judge a recording."""
    words = sys.argv[1:]
    if not words or {"-h", "--help"} & set(words):
        print(USAGE.format(models=" or ".join(MODELS), model=MODELS[0]), end="")
        return
    try:
        options = _options(words)
        result = judge(options, Console(highlight=False))
        if options.folder:
            for path in result.write(Path(os.path.expanduser(options.folder))):
                print(f"wrote {path}")
    except InstantiationException as error:
        cli.fail(str(error.__cause__ or error))
    except (ValueError, OSError, TypeError) as error:
        if not cli.is_users(error):
            raise
        cli.fail(str(error))


def _options(words: list[str]) -> DictConfig:
    for word in words:
        if "=" not in word:
            raise ValueOutOfRange(f"'{word}' is no key=value; give listen=FILE.wav calls=FILE.csv")
    given = {key: value for key, _, value in (word.partition("=") for word in words)}
    name = given.pop("model", MODELS[0])
    if name not in MODELS:
        raise ValueOutOfRange(f"there is no model {name} here; there are {' and '.join(MODELS)}")
    model = OmegaConf.load(Path(cli.__file__).parents[1] / "conf" / "model" / f"{name}.yaml")
    defaults = {"listen": None, "calls": None, "folder": None, "certain": 0.975, "exponent": 0.3, "model": model}
    options = OmegaConf.create(defaults)
    OmegaConf.set_struct(options, True)
    paths = {key: given.pop(key) for key in ("listen", "calls", "folder") if key in given}
    try:
        options = OmegaConf.merge(options, OmegaConf.from_dotlist([f"{key}={value}" for key, value in given.items()]))
    except YAMLError:
        said = " ".join(f"{key}={value}" for key, value in given.items())
        raise ValueOutOfRange(f"{said} cannot be read; is a bracket missing?") from None
    except (OmegaConfBaseException, ValueError) as error:
        key = getattr(error, "full_key", None)
        said = f"there is no key '{key}'" if key else str(error).splitlines()[0]
        raise ValueOutOfRange(f"{said}: apmodels contingency --help lists the keys") from None
    options.update(paths)
    if not options.listen or not options.calls:
        raise ValueOutOfRange("give a recording and the times of its calls: listen=FILE.wav calls=FILE.csv")
    if not isinstance(options.certain, float) or not 0 < options.certain < 1:
        raise ValueOutOfRange(f"certain is a probability between 0 and 1, not {options.certain}")
    if isinstance(options.exponent, bool) or not isinstance(options.exponent, (int, float)):
        raise ValueOutOfRange(f"an exponent is a number, not {options.exponent}")
    assert isinstance(options, DictConfig)
    return options


def judge(options: Any, console: Console) -> Result:
    """Return what a recording says: a summary, every step, and a figure; see ``USAGE`` for the options."""
    sound, rate = read_sound(options.listen)
    model = instantiate(options.model)
    if model.period * rate < 1:
        raise ValueOutOfRange(f"a period of {model.period} s is shorter than a sample of the recording")
    times, merged = _calls(Path(os.path.expanduser(options.calls)), len(sound) / rate, model.period)
    starts, calls = steps(times, len(sound) / rate, model.period)
    size = round(model.period * rate)
    # One at a time: a long recording is not copied, and rounding may leave the last step a sample shorter.
    levels = np.array([decibels(sound[(at := round(s * rate)) : at + size]) for s in starts])
    threshold = float(TwoMeans(options.exponent).middle(levels))
    heard = levels > threshold
    engine = Exact(model, torch.float64)
    beliefs = engine.filter(torch.as_tensor(calls * 1), torch.as_tensor(heard * 1.0))
    chance = np.array([float(belief.marginal("responsive").probs[1]) for belief in beliefs])
    rows = {"call": calls * 1.0, "sound": heard * 1.0, "level": levels, "probability": chance}
    data = xr.Dataset(
        {name: (("time",), values) for name, values in rows.items()}
        | {"threshold": (("time",), np.full(len(starts), threshold))},
        coords={"time": starts + model.period},
    )
    summary = _summary(data, options, sound, merged)
    _tell(console, data, summary, options, model)
    return Result(summary, {"contingency": data}, {"contingency": draw(data, options.certain)})


def steps(times: np.ndarray, seconds: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when steps begin, and whether with a call, (steps,) each.

    Every call begins a step, so that its echo is in it; what is left before the next one, shorter than a period, is
    passed over.

    Args:
        times: of calls, seconds, rising, a period or more apart.
        seconds: how long the recording is.
        period: of a step, seconds.
    """
    before = times[0] - period * np.arange(int(times[0] / period + 1e-9), 0, -1)
    starts, calls = [before], [np.zeros(len(before), bool)]
    for begin, end in zip(times, [*times[1:], seconds], strict=True):
        # A sample's worth of rounding must not cost a step.
        count = int((end - begin) / period + 1e-6)
        starts.append(begin + period * np.arange(count))
        calls.append(np.arange(count) == 0)
    return np.concatenate(starts), np.concatenate(calls)


def _calls(path: Path, seconds: float, period: float) -> tuple[np.ndarray, int]:
    """Times of the calls of a CSV, and how many followed another so soon that they are one with it."""
    if not path.is_file():
        raise ValueOutOfRange(f"'{path}' is not there; calls= is a CSV of seconds")
    try:
        rows = [
            row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if any(map(str.strip, row))
        ]
    except (UnicodeDecodeError, csv.Error):
        raise ValueOutOfRange(f"'{path}' is no text; calls= is a CSV of seconds") from None
    column, width = 0, None
    if rows and not _is_number(rows[0][0]):
        names = [name.strip().lower() for name in rows.pop(0)]
        column, width = names.index("seconds") if "seconds" in names else 0, len(names)
    for row in rows:
        # Under a header of one name, '9,5' is nine and a half written with a comma, and not 9.
        wider = width is not None and any(map(str.strip, row[width:]))
        if wider or len(row) <= column or not _is_number(row[column]):
            raise ValueOutOfRange(f"'{path}' has a line that is no time in seconds: {','.join(row)!r}")
    times = np.sort(np.array([float(row[column]) for row in rows]))
    inside = times[(times >= 0) & (times + period <= seconds)]
    if len(inside) < len(times) or not len(times):
        raise ValueOutOfRange(
            f"'{path}' names {len(times)} calls, of which {len(inside)} are within the recording of {seconds:.1f} s"
        )
    kept = [inside[0]]
    for time in inside[1:]:
        if time - kept[-1] >= period - 1e-9:
            kept.append(time)
    return np.array(kept), len(inside) - len(kept)


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def _summary(data: xr.Dataset, options: Any, sound: np.ndarray, merged: int) -> dict[str, float]:
    sure = np.flatnonzero(data.probability.values >= options.certain)
    upto = data.isel(time=slice(0, sure[0] + 1)) if len(sure) else None
    return {
        "probability": float(data.probability[-1]),
        "calls": float(data.call.sum()),
        "calls_merged": float(merged),
        "steps": float(data.time.size),
        "sounds": float(data.sound.sum()),
        "threshold_db": float(data.threshold[0]),
        "clipped": clipped(sound),
        "calls_to_certain": np.nan if upto is None else float(upto.call.sum()),
        "seconds_to_certain": np.nan if upto is None else float(upto.time[-1]),
    }


def _tell(console: Console, data: xr.Dataset, summary: dict[str, float], options: Any, model: Any) -> None:
    if not np.isfinite(summary["threshold_db"]):
        console.print("all of it is about equally loud: nothing stands out as a sound", soft_wrap=True)
    else:
        console.print(
            f"{summary['steps']:.0f} steps of {model.period} s, {summary['calls']:.0f} calls; "
            f"{summary['sounds']:.0f} steps are louder than {summary['threshold_db']:.1f} dB",
            soft_wrap=True,
        )
    if summary["calls_merged"]:
        console.print(f"{summary['calls_merged']:.0f} calls came within a step of another, and are one with it")
    if summary["clipped"] > MUCH:
        console.print(f"{summary['clipped']:.1%} of the samples are clipped: it was too loud for the recording")
    told = verdict(summary["probability"], options.certain, model.presence)
    console.print(f"P(somebody answers) = {summary['probability']:.3f}: {told}")
