"""Is anybody answering me?  Live, with a microphone and a loudspeaker (thesis section 4.6)."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from rich.console import Console, Group
from rich.live import Live
from rich.padding import Padding
from rich.progress_bar import ProgressBar
from rich.text import Text

from apmodels import ValueOutOfRange
from controllers import Constant, DynamicProgramming, Handover
from experiments.contingency_room import Hall
from experiments.contingency_session import Session, draw, verdict
from experiments.study import Result
from hardware import SoundBooth, SoundCard, SoundError, TwoMeans
from inference import Exact

# Steps of a session that are shown.
SHOWN = 60


def live(config: Any, folder: Path, console: Console) -> Result:
    """Hold a session; see ``conf/experiment/contingency/live.yaml``."""
    steps = 40 if config.quick else config.steps
    numbers = all(isinstance(number, (int, float)) for number in (config.listen, config.certain, steps))
    if not numbers or not 0 <= config.listen < steps or not 0 < config.certain < 1:
        raise ValueOutOfRange(f"live needs a certainty in (0, 1) and more steps than the {config.listen} of listening")
    body = _body(config)
    try:
        session = _session(config, body, steps)
        complaint = _hold(session, config, steps, folder, console)
    finally:
        body.close()
    if not session.rows:
        raise SoundError(complaint)
    data = session.dataset()
    summary = _summary(session, config)
    told = verdict(summary["probability"], config.certain, session.judge.model.presence)
    console.print(f"P(somebody answers) = {summary['probability']:.3f} after {summary['calls']:.0f} calls: {told}")
    result = Result(summary, {"live": data}, {"live": draw(data, config.certain)})
    if complaint:
        result.write(folder)
        raise SoundError(f"{complaint} The session so far is kept in {folder}.")
    return result


def _body(config: Any) -> SoundBooth:
    if config.room is not None:
        if config.room not in config.rooms:
            raise ValueOutOfRange(f"there is no room {config.room}; there are {', '.join(config.rooms)}")
        return Hall(config, 1, 1).body(config.room, bool(config.answered))
    card = SoundCard(config.microphone, config.speaker, config.rate)
    ear = TwoMeans(config.exponent, hold=config.check)
    return SoundBooth(card, card, period=config.model.period, ear=ear, check=config.check)


def _session(config: Any, body: SoundBooth, steps: int) -> Session:
    engine, judge = Exact(instantiate(config.model)), Exact(instantiate(config.judge))
    plan = DynamicProgramming(engine, min(config.horizon, steps), steps=steps)
    return Session(body, Handover(Constant(engine, 0), config.listen, plan), judge)


def _hold(session: Session, config: Any, steps: int, folder: Path, console: Console) -> str:
    """Run the session with the belief in the terminal; return what went wrong, or nothing."""
    console.print(f"sound check: {config.check * session.body.period:.0f} s; please say nothing")
    folder.mkdir(parents=True, exist_ok=True)
    complaint = ""
    with Live(console=console, auto_refresh=False) as screen, _asked_to_stop() as asked:
        try:
            for row in session.run(steps, config.seed, folder / "session.csv"):
                screen.update(_shown(session, config.certain), refresh=console.is_terminal)
                if asked or (config.stop and row["probability"] >= config.certain):
                    break
        except SoundError as error:
            complaint = str(error)
    if not console.is_terminal:
        # In a file or a pipe the last line of what was shown is not ended.
        console.print()
    return complaint


@contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """Collect the first Ctrl-C instead of stopping at once: a step is ended, and nothing is half done."""
    asked: list[int] = []

    def note(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


def _shown(session: Session, certain: float) -> Group:
    last, rows = session.rows[-1], session.rows[-SHOWN:]
    marks = "".join("▲" if row["call"] else "●" if row["sound"] else "·" for row in rows)
    chance = last["probability"]
    color = "green" if chance >= certain else "yellow" if chance >= 0.5 else "blue"
    return Group(
        Text(f"{last['seconds']:6.1f} s   ▲ call  ● sound  · silence"),
        Text(marks, style="bold"),
        Text(f"P(somebody answers) {chance:6.3f}", style=color),
        # A bar alone does not end its line.
        Padding(ProgressBar(total=1.0, completed=chance, width=SHOWN, complete_style=color, finished_style=color), 0),
        Text(f"level {last['level']:6.1f} dB, threshold {last['threshold']:6.1f} dB", style="dim"),
    )


def _summary(session: Session, config: Any) -> dict[str, float]:
    rows = session.rows
    sure = [i for i, row in enumerate(rows) if row["probability"] >= config.certain]
    upto = rows[: sure[0] + 1] if sure else []
    return {
        "probability": rows[-1]["probability"],
        "steps": float(len(rows)),
        "calls": float(sum(row["call"] for row in rows)),
        "calls_to_certain": float(sum(row["call"] for row in upto)) if sure else np.nan,
        "seconds_to_certain": upto[-1]["seconds"] if sure else np.nan,
        "idle": idle(session),
    }


def idle(session: Session) -> float:
    """Share of a core that is left while a session runs in real time."""
    # The first steps still compile.
    thinking = [row["thinking"] for row in session.rows][len(session.rows) // 4 :]
    return 1 - float(np.mean(thinking)) / session.body.period
