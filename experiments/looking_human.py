"""How eyes and head share a gaze shift, beside what people do (thesis section 6.6.4)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import xarray as xr
from rich.console import Console
from rich.table import Table

from apmodels import ValueOutOfRange
from controllers.gaze_shift import gaze_shift
from experiments.study import Result

# Table 6.1, per cent: of the eyes, of the head, and what is missing, by the head's standard deviation.
THESIS = {
    "0.145": (49.48, 49.48, 1.05),
    "0.25": (73.7, 24.8, 1.5),
    "0.5": (90.5, 7.6, 1.9),
    "0.75": (94.5, 3.5, 2.0),
    "1": (96.0, 2.0, 2.0),
    "1.25": (96.7, 1.3, 2.0),
    "inf": (97.9, 0.0, 2.1),
}


def human_data(config: Any, folder: Path, console: Console) -> Result:
    """Share a gaze shift; see ``conf/experiment/learning_to_look/human_data.yaml``."""
    heads = np.array([float(head) for head in config.heads])
    if not len(heads) or not 0 < config.eyes < np.inf or not (heads > 0).all():
        raise ValueOutOfRange("human_data needs eyes of a standard deviation above 0, and a head or more likewise")
    noise = torch.tensor(np.stack([np.full_like(heads, config.eyes), heads], 1))[:, None]
    rotations = gaze_shift(torch.ones(len(heads), 1, 2), noise, torch.ones(len(heads), 1)).numpy()
    names = [f"{head:g}" for head in heads]
    summary: dict[str, float] = {"people": float(config.people)}
    table = Table(title="per cent of the way to go; the thesis's in brackets", title_justify="left")
    for column in ("head's s.d.", "eyes", "head", "undershoot", "head held"):
        table.add_column(column, justify="right")
    for name, (eye, head) in zip(names, rotations, strict=True):
        figures = {"eye": eye, "head": head, "undershoot": 1 - eye - head, "restrained": 1 - eye}
        summary |= {f"{key}.{name}": float(value) for key, value in figures.items()}
        printed = [f" ({value:g})" for value in THESIS.get(name, ())] or [""] * 3
        shown = [f"{100 * value:.2f}{known}" for value, known in zip(figures.values(), [*printed, ""], strict=True)]
        table.add_row(name, *shown)
    console.print(table)
    data = xr.Dataset({"rotation": (("head", "part"), rotations)}, {"head": heads, "part": ["eyes", "head"]})
    return Result(summary, {"human_data": data}, {"human_data": _draw(heads, rotations, config.people)})


def _draw(heads: np.ndarray, rotations: np.ndarray, people: float) -> Any:
    names = [f"{100 * head:g} %" if np.isfinite(head) else "∞" for head in heads]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    left.bar(names, 100 * rotations[:, 0], label="eyes")
    left.bar(names, 100 * rotations[:, 1], bottom=100 * rotations[:, 0], label="head")
    left.set(xlabel="standard deviation of the head, of its way", ylabel="share of the gaze shift (%)", ylim=(0, 105))
    left.legend(loc="lower right")
    right.plot(names, 100 * (1 - rotations.sum(1)), "o-", label="head free")
    right.plot(names, 100 * (1 - rotations[:, 0]), "s-", label="head held")
    right.axhline(100 * people, color="grey", ls=":", label="people")
    right.set(xlabel="standard deviation of the head, of its way", ylabel="undershoot (%)", yscale="log")
    right.legend()
    return figure
