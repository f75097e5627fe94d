"""Learning to find out whether anybody answers (thesis section 4.5)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from rich.console import Console

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from controllers import TemporalDifference
from experiments.contingency_accuracy import identify
from experiments.contingency_learning_figure import draw
from experiments.contingency_receding import recede
from experiments.study import Result, remembered
from inference import Exact

# The thesis's calls to convergence, by steps of a trial.
THESIS = {12: 60_000, 16: 230_000, 20: 700_000}
# A run is given up after so many calls.
PATIENCE = 20_000_000
QUICK = 10


def learning(config: Any, folder: Path, console: Console) -> Result:
    """Learn, and compare what was learned with the best; see ``conf/experiment/contingency/learning.yaml``."""
    engine = Exact(instantiate(config.model), torch.float64)
    _check(config)
    runs = 1 if config.quick else config.runs
    chosen = sorted({12, *(h for h in config.horizons if not config.quick or h <= QUICK)})
    calls = np.full((len(config.optimism), len(chosen), runs), np.nan)
    jobs = [(i, j, r) for i in range(len(config.optimism)) for j in range(len(chosen)) for r in range(runs)]
    curves: dict[float, list[tuple[int, float]]] = {}
    within = np.zeros((len(config.optimism), runs))
    for i, j, r in tracked(jobs, "learning"):
        optimism, seed = config.optimism[i], config.seed + r
        setting = [repr(engine), chosen[j], optimism, config.epsilon, config.share, config.calls, seed]
        part = remembered(
            folder,
            f"curve_{optimism:g}_{chosen[j]}_{r}",
            setting,
            lambda at=(chosen[j] - 1, optimism, seed): _learned(engine, config, *at),
        )
        curve = list(zip(part.done.values.tolist(), part.part.values.tolist(), strict=True))
        calls[i, j, r] = next(done for done, share in curve if share >= config.share)
        if chosen[j] == 12:
            curves.setdefault(config.optimism[i], curve)
            within[i, r] = _within(curve, config.calls)
    learner, receding, data = recede(engine, config, runs)
    identified, more = identify(learner, config)
    summary = _summary(config, chosen, calls, within) | receding | identified
    _tell(console, config, summary)
    found = xr.Dataset(
        {"calls": (("optimism", "horizon", "run"), calls)} | data | more,
        coords={"optimism": list(config.optimism), "horizon": chosen, "memory": list(config.memory)},
    )
    return Result(summary, {"learning": found}, {"learning": draw(found, curves, config, THESIS)})


def _check(config: Any) -> None:
    many = min(config.runs, config.steps, config.looks, config.calls, config.accuracy.steps, *config.memory)
    shares = config.share, config.accuracy.share, config.accuracy.presence
    if not config.memory or min(config.horizons) < 2 or many < 1 or not all(0 < share < 1 for share in shares):
        raise ValueOutOfRange(
            "learning needs horizons of 2 steps or more; 1 run, look, call, step and step remembered, or more; and "
            "shares in (0, 1)"
        )


def _learned(engine: Any, config: Any, actions: int, optimism: float, seed: int) -> xr.Dataset:
    """Calls so far and the share of the best policy's information, until enough is learned and calls were made."""
    learner = TemporalDifference(engine, actions, epsilon=config.epsilon, optimism=optimism, anywhere=True, seed=seed)
    nothing = -float(engine.start().entropy()) * actions
    best = learner.table.best(learner.weights) - nothing
    done, curve = 0, [(0, (learner.plan.value - nothing) / best)]
    while curve[-1][1] < config.share or done < config.calls:
        done += int(learner.learn(max(50, learner.learned // 40))[1])
        curve.append((done, (learner.plan.value - nothing) / best))
        if done > PATIENCE:
            raise ValueOutOfRange(f"nothing was learned in {done:,} calls; try another optimism, or epsilon above 0")
    calls, shares = zip(*curve, strict=True)
    return xr.Dataset({"done": (("look",), list(calls)), "part": (("look",), list(shares))})


def _within(curve: list[tuple[int, float]], calls: int) -> float:
    return [share for done, share in curve if done <= calls][-1]


def _summary(config: Any, chosen: list[int], calls: np.ndarray, within: np.ndarray) -> dict[str, float]:
    """The keys without a name are those of the last optimism."""
    summary: dict[str, float] = {f"thesis.td{h}.calls": float(c) for h, c in THESIS.items()}
    summary |= {"thesis.power": 5.0, "thesis.receding.fraction": 0.995}
    for i, optimism in enumerate(config.optimism):
        names = [f"optimism_{optimism:g}.", *([""] if i + 1 == len(config.optimism) else [])]
        for name in names:
            for j, horizon in enumerate(chosen):
                summary[f"{name}td{horizon}.calls"] = float(calls[i, j].mean())
                summary[f"{name}td{horizon}.calls.se"] = float(calls[i, j].std() / calls.shape[2] ** 0.5)
            summary[f"{name}td12.fraction"] = float(within[i].mean())
            logs = np.log(np.array(chosen, dtype=float)), np.log(calls[i].mean(1))
            summary[f"{name}power"] = float(np.polyfit(*logs, 1)[0]) if len(chosen) > 1 else np.nan
    return summary


def _tell(console: Console, config: Any, summary: dict[str, float]) -> None:
    for optimism in config.optimism:
        name = f"optimism_{optimism:g}."
        console.print(
            f"optimism {optimism:g}: 12 steps are learned in {summary[f'{name}td12.calls']:,.0f} ± "
            f"{summary[f'{name}td12.calls.se']:,.0f} calls; after {config.calls:,} "
            f"{summary[f'{name}td12.fraction']:.2%} of the best; "
            f"calls grow with the horizon to the power {summary[f'{name}power']:.1f}"
        )
    for memory in config.memory:
        told = {
            key[len(name) :]: value for key, value in summary.items() if key.startswith(name := f"memory_{memory}.")
        }
        reward, known = (_give(told, f"receding.{key}", ".2%") for key in ("reward_fraction", "fraction"))
        console.print(
            f"{memory} outcomes remembered and {config.lookahead} steps ahead have, after {config.calls:,} calls, "
            f"{reward} of the best plan's reward (exact values {told['receding.reward_limit']:.2%}) and {known} of its "
            f"information ({told['receding.limit']:.2%}); {config.share:.1%} of the reward in "
            f"{_give(told, 'receding.calls', ',.0f')} calls"
        )
    steps = {name: summary[f"accuracy.steps.{name}"] for name in ("best", "infomax", "random", "silent")}
    said = ", ".join(f"{name} {'not reached' if np.isnan(value) else int(value)}" for name, value in steps.items())
    parts = ", ".join(f"{summary[f'accuracy.{name}']:.1f} {name}" for name in ("acting", "exploring", "listening"))
    spent = "" if np.isnan(steps["infomax"]) else f"; of infomax's, {parts}"
    console.print(f"steps until {config.accuracy.share:.0%} of guesses are right: {said}{spent}")


def _give(summary: dict[str, float], key: str, form: str) -> str:
    """A number and its error, where it has one."""
    value, error = summary[key], summary[f"{key}.se"]
    if np.isnan(value):
        return "more"
    return f"{value:{form}}" + ("" if np.isnan(error) else f" ± {error:{form}}")
