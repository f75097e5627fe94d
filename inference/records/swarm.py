"""Particles of everything that is hidden, led along a whole record: what a step does is recorded, and replayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from apmodels.distributions import watched
from apmodels.simulation import Values, seeded
from inference.records.record import Record, alike, alone
from inference.records.recording import Recorder
from inference.worlds.frame import Frame, Key
from inference.worlds.step import BankBelief, Step


class Swarm:
    """The particles of an engine on their way along records.

    Args:
        engine: a RaoBlackwell.
    """

    def __init__(self, engine: Any):
        self.engine = engine
        self.names = [n for n in (*engine.plan.worlds, *engine.plan.computed) if engine.roles[n] == "state"]
        self.recorders: dict[tuple[Key, ...], Recorder] = {}
        self.plain = engine.guide is None and not (engine.plan.integrated or engine.plan.finite)

    def along(self, record: Record, batch: int | None) -> Sequence[BankBelief]:
        """Return the beliefs along a record, which are those of ``update``, step by step."""
        engine = self.engine
        belief = engine.start(batch)
        if not self.plain or engine.particles == 1 or belief.past is not None or record.steps < 2:
            return engine.stepwise(belief, record)
        rows = len(belief.log_weights)
        actions, seen = record.checked(engine, rows)
        context, kept = engine.known.along(actions, seen, record.steps, rows)
        context = {key: alike(value)[:, :, None] for key, value in context.items()}
        beliefs: list[BankBelief] = []
        with seeded(0), alone(belief.log_weights.numel()):
            many = None
            for t in range(record.steps):
                torch.default_generator.manual_seed(engine.seed * 1_000_003 + belief.time + 1)
                belief = engine.refreshed(belief, many)
                here = {key: value[t] for key, value in context.items()}
                step = self.step(belief, here, {name: value[t][:, None] for name, value in seen.items()})
                belief = engine.made(belief, step, {}, belief.log_weights + step.score, {}, kept[t])
                many = engine.watched(belief)
                beliefs.append(belief)
        return beliefs

    def step(self, belief: BankBelief, context: dict[Key, Tensor], seen: Values) -> Step:
        """Draw the particles' states, and weigh them."""
        engine = self.engine
        values = dict(context)
        values |= {(n, 0 if engine.roles[n] == "static" else 1): v for n, v in belief.values.items()}
        lead = (belief.log_weights.shape[0], belief.log_weights.shape[1])
        keys = (*values, *((name, 0) for name in seen))
        if keys not in self.recorders:
            self.recorders[keys] = Recorder(self._function(keys, lead))
        state = torch.get_rng_state()
        *found, score, good = self.recorders[keys](*values.values(), *seen.values())
        if not bool(good):
            # Once more, to be told what is out of range, and where.
            torch.set_rng_state(state)
            self._moved(Frame(values), lead, seen)
        frame = Frame(values | {(name, 0): value for name, value in zip(self.names, found, strict=True)})
        return Step(frame, lead, [], [], [], None, score, score)

    def _function(self, keys: tuple[Key, ...], lead: tuple[int, int]) -> Any:
        def function(*arguments: Tensor) -> tuple[Tensor, ...]:
            given = dict(zip(keys, arguments, strict=True))
            seen = {name: given.pop((name, 0)) for name in self.engine.model.observation_names}
            with watched() as good:
                step = self._moved(Frame(given), lead, seen)
            sound = torch.stack(good).all() if good else torch.tensor(True)
            return *(step.frame.values[name, 0] for name in self.names), step.score, sound

        return function

    def _moved(self, frame: Frame, lead: tuple[int, int], seen: Values) -> Step:
        zero = torch.zeros(lead, dtype=self.engine.dtype)
        step = Step(frame, lead, [], [], [], None, zero, zero)
        self.engine.move(step)
        self.engine.sense(step, seen)
        return step
