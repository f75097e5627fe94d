"""A guide that is learned once, from simulated records, and then serves every record at once.

A recurrent network reads the record in both directions, and says of every continuous variable, in unconstrained space,
a mean and a spread. It is taught by the model itself: records are simulated, and what was hidden in them is to be
found likely (the inclusive divergence; no record of the world is needed).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import biject_to

from apmodels.distributions import base_of
from apmodels.progress import tracked
from apmodels.simulation import Values
from inference.guides.posterior_draws import Proposal

WIDTH = 64


class Amortised(nn.Module):
    """The network, for one model. ``names`` are the continuous random variables, statics first."""

    def __init__(self, model: Any, names: list[str]):
        super().__init__()
        self.model = model
        nodes = model.structure.nodes
        self.statics = [name for name in names if nodes[name].role == "static"]
        self.states = [name for name in names if nodes[name].role == "state"]
        self.shapes = {name: tuple(nodes[name].shape) for name in names}
        record = model.simulate(2, batch=64, seed=0)
        self.ways = {name: _way(model, name) for name in names}
        self.free = {name: tuple(self._unbounded(name, record[name]).shape[self._lead(name) :]) for name in names}
        inputs = self._inputs(record)
        self.register_buffer("centre", inputs.flatten(0, 1).mean(0))
        self.register_buffer("spread", inputs.flatten(0, 1).std(0) + 1e-3)
        self.reader = nn.GRU(inputs.shape[-1], WIDTH, batch_first=True, bidirectional=True)
        self.of_statics, self.of_states = (self._head(names) for names in (self.statics, self.states))

    def _head(self, names: list[str]) -> nn.Module:
        size = max(1, self._size(names))
        return nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.ELU(), nn.Linear(WIDTH, 2 * size))

    def learn(self, steps: int, rounds: int, records: int, rate: float, seed: int) -> list[float]:
        """Learn from simulated records of up to so many steps; return the loss of every round, nats."""
        optimiser = torch.optim.Adam(self.parameters(), rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, rounds)
        losses = []
        for k in tracked(range(rounds), "learning"):
            length = 1 + (k * 7919) % steps
            record = self.model.simulate(length, batch=records, seed=seed + k)
            loss = -self._likely(record).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.parameters(), 10.0)
            optimiser.step()
            schedule.step()
            losses.append(float(loss.detach()))
        return losses

    def proposal(self, actions: Values, seen: Values) -> Proposal:
        """Return what is proposed for records (rows, steps, *shape) by name."""
        with torch.no_grad():
            static, timed = self(self._inputs({**actions, **seen}))
        centre = torch.cat([static[0], timed[0].flatten(1)], 1)
        scale = torch.cat([static[1], timed[1].flatten(1)], 1).exp()
        sites = [(name, self.free[name], self.ways[name]) for name in self.statics]
        for t in range(timed[0].shape[1]):
            sites += [(f"{name}_{t + 1}", self.free[name], self.ways[name]) for name in self.states]
        return Proposal(centre, torch.diag_embed(scale), sites)

    def forward(self, inputs: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Return (mean, log spread) of the statics (rows, D), and of the states (rows, steps, D)."""
        centre, spread = self.get_buffer("centre"), self.get_buffer("spread")
        read, _ = self.reader((inputs - centre) / spread)
        whole = torch.cat([read[:, -1, :WIDTH], read[:, 0, WIDTH:]], -1)
        heads = (self.of_statics(whole), self._size(self.statics)), (self.of_states(read), self._size(self.states))
        static, timed = (tuple(part[..., :size] for part in found.chunk(2, -1)) for found, size in heads)
        return static, timed

    def _likely(self, record: Values) -> Tensor:
        """log q of what was hidden in simulated records, (rows,)."""
        rows = len(next(iter(record.values())))
        static, timed = self(self._inputs(record))
        total = torch.zeros(rows)
        for names, (mean, log_spread), lead in ((self.statics, static, 1), (self.states, timed, 2)):
            if names:
                free = [self._unbounded(name, record[name]) for name in names]
                truth = torch.cat([value.reshape(*value.shape[:lead], -1) for value in free], -1)
                score = -0.5 * ((truth - mean) / log_spread.exp()) ** 2 - log_spread - 0.9189385332046727
                total = total + score.flatten(1).sum(1)
        return total

    def _size(self, names: list[str]) -> int:
        return sum(torch.Size(self.free[name]).numel() for name in names)

    def _lead(self, name: str) -> int:
        return 1 if name in self.statics else 2

    def _unbounded(self, name: str, value: Tensor) -> Tensor:
        # At the very edge there is no unconstrained value.
        tiny = 1e-6
        bounded = type(self.ways[name]).__name__ in ("SigmoidTransform", "StickBreakingTransform")
        return self.ways[name].inv(value.clamp(tiny, 1 - tiny) if bounded else value)

    def _inputs(self, record: Values) -> Tensor:
        """What a record shows, (rows, steps, numbers): whole actions one by one, and which observations are missing."""
        parts = []
        for name in self.model.action_names:
            space = self.model.space(name)
            value = record[name]
            parts.append(nn.functional.one_hot(value.long(), space.size).float() if space.size else value.float())
        for name in self.model.observation_names:
            value = record[name].float()
            missing = torch.isnan(value)
            parts += [torch.where(missing, 0.0, value), missing.float()]
        lead = parts[-1].shape[:2]
        return torch.cat([part.reshape(*lead, -1) for part in parts], -1)


def _way(model: Any, name: str) -> Any:
    from apmodels.probing import Probe

    law: Any = base_of(Probe(model).laws_of[name])[0]
    return biject_to(law.support)
