"""One session of asking whether anybody answers, step by step (thesis section 4.6)."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

COLUMNS = ("seconds", "call", "sound", "level", "threshold", "probability", "thinking")


class Session:
    """Calls and listens with a ``SoundBooth``, and judges what is heard.

    Args:
        body: the booth; one room.
        controller: says when to call, by beliefs of its own engine.
        judge: the engine whose beliefs are told; it may hold a richer model.
    """

    def __init__(self, body: Any, controller: Any, judge: Any):
        self.body, self.controller, self.judge = body, controller, judge
        self.rows: list[dict[str, float]] = []

    def run(self, steps: int, seed: int | None = None, path: Path | None = None) -> Iterator[dict[str, float]]:
        """Yield what happened in every step, and keep it, line by line, in a CSV.

        ``thinking`` is the seconds of computation that a step took: what is left of its period is idle.
        """
        self.body.reset(seed)
        self.controller.reset(seed)
        engine, batch = self.controller.engine, self.body.batch
        belief, judged = engine.start(batch), self.judge.start(batch)
        with open(path or os.devnull, "w", newline="", buffering=1) as file:
            table: Any = csv.DictWriter(file, COLUMNS)
            table.writeheader()
            for step in range(1, steps + 1):
                begin = time.process_time()
                call = self.controller.act(belief)
                chosen = time.process_time()
                sound = self.body.step(call)
                heard = time.process_time()
                belief, judged = engine.update(belief, call, sound), self.judge.update(judged, call, sound)
                probability = judged.marginal("responsive").probs[..., 1]
                row = {
                    "seconds": step * self.body.period,
                    "call": _one(call),
                    "sound": _one(sound),
                    "level": _one(self.body.log["level"][-1]),
                    "threshold": _one(self.body.log["threshold"][-1]),
                    "probability": _one(probability),
                    "thinking": time.process_time() - heard + chosen - begin,
                }
                self.rows.append(row)
                table.writerow(row)
                yield row

    def dataset(self) -> xr.Dataset:
        """Return all steps so far."""
        columns = {name: [row[name] for row in self.rows] for name in COLUMNS}
        seconds = columns.pop("seconds")
        return xr.Dataset({name: (("time",), values) for name, values in columns.items()}, coords={"time": seconds})


def _one(value: Any) -> float:
    return float(np.asarray(value).reshape(-1)[0])


def draw(data: xr.Dataset, certain: float) -> Any:
    """Draw levels, calls and the belief over a session; ``data`` is as ``Session.dataset`` returns it."""
    import matplotlib.pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, figsize=(10, 5), sharex=True, layout="constrained")
    above.plot(data.time, data.level, ".-", lw=0.7, color="0.6", ms=3, label="level")
    for name, kind, color in (("sound", data.sound == 1, "C1"), ("call", data.call == 1, "C0")):
        part = data.where(kind, drop=True)
        above.plot(part.time, part.level, "o", color=color, ms=6 if name == "call" else 4, label=name)
    finite = data.threshold.where(np.isfinite(data.threshold))
    above.plot(data.time, finite, ":", color="k", lw=1, label="threshold")
    above.set(ylabel="dB of full scale")
    above.legend(ncols=4, fontsize=8, loc="lower right")
    below.plot(data.time, data.probability, drawstyle="steps-post")
    below.axhline(certain, color="grey", ls=":")
    below.set(xlabel="seconds", ylabel="P(somebody answers)", ylim=(-0.03, 1.03))
    return figure


def verdict(probability: float, certain: float, prior: float) -> str:
    """Say in words what a probability means."""
    if probability >= certain:
        return "somebody answers"
    return "nobody seems to answer" if probability < prior else "it is not certain yet"
