"""In how many steps it is known whether somebody answers (thesis Fig. 4.6 C)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate

from apmodels.progress import tracked
from controllers import DynamicProgramming, RecedingHorizon, TemporalDifference
from controllers.prospects import planned, prospects, remembered, steady
from controllers.temporal_difference import Table
from experiments.contingency_receding import QUICK
from inference import Exact

# Which rate is that of answers (apmodels.Contingency.rates).
ANSWERS = 1


def identify(learner: TemporalDifference, config: Any) -> tuple[dict[str, float], dict[str, Any]]:
    """How often the more probable guess is right, by step, of who acts as was learned, as is best, at random, never.

    It is what is expected of the larger of the two probabilities, exactly. The learner's values are those that it
    learned at the model's own presence; the best plan is made for this one. Of the steps until the share is reached
    those are apart that were spent acting (hearing nothing but oneself), exploring (while an answer could come) and
    listening (to the background): the figure is lost, and its caption can be read both ways.
    """
    steps = min(config.accuracy.steps, QUICK) if config.quick else config.accuracy.steps
    engine = Exact(instantiate(config.model, presence=config.accuracy.presence), torch.float64)
    best = DynamicProgramming(engine, steps)
    table = Table(best.mdp, steps, False)
    made = {
        "infomax": remembered(RecedingHorizon(learner, config.memory[-1], config.lookahead)),
        "best": planned(best, table),
        "random": steady(best.mdp),
        "silent": steady(best.mdp, 0),
    }
    right, spent = {name: np.zeros(steps) for name in made}, np.zeros((3, steps))
    for name in tracked(made, "identifying"):
        for t, mass in enumerate(prospects(made[name], table, steps)):
            right[name][t] = mass @ table.weighed.max(0)
            if name == "infomax":
                spent[:, t] = _spent(table, mass, t + 1)
    reached = {name: _reached(values, config.accuracy.share) for name, values in right.items()}
    summary = {f"accuracy.steps.{name}": step for name, step in reached.items()}
    step = reached["infomax"]
    for part, values in zip(("acting", "exploring", "listening"), spent, strict=True):
        summary[f"accuracy.{part}"] = np.nan if np.isnan(step) else float(values[int(step) - 1])
    data = {f"{name}_accuracy": (("waited",), values) for name, values in right.items()}
    return summary, data | {"spent": (("doing", "waited"), spent)}


def _spent(table: Table, mass: np.ndarray, steps: int) -> tuple[float, float, float]:
    """Steps of hearing oneself, of waiting for answers, and of listening to the background, on average."""
    seen = np.tensordot(mass, table.counts.sum(-1), 1)
    answers = table.mdp.process.component[:, -1].numpy() == ANSWERS
    return steps - float(seen.sum()), float(seen[answers].sum()), float(seen[~answers].sum())


def _reached(right: np.ndarray, share: float) -> float:
    """The first step after which a share of guesses is right; NaN if there is none."""
    there = right >= share
    return float(there.argmax() + 1) if there.any() else np.nan
