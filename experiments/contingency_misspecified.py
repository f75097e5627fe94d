"""Looking for answers in worlds that are not as believed (chapter 4): who is deceived, and does the control notice?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from rich.console import Console
from scipy.special import entr

from apmodels import ValueOutOfRange
from apmodels.progress import tracked
from controllers import Controller, DynamicProgramming, Playback, rollout
from experiments.contingency_misspecified_figure import draw
from experiments.contingency_worlds import TRUTHS, World, worlds_of
from experiments.study import Result, remembered
from hardware import Simulated
from inference import Engine, Exact

# A quick look: steps of a session, steps ahead, sessions.
QUICK = (36, 12, 100)
BITS = np.log(2)
# The worlds' rates: as given, or drawn from the agent's own prior.
RATES = ("fixed", "drawn")
SHARES = ("right", "wrong", "undecided", "mistaken", "misled", "silent", "in_the_sand")
MEASURES = ("truth", *SHARES, "calls", "late_calls", "entropy", "surprise")
BRIEFLY = ("mistaken", "in_the_sand", "calls", "surprise")

# The sessions.


@dataclass
class Sessions:
    """Whether the agent called, and P(truth) as it believed afterwards, both (episode, step), and the prior's."""

    calls: np.ndarray
    belief: np.ndarray
    prior: float

    @property
    def mistaken(self) -> np.ndarray:
        """Whether the truth was held less likely than not in the end, (episode,)."""
        return self.belief[:, -1] < 0.5

    @property
    def late_calls(self) -> np.ndarray:
        """Calls in the last third, (episode,)."""
        return self.calls[:, -(self.calls.shape[1] // 3) :].sum(1)

    @property
    def silent(self) -> np.ndarray:
        """Whether there was no call in the last third, (episode,)."""
        return self.late_calls == 0

    @property
    def surprise(self) -> np.ndarray:
        """- log P(truth) in the end, bits, (episode,): the log score; in a calibrated mind the mean entropy."""
        return -np.log2(np.maximum(self.belief[:, -1], np.finfo(float).tiny))

    @property
    def entropy(self) -> np.ndarray:
        """What the agent thinks that it does not know in the end, bits, (episode,)."""
        last = self.belief[:, -1]
        return (entr(last) + entr(1 - last)) / BITS

    def measures(self, decided: float) -> dict[str, np.ndarray]:
        """Return what is measured of every session, by name, (episode,)."""
        last = self.belief[:, -1]
        right, wrong = last > decided, last < 1 - decided
        return {
            "truth": last,
            "right": right,
            "wrong": wrong,
            "undecided": ~right & ~wrong,
            "mistaken": self.mistaken,
            "misled": last < self.prior,
            "silent": self.silent,
            "in_the_sand": self.mistaken & self.silent,
            "calls": self.calls.sum(1),
            "late_calls": self.late_calls,
            "entropy": self.entropy,
            "surprise": self.surprise,
        }


def misspecified(config: Any, folder: Path, console: Console) -> Result:
    """Let one agent listen in many worlds; see ``conf/experiment/contingency/misspecified.yaml``."""
    model = instantiate(config.model)
    steps, horizon, episodes = QUICK if config.quick else (config.steps, config.horizon, config.episodes)
    _check(config, steps, horizon, episodes)
    worlds, agents = worlds_of(config, model), _Agents(model, steps, horizon, config.every)
    measured: dict[tuple[str, str, str], dict[str, np.ndarray]] = {}
    courses: dict[tuple[str, str, str], np.ndarray] = {}
    for world in tracked(worlds, "listening"):
        for rates in RATES:
            setting = [
                repr(model),
                repr(world.model),
                world.rates,
                steps,
                horizon,
                episodes,
                config.decided,
                config.seed,
            ]
            part = remembered(
                folder,
                f"{world.name}.{rates}",
                [*setting, list(config.every), config.decided, config.seed],
                lambda world=world, rates=rates: agents.part(world, rates, episodes, config),
            )
            for name in part.attrs["agents"].split():
                own = {str(key).split(":")[1]: key for key in part if str(key).startswith(f"{name}:")}
                measured[world.name, rates, name] = {key: part[variable].values for key, variable in own.items()}
                courses[world.name, rates, name] = measured[world.name, rates, name].pop("course")
    data = _dataset(measured, courses, [w.name for w in worlds], agents.names)
    data.attrs = {"model": repr(model), "steps": steps, "horizon": horizon}
    summary = _summary(data, worlds, model)
    _tell(console, data, summary, worlds)
    return Result(summary, {"misspecified": data}, {"misspecified": draw(data, worlds)})


def _check(config: Any, steps: int, horizon: int, episodes: int) -> None:
    if steps < 3 or horizon < 1 or episodes < 2:
        raise ValueOutOfRange("misspecified needs 3 steps, a horizon of 1 and 2 episodes or more")
    if not config.every or min(config.every) < 1:
        raise ValueOutOfRange(f"every must be one or more numbers of steps, each 1 or more, not {list(config.every)}")
    if len(config.rates) != 3 or not all(
        0 <= r <= 1 for r in (*config.rates, *config.chats, config.noise, config.talk)
    ):
        raise ValueOutOfRange(
            "rates must be three (echo, answers, background), and they, chats, noise and talk lie in [0, 1]"
        )
    if not 0.5 <= config.decided < 1:
        raise ValueOutOfRange(f"decided must lie in [0.5, 1), not {config.decided}")
    if min([*config.late, *config.echoes], default=0) < 0:
        raise ValueOutOfRange("late and echoes count steps, which are 0 or more")


class _Agents:
    """Who listens: all believe in one model but the listener, who hears what the planner did, and the knower."""

    def __init__(self, model: Any, steps: int, horizon: int, every: Any):
        self.steps, self.horizon = steps, horizon
        self.engines: dict[str, Exact] = {}
        self.plans: dict[str, DynamicProgramming] = {}
        self.engine = self._engine(model)
        self.controllers: dict[str, Controller] = {
            "planned": self._plan(model),
            "terminal": DynamicProgramming(self.engine, horizon, "terminal", steps=steps),
        }
        self.names = [*self.controllers, "listener", "knower", *(f"every_{gap}" for gap in every)]
        for gap in every:
            rhythm = (torch.arange(steps) % gap == 0).long()
            self.controllers[f"every_{gap}"] = Playback(self.engine, rhythm)

    def _engine(self, model: Any) -> Exact:
        return self.engines.setdefault(repr(model), Exact(model, torch.float64))

    def _plan(self, model: Any) -> DynamicProgramming:
        if repr(model) not in self.plans:
            self.plans[repr(model)] = DynamicProgramming(self._engine(model), self.horizon, steps=self.steps)
        return self.plans[repr(model)]

    def part(self, world: World, rates: str, episodes: int, config: Any) -> xr.Dataset:
        """Return what all agents make of a world: every measure of every session, and the mean course of P(truth)."""
        variables: dict[str, Any] = {}
        names = []
        for name, sessions in self.sessions(world, rates, episodes, config.seed):
            names.append(name)
            measures = sessions.measures(config.decided)
            variables |= {f"{name}:{key}": (("session",), value) for key, value in measures.items()}
            variables[f"{name}:course"] = (("time",), sessions.belief.mean(0))
        return xr.Dataset(variables, attrs={"agents": " ".join(names)})

    def sessions(self, world: World, rates: str, episodes: int, seed: int) -> Iterator[tuple[str, Sessions]]:
        """Yield agents' names and sessions; all begin with the same seed, so that differences are paired.

        Where rates are drawn, only the planner listens.
        """
        given: dict[str, Any] = {"responsive": float(world.truth)}
        if rates == "drawn":
            yield "planned", self._played(world, given, self.engine, self.controllers["planned"], episodes, seed)[1]
            return
        given["rates"] = torch.tensor(world.rates)
        for name, controller in self.controllers.items():
            found, sessions = self._played(world, given, self.engine, controller, episodes, seed)
            yield name, sessions
            if name == "planned" and world.heard:
                yield "listener", self._listened(found, world)
        if world.planned:
            knower = self._engine(world.model), self._plan(world.model)
            yield "knower", self._played(world, given, *knower, episodes, seed)[1]

    def _played(
        self, world: World, given: Any, engine: Engine, controller: Controller, episodes: int, seed: int
    ) -> tuple[xr.Dataset, Sessions]:
        found = rollout(Simulated(world.model, episodes, given), engine, controller, self.steps, seed)
        belief = found.marginal.values[..., world.truth]
        return found, Sessions(found.vocalize.values.astype(bool), belief, _prior(engine, world.truth))

    def _listened(self, found: xr.Dataset, world: World) -> Sessions:
        """What who knows the world would believe, who heard what the planner heard."""
        calls, sounds = found.vocalize.values, found.sound.values
        engine = self._engine(world.model)
        beliefs = engine.filter(torch.as_tensor(calls), torch.as_tensor(sounds), batch=len(calls))
        belief = np.stack([b.marginal("responsive").probs[:, world.truth].numpy() for b in beliefs], 1)
        return Sessions(calls.astype(bool), belief, _prior(engine, world.truth))


def _prior(engine: Engine, truth: int) -> float:
    return float(engine.start().marginal("responsive").probs[truth])


# What comes of it.


def _dataset(measured: Any, courses: Any, worlds: list[str], agents: list[str]) -> xr.Dataset:
    """Every session's measures (world, rates, agent, episode), and P(truth) over time; NaN where there is none."""
    first = next(iter(measured.values()))
    shape = len(worlds), len(RATES), len(agents)
    arrays = {name: np.full((*shape, len(values)), np.nan) for name, values in first.items()}
    course = np.full((*shape, len(next(iter(courses.values())))), np.nan)
    for (world, rates, agent), values in measured.items():
        at = worlds.index(world), RATES.index(rates), agents.index(agent)
        course[at] = courses[world, rates, agent]
        for name, value in values.items():
            arrays[name][at] = value
    dims = ("world", "rates", "agent")
    return xr.Dataset(
        {name: ((*dims, "episode"), array) for name, array in arrays.items()} | {"course": ((*dims, "time"), course)},
        coords={"world": worlds, "rates": list(RATES), "agent": agents, "time": np.arange(1, course.shape[-1] + 1)},
    )


def _summary(data: xr.Dataset, worlds: list[World], model: Any) -> dict[str, float]:
    """Keys WORLD.AGENT.MEASURE at the given rates, WORLD.drawn.AGENT.MEASURE where rates are drawn from their prior."""
    summary: dict[str, float] = {}
    for (world, agent), names in _told_of(worlds, data.agent.values.tolist()).items():
        of, drawn = data.sel(world=world, agent=agent.removeprefix("drawn.")), agent.startswith("drawn.")
        for name in names:
            values = of[name].sel(rates=RATES[drawn]).values
            summary |= _mean(f"{world}.{agent}.{name}", values, name in SHARES)
    return summary | _calibration(data, model) | _losses(data, worlds) | _sand(data, worlds)


def _told_of(worlds: list[World], agents: list[str]) -> dict[tuple[str, str], tuple[str, ...]]:
    """Which measures of which agents are worth a key: all of the planner's."""
    found: dict[tuple[str, str], tuple[str, ...]] = {}
    for world in worlds:
        found |= {(world.name, "planned"): MEASURES, (world.name, "drawn.planned"): BRIEFLY}
        absent = {"listener": not world.heard, "knower": not world.planned, "planned": True}
        found |= {(world.name, agent): BRIEFLY for agent in agents if not absent.get(agent, False)}
    return found


def _mean(key: str, values: np.ndarray, share: bool = False) -> dict[str, float]:
    """The mean and its standard error. None of n is no proof that it never happens: Laplace's share has an error."""
    n = len(values)
    if not n:
        return {key: np.nan, f"{key}.se": np.nan}
    among = (values.sum() + 1) / (n + 2)
    error = (among * (1 - among) / n) ** 0.5 if share else values.std() / n**0.5
    return {key: float(values.mean()), f"{key}.se": float(error)}


def _calibration(data: xr.Dataset, model: Any) -> dict[str, float]:
    """In the world as believed, weighed by the prior: what is unknown, as believed and as scored, bits."""
    found: dict[str, float] = {}
    weights = 1 - model.presence, model.presence
    strata = [data.sel(world=f"own.{truth}", rates="drawn", agent="planned") for truth in TRUTHS]
    for name, of in (
        ("entropy", lambda part: part.entropy),
        ("surprise", lambda part: part.surprise),
        ("excess", lambda part: part.surprise - part.entropy),
    ):
        values = [of(part).values for part in strata]
        found[f"calibration.{name}"] = float(sum(w * v.mean() for w, v in zip(weights, values, strict=True)))
        variance = sum(w**2 * v.var() / len(v) for w, v in zip(weights, values, strict=True))
        found[f"calibration.{name}.se"] = float(variance**0.5)
    return found


def _losses(data: xr.Dataset, worlds: list[World]) -> dict[str, float]:
    """Bits of log score lost by hearing wrongly what was heard, and by not calling as who knows the world; calls.

    Without a world's name: the mean over the strange worlds of which both are known.
    """
    surprise = data.surprise.sel(rates="fixed")
    planned, listener, knower = (surprise.sel(agent=agent) for agent in ("planned", "listener", "knower"))
    found: dict[str, float] = {}
    both = [world.name for world in worlds if world.strange and world.planned]
    for name, lost in (("lost_by_inference", planned - listener), ("lost_by_control", listener - knower)):
        for world in worlds:
            found |= _mean(f"{world.name}.{name}", lost.sel(world=world.name).values)
        # Worlds share their seed: an episode is one draw, whatever the number of worlds.
        found |= _mean(name, lost.sel(world=both).mean("world").values)
    for agent in ("planned", "knower"):
        calls = data.calls.sel(rates="fixed", agent=agent, world=both)
        found |= _mean(f"{agent}.calls", calls.mean("world").values)
    return found


def _sand(data: xr.Dataset, worlds: list[World]) -> dict[str, float]:
    """Over all strange worlds: how many are mistaken in the end, and whether those fall silent."""
    there = data.sel(world=[world.name for world in worlds if world.strange], rates="fixed")
    found: dict[str, float] = {}
    for agent in ("planned", "terminal"):
        of = there.sel(agent=agent)
        mistaken, silent = of.mistaken.values == 1, of.silent.values
        found |= _mean(f"{agent}.mistaken", mistaken.ravel(), True)
        found |= _mean(f"{agent}.in_the_sand", of.in_the_sand.values.ravel(), True)
        found |= _mean(f"{agent}.silent_if_mistaken", silent[mistaken], True)
        found |= _mean(f"{agent}.silent_if_not", silent[~mistaken], True)
        found[f"{agent}.in_the_sand.most"] = float(of.in_the_sand.mean("episode").max())
    return found


def _tell(console: Console, data: xr.Dataset, summary: dict[str, float], worlds: list[World]) -> None:
    s, names = summary, data.world.values.tolist()
    others = [name for name in data.agent.values.tolist() if name != "terminal"]
    console.print(
        f"the world as believed: {s['calibration.surprise']:.4f} bits unknown by the log score, "
        f"{s['calibration.entropy']:.4f} by the belief itself (they differ by {s['calibration.excess']:.4f} ± "
        f"{s['calibration.excess.se']:.4f})"
    )
    for kind in dict.fromkeys(_kind(world.name) for world in worlds if world.strange):
        members = [name for name in names if _kind(name) == kind]
        label = " ".join([kind, "/".join(dict.fromkeys(name.partition(".")[2] for name in members))]).rstrip()
        told = [f"{agent} {_shares(s, members, agent)}" for agent in others if f"{members[0]}.{agent}.calls" in s]
        console.print(f"mistaken, {label}: {'; '.join(told)}")
    console.print(
        f"bits lost by wrong inference {s['lost_by_inference']:.2f} ± {s['lost_by_inference.se']:.2f}, by calling "
        f"otherwise than who knows the world {s['lost_by_control']:.2f} ± {s['lost_by_control.se']:.2f}; "
        f"calls {s['planned.calls']:.2f}, of who knows {s['knower.calls']:.2f}"
    )
    console.print(
        f"head in the sand (mistaken, and no call in the last third): {s['planned.in_the_sand']:.2%} ± "
        f"{s['planned.in_the_sand.se']:.2%} of sessions, {s['planned.in_the_sand.most']:.1%} in the worst world; "
        f"silent are {s['planned.silent_if_mistaken']:.2%} of the mistaken, {s['planned.silent_if_not']:.2%} of others"
    )


def _kind(name: str) -> str:
    """Worlds of a kind differ in a number, or in whether somebody is there."""
    return name.partition(".")[0].removeprefix("answered_")


def _shares(summary: dict[str, float], members: list[str], agent: str) -> str:
    """Shares of the mistaken, per cent; those of a kind in which somebody is there come after a comma."""
    runs = dict.fromkeys(name.partition(".")[0] for name in members)
    return (
        ", ".join(
            "/".join(
                f"{100 * summary[f'{name}.{agent}.mistaken']:.0f}" for name in members if name.partition(".")[0] == run
            )
            for run in runs
        )
        + " %"
    )
