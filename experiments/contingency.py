"""Is anybody answering me?  The studies of chapter 4."""

from __future__ import annotations

import resource
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track

from apmodels import Model, ValueOutOfRange
from controllers import belief_mdp
from controllers.dynamic_programming import SHARES
from controllers.plan import solve
from experiments.study import Result
from inference import Exact

# Keys that every run has, whatever it measures.
TIMED = (40, 100, 200, 300)
# Below this horizon it is not the number of states that takes the time.
LONG = 100
# A quick look plans no further.
QUICK = 100
BITS = np.log(2)


def horizons(config: Any, folder: Path, console: Console) -> Result:
    """Value plans of many horizons, and time some; see ``conf/experiment/contingency/horizons.yaml``."""
    model = instantiate(config.model)
    most = QUICK if config.quick else max(max(config.horizons), max(config.timed))
    chosen = sorted({h for h in config.horizons if h <= most})
    timed = sorted({h for h in config.timed if h <= most})
    if not chosen or min([*chosen, *timed]) < 1:
        raise ValueOutOfRange("horizons needs a horizon of 1 step or more")
    valued = _valued(model, chosen)
    costs = _costs(model, timed)
    data = xr.Dataset(
        {name: (("horizon",), values) for name, values in valued.items()}
        | {name: (("timed",), values) for name, values in costs.items()},
        coords={"horizon": chosen, "timed": timed},
        attrs={"model": repr(model)},
    )
    summary = _summary(data)
    _tell(console, data, summary)
    return Result(summary, {"horizons": data}, {"horizons": _draw(data, summary)})


def _valued(model: Model, chosen: list[int]) -> dict[str, list[float]]:
    """Expected final information, bits, of the best plan for it and of the best for the sum; and of both, the sums."""
    mdp = belief_mdp(Exact(model, torch.float64))
    prior = float(mdp.engine.start().entropy())
    found: dict[str, list[float]] = {"final_information": [], "mean_information": []}
    for horizon in track(chosen, "planning", transient=True):
        final = solve(mdp, horizon, SHARES["terminal"](horizon), keep=lambda left: False).value
        summed = solve(mdp, horizon, SHARES["summed"](horizon), keep=lambda left: False).value
        found["final_information"].append((prior + final) / BITS)
        found["mean_information"].append((prior + summed / horizon) / BITS)
    return found


def _costs(model: Model, timed: list[int]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {"seconds": [], "peak_gb": [], "states": []}
    for horizon in track(timed, "timing", transient=True):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            for name, value in pool.submit(cost, model, horizon).result().items():
                found[name].append(value)
    return found


def cost(model: Model, horizon: int) -> dict[str, float]:
    """What one plan costs, in this process: compiling is not counted, laying out and tabulating are."""
    mdp = belief_mdp(Exact(model, torch.float64))
    solve(mdp, 4, SHARES["summed"](4), keep=lambda left: False)
    plan = solve(mdp, horizon, SHARES["summed"](horizon), keep=lambda left: False)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    return {"seconds": plan.seconds, "peak_gb": peak, "states": float(plan.states.size)}


def _summary(data: xr.Dataset) -> dict[str, float]:
    summary = {}
    for horizon in sorted({*TIMED, *data.timed.values.tolist()}):
        there = horizon in data.timed.values
        summary[f"seconds.{horizon}"] = float(data.seconds.sel(timed=horizon)) if there else np.nan
        summary[f"peak_gb.{horizon}"] = float(data.peak_gb.sel(timed=horizon)) if there else np.nan
        summary[f"states.{horizon}"] = float(data.states.sel(timed=horizon)) if there else np.nan
    for name, key in (("exponent", "seconds"), ("exponent_of_states", "states")):
        long = data.where(data.timed >= LONG, drop=True)
        few = long.timed.size < 2
        logs = np.log(long.timed.values.astype(float)), np.log(long[key].values)
        summary[name] = np.nan if few else float(np.polyfit(*logs, 1)[0])
    for horizon in data.horizon.values.tolist():
        summary[f"final_information.{horizon}"] = float(data.final_information.sel(horizon=horizon))
    return summary


def _tell(console: Console, data: xr.Dataset, summary: dict[str, float]) -> None:
    last = int(data.horizon[-1])
    console.print(f"after {last} steps {summary[f'final_information.{last}']:.4f} bits are expected to be known")
    for horizon in data.timed.values.tolist():
        seconds, peak = summary[f"seconds.{horizon}"], summary[f"peak_gb.{horizon}"]
        console.print(f"a plan over {horizon} steps: {seconds:.3g} s, {peak:.2f} GB")


def _draw(data: xr.Dataset, summary: dict[str, float]) -> Any:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    left.plot(data.horizon, data.final_information, "o-", ms=3, label="at the end, planned for it")
    left.plot(data.horizon, data.mean_information, "s-", ms=3, label="at a step, planned for the sum")
    left.set(xscale="log", xlabel="horizon (steps)", ylabel="expected information (bits)", ylim=(0, None))
    left.legend()
    right.plot(data.timed, data.seconds, "o-", label=f"seconds (exponent {summary['exponent']:.1f})")
    right.plot(data.timed, data.peak_gb, "s-", label="peak memory (GB)")
    millions = f"million states (exponent {summary['exponent_of_states']:.1f})"
    right.plot(data.timed, data.states / 1e6, "^-", label=millions)
    right.set(xscale="log", yscale="log", xlabel="horizon (steps)")
    right.legend()
    return figure
