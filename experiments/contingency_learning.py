"""Learning to find out whether anybody answers (thesis section 4.5)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track

from apmodels import ValueOutOfRange
from controllers import DynamicProgramming, RecedingHorizon, TemporalDifference, rollout
from experiments.study import Result
from hardware import Simulated
from inference import Exact

# The thesis's calls to convergence, by steps of a trial.
THESIS = {12: 60_000, 16: 230_000, 20: 700_000}
# A run is given up after so many calls.
PATIENCE = 20_000_000
QUICK = 10


def learning(config: Any, folder: Path, console: Console) -> Result:
    """Learn, and compare what was learned with the best; see ``conf/experiment/contingency/learning.yaml``."""
    engine = Exact(instantiate(config.model), torch.float64)
    runs, episodes = (1, 1000) if config.quick else (config.runs, config.episodes)
    chosen = sorted({12, *(h for h in config.horizons if not config.quick or h <= QUICK)})
    if min(chosen) < 2 or runs < 1 or episodes < 1 or not 0 < config.share < 1:
        raise ValueOutOfRange("learning needs horizons of 2 steps or more, 1 run, 1 episode, and a share in (0, 1)")
    calls = np.full((len(config.optimism), len(chosen), runs), np.nan)
    jobs = [(i, j, r) for i in range(len(config.optimism)) for j in range(len(chosen)) for r in range(runs)]
    curves: dict[float, list[tuple[int, float]]] = {}
    within = np.zeros((len(config.optimism), runs))
    for i, j, r in track(jobs, "learning", transient=True):
        curve = _learned(engine, chosen[j] - 1, config, config.optimism[i], config.seed + r)
        calls[i, j, r] = next(done for done, share in curve if share >= config.share)
        if chosen[j] == 12:
            curves.setdefault(config.optimism[i], curve)
            within[i, r] = _within(curve, config.calls)
    summary = _summary(config, chosen, calls, within)
    fractions, data = _receding(engine, config, episodes)
    summary |= fractions
    _tell(console, config, summary)
    found = xr.Dataset(
        {"calls": (("optimism", "horizon", "run"), calls), **data},
        coords={"optimism": list(config.optimism), "horizon": chosen},
    )
    return Result(summary, {"learning": found}, {"learning": _draw(found, curves, config)})


def _learner(engine: Any, actions: int, config: Any, optimism: float, seed: int) -> TemporalDifference:
    return TemporalDifference(engine, actions, epsilon=config.epsilon, optimism=optimism, anywhere=True, seed=seed)


def _learned(engine: Any, actions: int, config: Any, optimism: float, seed: int) -> list[tuple[int, float]]:
    """(Calls so far, share of the best policy's information), until enough is learned and enough calls were made."""
    learner = _learner(engine, actions, config, optimism, seed)
    nothing = -float(engine.start().entropy()) * actions
    best = learner.table.best(learner.weights) - nothing
    done, curve = 0, [(0, (learner.plan.value - nothing) / best)]
    while curve[-1][1] < config.share or done < config.calls:
        done += int(learner.learn(max(50, learner.learned // 40))[1])
        curve.append((done, (learner.plan.value - nothing) / best))
        if done > PATIENCE:
            raise ValueOutOfRange(f"nothing was learned in {done:,} calls; try another optimism, or epsilon above 0")
    return curve


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


def _receding(engine: Any, config: Any, episodes: int) -> tuple[dict[str, float], dict[str, Any]]:
    """What a learned plan with a short memory finds out, as a share of the best plan's information.

    Episodes are drawn apart for whether somebody answers and weighed by the prior, which makes both certain to occur.
    """
    learner = _learner(engine, config.memory + config.lookahead, config, config.optimism[-1], config.seed)
    done = 0
    while done < config.calls:
        done += int(learner.learn(100)[1])
    made = {
        "receding": RecedingHorizon(learner, config.memory, config.lookahead),
        "best": DynamicProgramming(engine, config.steps),
    }
    prior = engine.start().marginal("responsive").probs.numpy()
    start, nats = float(engine.start().entropy()), {}
    for name, controller in made.items():
        nats[name] = []
        for answer in (0, 1):
            body = Simulated(engine.model, episodes, {"responsive": float(answer)})
            found = rollout(body, engine, controller, config.steps, seed=config.seed + answer)
            nats[name].append(start - found.entropy.values)
    known = {
        name: np.sum([p * part.mean(0) for p, part in zip(prior, parts, strict=True)], 0)
        for name, parts in nats.items()
    }
    total = {name: float(value.sum()) for name, value in known.items()}
    pairs = [one.sum(1) - other.sum(1) for one, other in zip(nats["receding"], nats["best"], strict=True)]
    error = sum(float(p**2 * pair.var() / episodes) for p, pair in zip(prior, pairs, strict=True)) ** 0.5
    uncertain = {name: start * config.steps - value for name, value in total.items()}
    summary = {
        "receding.fraction": total["receding"] / total["best"],
        "receding.fraction.se": error / total["best"],
        # The reward itself is minus the uncertainty; of that the best plan's share is this.
        "receding.reward_fraction": uncertain["best"] / uncertain["receding"],
        "receding.reward_fraction.se": error / uncertain["receding"],
        "receding.final_fraction": float(known["receding"][-1] / known["best"][-1]),
        # What so many episodes make of the best plan, over what it is known to be worth.
        "best.fraction": total["best"] / (made["best"].plan.value + start * config.steps),
    }
    return summary, {f"{name}_information": (("step",), value / np.log(2)) for name, value in known.items()}


def _tell(console: Console, config: Any, summary: dict[str, float]) -> None:
    for optimism in config.optimism:
        name = f"optimism_{optimism:g}."
        console.print(
            f"optimism {optimism:g}: 12 steps are learned in {summary[f'{name}td12.calls']:,.0f} ± "
            f"{summary[f'{name}td12.calls.se']:,.0f} calls; after {config.calls:,} "
            f"{summary[f'{name}td12.fraction']:.2%} of the best; "
            f"calls grow with the horizon to the power {summary[f'{name}power']:.1f}"
        )
    console.print(
        f"{config.memory} steps of memory and {config.lookahead} ahead find out {summary['receding.fraction']:.1%} ± "
        f"{summary['receding.fraction.se']:.1%} of what the best plan over {config.steps} steps does; "
        f"of its reward it has {summary['receding.reward_fraction']:.2%} ± {summary['receding.reward_fraction.se']:.2%}"
    )


def _draw(found: xr.Dataset, curves: dict[float, list[tuple[int, float]]], config: Any) -> Any:
    figure, (shares, powers, known) = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    for optimism, curve in curves.items():
        done, share = zip(*curve, strict=True)
        shares.plot(done, share, label=f"values begin at optimism {optimism:g}")
    shares.axvline(config.calls, color="grey", ls=":")
    shares.axhline(config.share, color="grey", ls=":")
    shares.set(xlabel="calls since birth", ylabel="share of the best 12-step policy", xlim=(0, 1.5 * config.calls))
    shares.xaxis.set_major_formatter(lambda calls, _: f"{calls / 1000:.0f}k")
    shares.legend()
    for optimism in found.optimism.values.tolist():
        mean = found.calls.sel(optimism=optimism).mean("run")
        powers.plot(found.horizon, mean, "o-", label=f"optimism {optimism:g}")
    powers.plot(list(THESIS), list(THESIS.values()), "k^", label="thesis")
    powers.set(xscale="log", yscale="log", xlabel="steps of a trial", ylabel=f"calls to {config.share:.1%}")
    powers.legend()
    steps = np.arange(1, config.steps + 1)
    known.plot(steps, found.best_information, label=f"best over {config.steps} steps")
    known.plot(steps, found.receding_information, "--", label=f"{config.memory} remembered, {config.lookahead} ahead")
    known.set(xlabel="step", ylabel="expected information (bits)")
    known.legend()
    return figure
