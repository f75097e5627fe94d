"""Is anybody answering me?  In rooms made of real sounds (thesis section 4.6)."""

from __future__ import annotations

from dataclasses import replace
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
from apmodels.progress import progress
from controllers import Constant, DynamicProgramming, Handover, Playback, rollout
from experiments.sounds import RATE, conversation, utterances
from experiments.study import Result, remembered
from hardware import Caregiver, SoundBooth, TwoMeans, VirtualRoom
from inference import Exact

# Answers, dB of full scale: what levels of a configuration are relative to.
SPEECH = -26.0
# Rates that a test is told count as much as so many observed steps: they are known.
KNOWN = 1e7
# Calls are so far apart, in steps, where rates are measured.
APART = 8


def room(config: Any, folder: Path, console: Console) -> Result:
    """Hold sessions in every room; see ``conf/experiment/contingency/room.yaml``."""
    sessions, steps, listen = (20, 80, [0, 30]) if config.quick else (config.sessions, config.steps, config.listen)
    _check(config, sessions, steps, listen)
    hall = Hall(config, sessions, steps)
    summary: dict[str, float] = {"thesis.office.calls": 3.5, "thesis.office.within_4": 1.0}
    kept: dict[str, list[xr.Dataset]] = {}
    with progress() as bar:
        for name in bar.track(list(config.rooms), description="sessions"):
            told = remembered(folder, f"{name}.told", hall.setting(name), lambda name=name: hall.told(name))
            for patience in listen:
                data = remembered(
                    folder,
                    f"{name}.listen_{patience}",
                    hall.setting(name),
                    lambda name=name, patience=patience: hall.sessions(name, patience),
                ).merge(told)
                kept.setdefault(name, []).append(data)
                scores = _scores(data, patience + config.glance)
                for prefix in (f"{name}.listen_{patience}", *([name] if patience == listen[-1] else [])):
                    summary |= {f"{prefix}.{key}": value for key, value in scores.items()}
            console.print(_told(name, summary, listen), soft_wrap=True)
    parts = [xr.concat(part, dim="listen").assign_coords(listen=list(listen)) for part in kept.values()]
    found = xr.concat(parts, dim="room").assign_coords(room=list(kept))
    return Result(summary, {"room": found}, {"room": _draw(found.isel(listen=-1), config)})


def _check(config: Any, sessions: int, steps: int, listen: Any) -> None:
    numbers = all(isinstance(number, (int, float)) for number in (sessions, config.certain, steps, config.glance))
    if not numbers or sessions < 1 or not 0 < config.certain < 1 or not config.rooms:
        raise ValueOutOfRange("room needs a room, 1 session or more, and a certainty in (0, 1)")
    if config.glance < 1 or (not OmegaConf.is_list(listen) and not isinstance(listen, list)):
        raise ValueOutOfRange(f"room needs a list of listenings and a glance of 1 step or more, not {listen}")
    if not listen or not 0 <= min(listen) <= max(listen) <= steps - config.glance:
        raise ValueOutOfRange(
            f"of {steps} steps {config.glance} or more must be left after listening for {list(listen)}"
        )


