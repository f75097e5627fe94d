"""What a learner with a short memory is worth beside the best plan over many steps, exactly (thesis section 4.5.1)."""

from __future__ import annotations

from typing import Any

import numpy as np

from apmodels.progress import tracked
from controllers import DynamicProgramming, RecedingHorizon, TemporalDifference
from controllers.prospects import planned, prospects, remembered
from controllers.temporal_difference import Table

# The first look at a learner is after so many calls.
FIRST = 1000
# A quick look takes so many steps, and looks.
QUICK, LOOKS = 20, 3
# A learner is asked how often it called after so many sessions.
SESSIONS = 5

Found = tuple[TemporalDifference, dict[str, float], dict[str, Any]]


def recede(engine: Any, config: Any, runs: int) -> Found:
    """Learn with short memories; return the last learner, a summary and variables of a data set.

    Two readings of a share of the best plan's performance: of its information, summed over steps, and of the reward
    itself, minus the uncertainty summed over steps (eqs 4.50 and 4.59).
    """
    steps = min(config.steps, QUICK) if config.quick else config.steps
    last = min(LOOKS, config.looks) if config.quick else config.looks
    looks = np.unique(np.geomspace(min(FIRST, config.calls), config.calls, last).round().astype(int))
    table = Table(DynamicProgramming(engine, 1).mdp, steps, False)
    maker = DynamicProgramming(engine, steps)
    best = np.array([mass @ table.reward for mass in prospects(planned(maker, table), table, steps)])
    start = float(engine.start().entropy())
    jobs = [(i, r) for i in range(len(config.memory)) for r in range(runs)]
    size = len(config.memory), runs, len(looks)
    done, rewards, informed = (np.zeros(size) for _ in range(3))
    known, limits = np.zeros((len(config.memory), steps)), []
    for i, r in tracked(jobs, "remembering little"):
        memory = config.memory[i]
        learner = _learner(engine, memory, config, config.seed + r)
        if not r:
            limits.append(_shares(_limit(engine, memory, config, table, steps), best, start))
        for n, look in enumerate(looks):
            done[i, r, n] = _taught(learner, int(look), int(done[i, r, max(n - 1, 0)]))
            found = _rewards(learner, memory, config, table, steps)
            informed[i, r, n], rewards[i, r, n] = _shares(found, best, start)
            known[i] = found + start
    summary = _summary(config, done, rewards, informed, limits)
    summary |= {
        "receding.final_fraction": float(known[-1, -1] / (best[-1] + start)),
        "receding.final_reward_fraction": float(best[-1] / (known[-1, -1] - start)),
        # What is found of the best plan going forward, over what planning backward said.
        "best.fraction": float((best + start).sum() / (maker.plan.value + start * steps)),
    }
    return learner, summary, _data(done, rewards, informed, known, best + start)


def _data(done: Any, rewards: Any, informed: Any, known: Any, best: Any) -> dict[str, Any]:
    names = "memory", "run", "look"
    data = {"receding_calls": (names, done), "receding_reward": (names, rewards), "receding_share": (names, informed)}
    data |= {"receding_information": (("memory", "step"), known / np.log(2))}
    return data | {"best_information": (("step",), best / np.log(2))}


def _learner(engine: Any, memory: int, config: Any, seed: int) -> TemporalDifference:
    horizon, how = memory + config.lookahead, config.session
    return TemporalDifference(
        engine, horizon, epsilon=how.epsilon, optimism=how.optimism, anywhere=True, seed=seed, memory=memory,
        session=how.steps, symmetric=how.symmetric,
    )  # fmt: skip


def _taught(learner: TemporalDifference, calls: int, done: int) -> int:
    """Learn until so many calls were made, of which some are done; return how many were."""
    while done < calls:
        done += int(learner.learn(SESSIONS)[1])
    return done


def _limit(engine: Any, memory: int, config: Any, table: Table, steps: int) -> np.ndarray:
    """What the same controller earns if its values are exact."""
    knows = TemporalDifference(engine, memory + config.lookahead, anywhere=True)
    knows.values = knows.table.solved(knows.weights)
    return _rewards(knows, memory, config, table, steps)


def _rewards(learner: TemporalDifference, memory: int, config: Any, table: Table, steps: int) -> np.ndarray:
    """What is expected in each step, (steps,)."""
    machine = remembered(RecedingHorizon(learner, memory, config.lookahead))
    return np.array([mass @ table.reward for mass in prospects(machine, table, steps)])


def _shares(found: np.ndarray, best: np.ndarray, start: float) -> tuple[float, float]:
    """Shares of the best plan's information and of its reward."""
    return float((found + start).sum() / (best + start).sum()), float(best.sum() / found.sum())


def _summary(config: Any, done: Any, rewards: Any, informed: Any, limits: list) -> dict[str, float]:
    """The keys without a name are those of the last memory.

    Calls are those after which the share of the reward is reached for good, NaN unless all runs do.
    """
    summary: dict[str, float] = {}
    for i, memory in enumerate(config.memory):
        there = np.logical_and.accumulate((rewards[i] >= config.share)[:, ::-1], 1)[:, ::-1]
        found = {"receding.limit": limits[i][0], "receding.reward_limit": limits[i][1]}
        found["receding.reached"] = float(there.any(1).mean())
        first = np.where(there.any(1), done[i][np.arange(len(there)), there.argmax(1)], np.nan)
        for key, values in (
            ("fraction", informed[i, :, -1]),
            ("reward_fraction", rewards[i, :, -1]),
            ("calls", first),
        ):
            found[f"receding.{key}"] = float(values.mean())
            error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
            found[f"receding.{key}.se"] = float(error)
        summary |= {f"memory_{memory}.{key}": value for key, value in found.items()}
        if i + 1 == len(config.memory):
            summary |= found
    return summary
