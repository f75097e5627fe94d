"""Is anybody answering me?  The studies of chapter 4."""

from __future__ import annotations

import resource
import sys
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

from apmodels import Model, ValueOutOfRange
from apmodels.progress import tracked
from controllers import DynamicProgramming, GreedyInfomax, belief_mdp, rollout
from controllers.dynamic_programming import SHARES
from controllers.lattice import visited
from controllers.plan import solve
from experiments.study import Result
from hardware import Simulated
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
    for horizon in tracked(chosen, "planning"):
        final = solve(mdp, horizon, SHARES["terminal"](horizon), keep=lambda left: False).value
        summed = solve(mdp, horizon, SHARES["summed"](horizon), keep=lambda left: False).value
        found["final_information"].append((prior + final) / BITS)
        found["mean_information"].append((prior + summed / horizon) / BITS)
    return found


def _costs(model: Model, timed: list[int]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {"seconds": [], "peak_gb": [], "states": []}
    for horizon in tracked(timed, "timing"):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            for name, value in pool.submit(cost, model, horizon).result().items():
                found[name].append(value)
    return found


def cost(model: Model, horizon: int) -> dict[str, float]:
    """What one plan costs, in this process: compiling is not counted, laying out and tabulating are."""
    mdp = belief_mdp(Exact(model, torch.float64))
    solve(mdp, 4, SHARES["summed"](4), keep=lambda left: False)
    plan = solve(mdp, horizon, SHARES["summed"](horizon), keep=lambda left: False)
    return {"seconds": plan.seconds, "peak_gb": _peak() / 1e9, "states": float(plan.states.size)}


def _peak() -> float:
    """The most memory that this process has held, bytes; what the one that started it held is not its own."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


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


# What the best policy looks like.


def optimal(config: Any, folder: Path, console: Console) -> Result:
    """Compare the best policies with rules of thumb; see ``conf/experiment/contingency/optimal.yaml``."""
    model = instantiate(config.model)
    horizon = 24 if config.quick else config.horizon
    first, last = (10, 14) if config.quick else config.between
    if not 1 <= first <= last < horizon:
        raise ValueOutOfRange(f"between must lie within the horizon of {horizon} steps, not {first} and {last}")
    engine = Exact(model, torch.float64)
    summary: dict[str, float] = {"thesis.summed.agreement": 0.985, "thesis.summed.ratio": 9.0}
    data, ratios = {}, np.asarray(config.ratios, dtype=float)
    for reward in SHARES:
        plan = DynamicProgramming(engine, horizon, reward)
        calls, timers, unsure = _decisions(plan, model, first, last)
        scores = np.stack([_scores(calls, timers >= late, unsure[:, None] > ratios) for late in _lates(model)])
        data[reward] = (("late", "ratio", "score"), scores)
        best = np.unravel_index(scores[..., 1:].mean(-1).argmax(), scores.shape[:2])
        published = _scores(calls, timers > model.window[1], unsure[:, None] > 9)[0]
        names = ("agreement", "agreement_on_calls", "agreement_on_silences")
        summary |= {f"{reward}.{name}": float(score) for name, score in zip(names, scores[best], strict=True)}
        summary |= {f"{reward}.published.{name}": float(score) for name, score in zip(names, published, strict=True)}
        summary[f"{reward}.ratio"] = float(ratios[best[1]])
        summary[f"{reward}.timer"] = float(_lates(model)[best[0]])
        summary[f"{reward}.calls"] = float(calls.mean())
        summary[f"{reward}.statistics"] = float(len(calls))
    console.print(_told(summary, model))
    coords = {"late": list(_lates(model)), "ratio": ratios, "score": ["all", "calls", "silences"]}
    found = xr.Dataset(data, coords=coords, attrs={"model": repr(model), "horizon": horizon})
    return Result(summary, {"optimal": found}, {"optimal": _draw_rules(found, summary)})


def _lates(model: Any) -> tuple[int, int]:
    """Calling once the last answer could have been heard, or a step later, as the thesis's rule does."""
    return model.window[1], model.window[1] + 1


def _decisions(plan: DynamicProgramming, model: Any, first: int, last: int) -> tuple[np.ndarray, ...]:
    """Of all statistics that can be reached in these steps: does the plan call, the timer, and how unsure it is."""
    process, mdp = plan.mdp.process, plan.mdp
    calls, timers, unsure = [], [], []
    for time in range(first, last + 1):
        met = visited(process.after.numpy(), process.atom.numpy(), process.first, process.atoms, time)
        for state, *totals in np.argwhere(met).tolist():
            counts = _all_counts(totals)
            kinds = np.full(len(counts), mdp.kind_of[state])
            calls.append(plan.plan.choose(kinds, counts, plan.horizon - time))
            timers.append(np.full(len(counts), float(process.states[state, 0])))
            unsure.append(_unsure(model, counts))
    return np.concatenate(calls).astype(bool), np.concatenate(timers), np.concatenate(unsure)


def _all_counts(totals: list[int]) -> np.ndarray:
    """All (silences, sounds) of these totals, (n, K, 2)."""
    sounds = np.stack(np.meshgrid(*(np.arange(n + 1) for n in totals), indexing="ij"), -1).reshape(-1, len(totals))
    return np.stack([np.asarray(totals) - sounds, sounds], -1)


def _unsure(model: Any, counts: np.ndarray) -> np.ndarray:
    """How much more a step could teach about answers than about the background: the ratio of eq. 4.9.

    Variances of the rates, if somebody answers, over how often each was heard; atoms are answers, then background.
    """
    spread, seen = [], counts.sum(-1)
    for k, (sounds, silences) in enumerate((model.answering, model.background)):
        a, b = sounds + counts[:, k, 1], silences + counts[:, k, 0]
        spread.append(a * b / ((a + b) ** 2 * (a + b + 1)))
    over, under = spread[0] * seen[:, 1], spread[1] * seen[:, 0]
    return np.divide(over, under, out=np.where(over > 0, np.inf, 0.0), where=under > 0)


def _scores(calls: np.ndarray, late: np.ndarray, over: np.ndarray) -> np.ndarray:
    """How often a rule does what the plan does: in all, where the plan calls, where it is silent, (rules, 3)."""
    over = over.reshape(len(calls), -1)
    rule = late[:, None] & over
    right = rule == calls[:, None]
    return np.stack([right.mean(0), right[calls].mean(0), right[~calls].mean(0)], -1)


def _told(summary: dict[str, float], model: Any) -> str:
    lines = []
    for reward in SHARES:
        s = {key.removeprefix(f"{reward}."): value for key, value in summary.items() if key.startswith(f"{reward}.")}
        lines += [
            f"{reward} reward: of {s['statistics']:,.0f} statistics the best policy calls in {s['calls']:.1%};",
            f"  nearest rule: timer at {s['timer']:.0f} or more, ratio above {s['ratio']:g}: agrees in "
            f"{s['agreement']:.1%}, {s['agreement_on_calls']:.1%} of calls, "
            f"{s['agreement_on_silences']:.1%} of silences;",
            f"  the thesis's (timer above {model.window[1]}, ratio above 9): {s['published.agreement']:.1%}, "
            f"{s['published.agreement_on_calls']:.1%}, {s['published.agreement_on_silences']:.1%}",
        ]
    return "\n".join(lines)


def _draw_rules(found: xr.Dataset, summary: dict[str, float]) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    for axis, reward in zip(axes, SHARES, strict=True):
        for late, style in zip(found.late.values.tolist(), ("-", "--"), strict=True):
            for i, score in enumerate(found.score.values.tolist()):
                line = found[reward].sel(late=late, score=score)
                axis.plot(found.ratio, line, style, color=f"C{i}", label=f"{score}, timer ≥ {late}")
        axis.axhline(summary["thesis.summed.agreement"], color="grey", lw=1)
        axis.axvline(9, color="grey", lw=1, ls=":")
        axis.set(xscale="log", xlabel="ratio of uncertainties above which the rule calls", title=f"{reward} reward")
    axes[0].set_ylabel("agreement with the best policy")
    axes[0].legend(fontsize=8)
    return figure


# One step ahead.


def greedy_never_calls(config: Any, folder: Path, console: Console) -> Result:
    """Compare one step ahead with many; see ``conf/experiment/contingency/greedy_never_calls.yaml``."""
    model = instantiate(config.model)
    episodes = min(config.episodes, 50) if config.quick else config.episodes
    if config.steps < 1 or episodes < 1:
        raise ValueOutOfRange("greedy_never_calls needs 1 step and 1 episode or more")
    engine = Exact(model, torch.float64)
    made = {"greedy": GreedyInfomax(engine), "planned": DynamicProgramming(engine, config.steps)}
    prior, summary, data = float(engine.start().entropy()) / BITS, {}, {}
    for name, controller in made.items():
        found = rollout(Simulated(model, batch=episodes), engine, controller, config.steps, seed=config.seed)
        bits = prior - found.entropy / BITS
        data[name] = bits.transpose("episode", "time")
        summary[f"{name}.calls"] = float(found.vocalize.sum("time").mean())
        summary[f"{name}.information"] = float(bits[:, -1].mean())
        summary[f"{name}.information.se"] = float(bits[:, -1].std() / episodes**0.5)
        console.print(
            f"{name}: {summary[f'{name}.calls']:.2f} calls in {config.steps} steps, "
            f"{summary[f'{name}.information']:.4f} ± {summary[f'{name}.information.se']:.4f} bits known"
        )
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, bits in data.items():
        bits.mean("episode").plot(ax=axis, label=name)
    axis.set(xlabel="step", ylabel="known about who is there (bits, mean)", title="")
    axis.legend()
    return Result(summary, {"greedy_never_calls": xr.Dataset(data)}, {"greedy_never_calls": figure})


# Baby-9.

# Seconds at which the infant of the video called first, and between calls.
INFANT = (5.58, 4.22, 10.32, 5.32, 6.14, 5.44, 3.56)


class Answering:
    """A body that answers every call in the same steps after it, and is silent otherwise; it hears itself call."""

    def __init__(self, answers: list[int]):
        self.answers = set(answers)

    def reset(self, seed: int | None = None) -> None:
        """Begin anew."""
        self.since = 10**9

    def step(self, call: Any) -> torch.Tensor:
        """Return whether there is a sound."""
        self.since = 0 if int(call) else self.since + 1
        return torch.tensor(1.0 if self.since == 0 or self.since in self.answers else 0.0)


def baby9(config: Any, folder: Path, console: Console) -> Result:
    """Let the best policy call a caregiver; see ``conf/experiment/contingency/baby9.yaml``."""
    model = instantiate(config.model)
    engine = Exact(model, torch.float64)
    controller = DynamicProgramming(engine, config.horizon, steps=config.steps)
    summary: dict[str, float] = {"thesis.calls": 6.0, "thesis.mean_interval_seconds": 5.92, "thesis.responsive": 1.0}
    summary |= {"infant.calls": float(len(INFANT)), "infant.mean_interval_seconds": float(np.mean(INFANT[1:]))}
    traces: dict[str, xr.Dataset] = {}
    for name, answers in config.readings.items():
        traces[name] = _session(model, engine, controller, list(answers), config.steps)
        found = _session_summary(traces[name], model)
        summary |= {f"{name}.{key}": value for key, value in found.items()}
        summary |= found if len(traces) == 1 else {}
        console.print(
            f"answers in steps {', '.join(map(str, answers))} after a call ({name}): {found['calls']:.0f} calls, "
            f"{found['mean_interval_seconds']:.2f} s apart, P(responsive) = {found['responsive']:.3f}"
        )
    data = xr.concat(traces.values(), xr.DataArray(list(traces), dims="reading", name="reading"))
    return Result(summary, {"baby9": data}, {"baby9": _draw_sessions(traces, model)})


def _session(model: Any, engine: Any, controller: Any, answers: list[int], steps: int) -> xr.Dataset:
    body, belief = Answering(answers), engine.start()
    body.reset()
    rows: dict[str, list[float]] = {"call": [], "sound": [], "responsive": [], "ratio": []}
    means: dict[str, list[np.ndarray]] = {"counts": []}
    for _ in range(steps):
        call = controller.act(belief)
        sound = body.step(call)
        belief = engine.update(belief, call, sound)
        _, counts = controller.mdp.read(belief)
        rows["call"].append(float(call))
        rows["sound"].append(float(sound))
        rows["responsive"].append(float(belief.marginal("responsive").probs[1]))
        rows["ratio"].append(float(_unsure(model, counts)[0]))
        means["counts"].append(counts[0])
    seconds = model.period * np.arange(steps)
    variables: dict[str, Any] = {name: (("time",), column) for name, column in rows.items()}
    variables["counts"] = (("time", "atom", "outcome"), np.stack(means["counts"]))
    return xr.Dataset(variables, coords={"time": seconds})


def _session_summary(data: xr.Dataset, model: Any) -> dict[str, float]:
    calls = data.time.values[data.call.values == 1]
    gaps = np.diff(calls)
    at = data.ratio.values[np.maximum(np.flatnonzero(data.call.values == 1) - 1, 0)]
    finite = at[np.isfinite(at)]
    return {
        "calls": float(len(calls)),
        "first_call_seconds": float(calls[0]) if len(calls) else np.nan,
        "mean_interval_seconds": float(gaps.mean()) if len(gaps) else np.nan,
        "responsive": float(data.responsive[-1]),
        "ratio_at_calls": float(np.median(finite)) if len(finite) else np.nan,
    }


def _draw_sessions(traces: dict[str, xr.Dataset], model: Any) -> Any:
    from scipy.stats import beta

    figure, axes = plt.subplots(4, len(traces), figsize=(5.2 * len(traces), 9), squeeze=False, layout="constrained")
    for (calls, chance, rates, ratio), (name, data) in zip(axes.T, traces.items(), strict=True):
        heard = data.time.values[(data.sound.values == 1) & (data.call.values == 0)]
        rows = [data.time.values[data.call.values == 1], heard, np.cumsum(INFANT)]
        calls.eventplot(rows, lineoffsets=[2, 1, 0], linelengths=0.7, colors=["C0", "C1", "grey"])
        calls.set(title=f"answers: {name}", xlim=(-1, data.time[-1] + 1), xlabel="seconds")
        calls.set_yticks([0, 1, 2], ["Baby-9 calls", "answers", "plan calls"])
        chance.plot(data.time, data.responsive, drawstyle="steps-post")
        chance.set(ylabel="P(responsive)", ylim=(-0.02, 1.02), xlabel="seconds")
        x = np.linspace(0, 1, 300)
        for k, (label, (one, zero)) in enumerate({"answers": model.answering, "background": model.background}.items()):
            silences, sounds = data.counts[-1, k].values
            rates.plot(x, beta.pdf(x, one + sounds, zero + silences), label=label)
        rates.set(xlabel="rate, in the end, if somebody answers", ylabel="density")
        rates.legend()
        ratio.plot(data.time, data.ratio.where(np.isfinite(data.ratio)), drawstyle="steps-post")
        ratio.axhline(9, color="grey", ls=":")
        ratio.set(yscale="log", xlabel="seconds", ylabel="ratio of uncertainties (4.9)")
    return figure