class Hall:
    """Sessions in virtual rooms: who calls, who judges, and a test that is told more.

    Args:
        config: see ``conf/experiment/contingency/room.yaml``.
        sessions: how many that are answered, and as many that are not.
        steps: of every session.
    """

    def __init__(self, config: Any, sessions: int, steps: int):
        self.config, self.count, self.steps = config, sessions, steps
        self.model, self.judge = instantiate(config.model), Exact(instantiate(config.judge), torch.float64)
        self.engine = Exact(self.model, torch.float64)
        for name in config.rooms:
            # What is wrong with a room is better said before planning than after.
            if not _is_room(config.rooms[name]):
                raise ValueOutOfRange(
                    f"room {name} must be such as {{conversation: -10, lasting: [1.5, 2.5], chance: 1.0}}"
                )
            self.body(name, True)
        self.plan = DynamicProgramming(self.engine, min(config.horizon, steps), steps=steps)

    def setting(self, name: str) -> str:
        """Return all that sessions in a room depend on, but for how long it is listened to."""
        parts = ("model", "judge", "horizon", "certain", "half", "exponent", "check", "seed")
        return repr([*(str(self.config[part]) for part in parts), str(self.config.rooms[name]), self.count, self.steps])

    def body(self, name: str, *answered: bool) -> SoundBooth:
        """Return a booth in as many rooms in which calls are answered, or not, as there are sessions, for each."""
        config, chosen = self.config, self.config.rooms[name]
        caregiver = Caregiver(utterances(*chosen.lasting, half=config.half), chance=chosen.chance)
        level = None if chosen.conversation is None else SPEECH + chosen.conversation
        responsive = np.repeat(answered, self.count)
        virtual = VirtualRoom(caregiver, responsive, RATE, conversation(config.half), level, speech_level=SPEECH)
        ear = TwoMeans(config.exponent, hold=config.check)
        return SoundBooth(virtual, virtual, period=self.model.period, ear=ear, check=config.check)

    def sessions(self, name: str, listen: int) -> xr.Dataset:
        """Listen, then call as planned, and judge what was heard; see ``_decided``."""
        controller = Handover(Constant(self.engine, 0), listen, self.plan)
        found = rollout(self.body(name, True, False), self.engine, controller, self.steps, seed=self.config.seed)
        calls, sounds = (torch.as_tensor(found[name].values) for name in ("vocalize", "sound"))
        beliefs = self.judge.filter(calls, sounds, batch=len(calls))
        chance = np.stack([belief.marginal("responsive").probs[:, 1].numpy() for belief in beliefs], 1)
        return self._decided("planned", chance, calls.numpy())

    def told(self, name: str) -> xr.Dataset:
        """Run a sequential test that is told the true rates: it calls again as soon as no answer can come any more."""
        rates = self._rates(name)
        echo, answer, background = ((KNOWN * rate, KNOWN * (1 - rate)) for rate in rates)
        engine = Exact(replace(self.model, echoing=echo, answering=answer, background=background), torch.float64)
        calls = np.arange(self.steps) % (self.model.window[1] + 1) == 0
        controller = Playback(engine, torch.as_tensor(calls * 1))
        found = rollout(self.body(name, True, False), engine, controller, self.steps, seed=self.config.seed)
        data = self._decided("limit", found.marginal.values[..., 1], found.vocalize.values)
        return data.assign(rate=(("cause",), rates)).assign_coords(cause=["echo", "answer", "background"])

    def _rates(self, name: str) -> np.ndarray:
        """How often the echo, answers and the background are heard where calls are answered, counted."""
        steps, (first, last) = min(self.steps, 10 * APART), self.model.window
        timer = np.arange(steps) % APART
        controller = Playback(self.engine, torch.as_tensor((timer == 0) * 1))
        sound = rollout(self.body(name, True), self.engine, controller, steps, self.config.seed + 1).sound
        echo = (timer >= self.model.echo[0]) & (timer <= self.model.echo[1])
        parts = [sound.values[:, mask] for mask in (echo, (timer >= first) & (timer <= last), timer > last)]
        # Half a sound and half a silence more than were heard: nothing is known to be impossible.
        return np.array([(part.sum() + 0.5) / (part.size + 1) for part in parts])

    def _decided(self, name: str, chance: np.ndarray, calls: np.ndarray) -> xr.Dataset:
        """P(responsive) after every step, and the calls and seconds until it is certain.

        Who is not certain in the end has called as often as there was time for.
        """
        sure = chance >= self.config.certain
        known = sure.any(1)
        last = np.where(known, sure.argmax(1), self.steps - 1)
        made = calls.cumsum(1)[np.arange(len(calls)), last]
        kinds, one = ("answered", "session"), (2, self.count)
        variables = {
            f"{name}_probability": ((*kinds, "time"), chance.reshape(*one, -1)),
            f"{name}_known": (kinds, known.reshape(one)),
            f"{name}_calls": (kinds, made.reshape(one)),
            f"{name}_seconds": (kinds, self.model.period * (last + 1.0).reshape(one)),
        }
        return xr.Dataset(variables, coords={"answered": [True, False], "time": np.arange(1, self.steps + 1)})


def _is_room(chosen: Any) -> bool:
    if not OmegaConf.is_dict(chosen) or set(chosen) != {"conversation", "lasting", "chance"}:
        return False
    numbers = [chosen.chance, *([] if chosen.conversation is None else [chosen.conversation])]
    both = list(chosen.lasting) if OmegaConf.is_list(chosen.lasting) else []
    return len(both) == 2 and all(isinstance(number, (int, float)) for number in numbers + both)


