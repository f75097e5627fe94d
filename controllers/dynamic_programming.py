"""The best policy over many steps, by backward induction on the engine's sufficient statistic (thesis ch. 4)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from apmodels import ValueOutOfRange
from apmodels.progress import progress
from controllers.belief_mdp import BeliefMDP
from controllers.controller import Controller
from controllers.plan import Plan, size, solve
from inference import Belief, Engine

# A plan that takes longer, in seconds, shows how far it is.
PATIENCE = 2.0
# By how many steps the speed of this machine is found.
SAMPLE = 16
SHARES: dict[str, Callable[[int], list[float]]] = {
    "summed": lambda horizon: [1.0] * horizon,
    "terminal": lambda horizon: [0.0] * (horizon - 1) + [1.0],
}


class DynamicProgramming(Controller):
    """Does what is best over a horizon; it is found once, for all beliefs that can come.

    Of actions that are equally good to 1e-12 the first is taken.

    Args:
        engine: one with a sufficient statistic (``inference.Exact`` where something is counted).
        horizon: how many steps the plan looks ahead.
        weights: how much each step's reward counts: "summed" (all alike, thesis eqs 4.58 to 4.60), "terminal" (the last
            one alone), or a number for every step (the α of eq. 4.50).
        reward: a function of beliefs, (*batch,); by default information about the interest (eq. 4.8).
        steps: in episodes of so many steps the horizon recedes: every action is the first of a plan over all of it. By
            default the episode ends with the horizon.
        memory: refuse to plan where it would take more GB; what is free by default.
    """

    def __init__(
        self,
        engine: Engine,
        horizon: int,
        weights: str | Sequence[float] = "summed",
        reward: Callable[[Any], Any] | None = None,
        steps: int | None = None,
        memory: float | None = None,
    ):
        super().__init__(engine)
        if horizon < 1 or (steps is not None and steps < 1):
            raise ValueOutOfRange(f"a plan needs a horizon and steps of 1 or more, not {horizon} and {steps}")
        self.mdp, self.horizon, self.steps = BeliefMDP(engine, reward), horizon, steps
        self.weights, self.starts = shares(weights, horizon), np.array([self.mdp.first])
        self.plan = self._solved(memory)

    def _solved(self, memory: float | None) -> Plan:
        extra = 0 if self.steps is None else self.steps - 1
        states = self.mdp.lattice(self.horizon + extra)
        kept = self.horizon if self.steps is None else 1
        needed, visits = size(self.mdp, states, self.horizon, extra, kept)
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        limit = float(free) if memory is None else memory * 1e9
        seconds = self._pace() * visits + self.mdp.seconds(states.size)
        self.estimate = {"gb": needed / 1e9, "seconds": seconds, "states": float(states.size)}
        if needed > limit:
            raise ValueOutOfRange(
                f"a plan over {self.horizon} steps takes {needed / 1e9:.2g} GB and about "
                f"{self.estimate['seconds']:.2g} s; "
                f"{limit / 1e9:.2g} GB may be used: shorten the horizon"
            )
        keep = (lambda left: True) if self.steps is None else (lambda left: left == self.horizon)
        with progress(self.estimate["seconds"] >= PATIENCE) as bar:
            task = bar.add_task("planning", total=self.horizon)
            return solve(self.mdp, self.horizon, self.weights, extra, keep, lambda: bar.advance(task), states)

    def _pace(self) -> float:
        """Seconds a value takes on this machine, by a short plan; compiling is not counted."""
        horizon = min(SAMPLE, self.horizon) if self.mdp.process.atoms < 3 else 2
        states = self.mdp.lattice(horizon)
        blank = np.zeros(states.size), np.zeros((len(self.mdp.process.log_prior) - 1, states.size))
        _, visits = size(self.mdp, states, horizon, 0, horizon)
        weights = SHARES["summed"](horizon)
        solve(self.mdp, horizon, weights, states=states, tables=blank)
        return solve(self.mdp, horizon, weights, states=states, tables=blank).seconds / visits

    def act(self, belief: Belief) -> Any:
        """Return the best action for each belief."""
        last = self.horizon if self.steps is None else self.steps
        if belief.time >= last:
            raise ValueOutOfRange(f"the plan is for {last} steps, and {belief.time} have passed; give steps=, or more")
        left = self.horizon - belief.time if self.steps is None else self.horizon
        return self.chosen(belief, *self.mdp.read(belief), left)

    def chosen(self, belief: Belief, kind: np.ndarray, counts: np.ndarray, left: int) -> Any:
        """Return the plan's action for kinds of known states and counts, shaped as a belief's actions are."""
        chosen = torch.as_tensor(self.plan.choose(kind, counts, left).astype(np.int64))
        if belief.batch is None:
            chosen = chosen[0]
        picked = {name: values[chosen] for name, values in self.mdp.process.actions.items()}
        return next(iter(picked.values())) if len(picked) == 1 else picked

    def save(self, path: str | Path) -> None:
        """Keep the policy, packed and compressed."""
        layers = {f"left_{left}": layer for left, layer in self.plan.layers.items()}
        about = {"horizon": self.horizon, "steps": self.steps or 0, "value": self.plan.value, "model": repr(self.model)}
        about |= {"mirrored": self.plan.states.mirrored, "starts": self.starts}
        np.savez_compressed(path, **layers, **about)  # type: ignore[arg-type]

    @classmethod
    def load(cls, engine: Engine, path: str | Path, reward: Callable[[Any], Any] | None = None) -> DynamicProgramming:
        """Return a controller that does what the saved one did, planned or learned, for an engine of the same model."""
        with np.load(path, allow_pickle=False) as kept:
            if str(kept["model"]) != repr(engine.model):
                raise ValueOutOfRange(f"{path} is a plan for {kept['model']}, and not for {engine.model!r}")
            made = DynamicProgramming.__new__(DynamicProgramming)
            Controller.__init__(made, engine)
            made.mdp, made.horizon = BeliefMDP(engine, reward), int(kept["horizon"])
            made.steps = int(kept["steps"]) or None
            layers = {int(name[5:]): kept[name] for name in kept.files if name.startswith("left_")}
            extra, made.starts = made.steps - 1 if made.steps else 0, kept["starts"]
            states = made.mdp.lattice(made.horizon + extra, bool(kept["mirrored"]), made.starts)
            made.plan = Plan(states, made.horizon, made.mdp.after.shape[1], float(kept["value"]), layers, 0.0)
        return made


def shares(weights: str | Sequence[float], horizon: int) -> list[float]:
    """Return how much the reward after each step counts."""
    if isinstance(weights, str):
        if weights not in SHARES:
            raise ValueOutOfRange(f"there are no {weights} rewards; there are {', '.join(SHARES)}, or give numbers")
        return SHARES[weights](horizon)
    found = [float(weight) for weight in weights]
    if len(found) != horizon or min(found) < 0:
        raise ValueOutOfRange(f"a horizon of {horizon} needs as many weights of 0 or more, not {len(found)}")
    return found
