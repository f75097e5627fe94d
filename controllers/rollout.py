"""The loop: belief, action, observation, belief; kept as a labelled data set."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.progress import progress
from apmodels.simulation import as_dict
from controllers.controller import Controller
from inference import Belief, Engine, Marginal

# A loop that takes longer than this shows how far it is.
PATIENCE = 2.0


def rollout(
    body: Any,
    engine: Engine,
    controller: Controller,
    steps: int,
    seed: int | None = 0,
    until: Callable[[Belief, Any], Any] | None = None,
) -> xr.Dataset:
    """Run a controller on a body and return what happened.

    Args:
        body: see hardware.Body; with ``batch``, so many episodes run side by side. Its world and the engine's
            model are separate objects.
        engine: makes beliefs.
        controller: makes actions.
        steps: how many steps at the most.
        seed: for the body's draws and the controller's; None leaves the controller's as they are.
        until: a function of the belief and the action that led to it, which says when to stop: True, or (batch,)
            booleans, of which all must hold.

    Returns:
        Dimensions ``episode`` and ``time``. Variables: every action and observation; ``entropy`` of the interest
        (nats); ``marginal`` of a finite interest, ``mean`` and ``variance`` of a continuous one, each followed by
        ``_NAME`` where the interest is several variables; ``log_evidence``;
        ``act_seconds``, ``body_seconds``, ``update_seconds`` (time); ``truth_NAME`` where the body knows the truth.
    """
    if steps < 1:
        raise ValueOutOfRange(f"a rollout needs 1 step or more, not {steps}")
    body.reset(seed)
    controller.reset(seed)
    belief = engine.start(getattr(body, "batch", None))
    record = _Record(engine, belief)
    begin = time.perf_counter()
    with contextlib.ExitStack() as stack:
        advance = None
        for step in range(steps):
            before = time.perf_counter()
            action = controller.act(belief)
            acted = time.perf_counter()
            observation = body.step(action)
            sensed = time.perf_counter()
            belief = engine.update(belief, action, observation)
            record.note(action, observation, belief, (acted - before, sensed - acted, time.perf_counter() - sensed))
            record.truth(getattr(body, "truth", {}))
            if advance is None and time.perf_counter() - begin > PATIENCE:
                advance = _progress(stack, steps, step)
            if advance is not None:
                advance()
            if until is not None and bool(np.all(np.asarray(until(belief, action)))):
                break
    return record.dataset()


def _progress(stack: contextlib.ExitStack, steps: int, done: int) -> Callable[[], None]:
    bar = stack.enter_context(progress())
    task = bar.add_task("rolling out", total=steps, completed=done)
    return lambda: bar.advance(task)


class _Record:
    def __init__(self, engine: Engine, belief: Belief):
        self.engine = engine
        self.single = belief.batch is None
        self.columns: dict[str, list[np.ndarray]] = {}
        self.seconds: list[tuple[float, float, float]] = []
        self.batch = belief.batch
        self.shapes = {name: space.shape for name, space in engine.spaces.items()}
        function = engine.model.declaration.interest is not None
        self.interest = ("interest",) if function else engine.structure.interest

    def note(self, action: Any, observation: Any, belief: Belief, seconds: tuple[float, float, float]) -> None:
        model = self.engine.model
        for name, value in as_dict(action, model.action_names, "action").items():
            self._put(name, value)
        for name, value in as_dict(observation, model.observation_names, "observation").items():
            self._put(name, value)
        self._put("entropy", belief.entropy())
        self._put("log_evidence", belief.log_evidence)
        for name in self.interest:
            suffix = "" if len(self.interest) == 1 else f"_{name}"
            marginal = belief.marginal(name)
            if isinstance(marginal, Marginal):
                self._put(f"marginal{suffix}", marginal.probs)
            else:
                self._put(f"mean{suffix}", marginal.mean)
                self._put(f"variance{suffix}", marginal.variance)
        self.seconds.append(seconds)

    def truth(self, values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            self._put(f"truth_{name}", value)

    def _put(self, name: str, value: Any) -> None:
        array = np.asarray(value)
        if self.batch is not None and array.shape == self.shapes.get(name):
            array = np.broadcast_to(array, (self.batch, *array.shape))
        self.columns.setdefault(name, []).append(array[None] if self.single else array)

    def dataset(self) -> xr.Dataset:
        variables = {}
        for name, column in self.columns.items():
            stacked = np.stack(np.broadcast_arrays(*column), 1)
            inner = [f"{name}_{i}" if stacked.ndim > 3 else f"{name}_value" for i in range(stacked.ndim - 2)]
            variables[name] = (("episode", "time", *inner), stacked)
        for label, column in zip(("act", "body", "update"), zip(*self.seconds, strict=True), strict=True):
            variables[f"{label}_seconds"] = (("time",), np.asarray(column))
        steps = len(self.seconds)
        data = xr.Dataset(variables, coords={"time": np.arange(1, steps + 1)})
        data.attrs = {"model": repr(self.engine.model), "interest": ", ".join(self.interest)}
        return data