def _scores(data: xr.Dataset, glance: int) -> dict[str, float]:
    """What is told of a room, with standard errors; the area under the ROC is that after ``glance`` steps."""
    yes, no = data.sel(answered=True), data.sel(answered=False)
    n = data.session.size
    ratio = float(yes.planned_calls.mean() / yes.limit_calls.mean())
    spread = yes.planned_calls.values - ratio * yes.limit_calls.values
    scores = {f"within_{most}": float((yes.planned_known & (yes.planned_calls <= most)).mean()) for most in (4, 8, 16)}
    return scores | {
        "known": float(yes.planned_known.mean()),
        "calls": float(yes.planned_calls.mean()),
        "calls.se": float(yes.planned_calls.std() / n**0.5),
        "seconds": float(yes.planned_seconds.mean()),
        "limit.known": float(yes.limit_known.mean()),
        "limit.calls": float(yes.limit_calls.mean()),
        "limit.seconds": float(yes.limit_seconds.mean()),
        "calls_over_limit": ratio,
        "calls_over_limit.se": float(spread.std() / n**0.5 / yes.limit_calls.mean()),
        "false_alarms": float(no.planned_known.mean()),
        "limit.false_alarms": float(no.limit_known.mean()),
        "area": _area(*(part.planned_probability.sel(time=glance).values for part in (yes, no))),
        "rate.answer": float(data.rate.sel(cause="answer")),
        "rate.background": float(data.rate.sel(cause="background")),
    }


def _area(yes: np.ndarray, no: np.ndarray) -> float:
    """Area under the ROC: how often an answered session is the more probable one of two; a tie is half."""
    order = yes[:, None] - no
    return float((order > 0).mean() + (order == 0).mean() / 2)


def _told(name: str, summary: dict[str, float], listen: Any) -> str:
    last, first = (
        {key: summary[f"{name}.listen_{patience}.{key}"] for key in ("calls", "seconds", "false_alarms")}
        for patience in (listen[-1], listen[0])
    )
    within = (f"{summary[f'{name}.within_{most}']:.0%} within {most}" for most in (4, 8))
    return (
        f"{name:10} known in {summary[f'{name}.known']:6.1%}, after {last['calls']:4.1f} calls and "
        f"{last['seconds']:5.1f} s ({', '.join(within)}): {summary[f'{name}.calls_over_limit']:.2f} ± "
        f"{summary[f'{name}.calls_over_limit.se']:.2f} times the limit; false alarms {last['false_alarms']:.1%}; "
        f"having listened for {listen[0]} steps only: {first['calls']:.1f} calls, {first['seconds']:.1f} s, "
        f"{first['false_alarms']:.1%}"
    )


def _draw(data: xr.Dataset, config: Any) -> Any:
    figure, (roc, calls, chance) = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
    most, glance = np.arange(0, 31), int(data.listen) + config.glance
    for i, name in enumerate(data.room.values.tolist()):
        yes, no = (data.sel(room=name, answered=answered) for answered in (True, False))
        p, q = (part.planned_probability.sel(time=glance).values for part in (yes, no))
        at = np.concatenate([[2.0], np.sort(np.concatenate([p, q]))[::-1]])
        hits, alarms = ((part >= at[:, None]).mean(1) for part in (p, q))
        roc.plot(alarms, hits, drawstyle="steps-post", color=f"C{i}", label=f"{name} ({_area(p, q):.3f})")
        for key, style in (("planned", "-"), ("limit", ":")):
            known = np.where(yes[f"{key}_known"], yes[f"{key}_calls"], np.inf)
            share = (known <= most[:, None]).mean(1)
            calls.plot(most, share, style, drawstyle="steps-post", color=f"C{i}", lw=1.5 if style == "-" else 1)
        seconds = data.time * config.model.period
        chance.plot(seconds, yes.planned_probability.mean("session"), color=f"C{i}", label=name)
        chance.plot(seconds, no.planned_probability.mean("session"), color=f"C{i}", ls=":", lw=1)
    roc.set(
        xlabel="false alarms", ylabel="hits", title=f"{config.glance} steps after the first call", xlim=(-0.02, 1.02)
    )
    calls.set(
        xlabel="calls", ylabel=f"answered sessions known ({config.certain:.1%})", title="dotted: told the true rates"
    )
    chance.set(xlabel="seconds", ylabel="mean P(responsive)", title="dotted: nobody answers")
    roc.legend(loc="lower right", fontsize=8)
    return figure
