"""Particles of everything that is hidden: for any model that can be drawn and scored (thesis ch. 6, section 6.4.3)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from apmodels import Model
from apmodels.simulation import Values
from apmodels.structure import Structure
from inference.engine import Bid
from inference.rao_blackwell import RaoBlackwell
from inference.worlds.bank import Bank
from inference.worlds.gaussian import Gaussian
from inference.worlds.plan import Plan, make_plan
from inference.worlds.step import Step, drawn, flat


class Particles(RaoBlackwell):
    """A particle filter: every hidden variable has a value in every particle.

    Where the structure allows it, states are drawn as what is seen suggests: the states that are Gaussian or finite
    given the rest are conditioned on the observation before they are drawn (the locally optimal proposal).

    Args:
        model: see Engine.
        particles: how many.
        dtype: see Engine.
        seed: see RaoBlackwell.
        threshold: resample below this share of effective particles.
        guided: False for a bootstrap filter, which draws states from their prior.
    """

    def __init__(
        self,
        model: Model,
        particles: int = 10_000,
        dtype: torch.dtype | None = None,
        seed: int = 0,
        threshold: float = 0.5,
        guided: bool = True,
    ):
        super().__init__(model, max(particles, 2) if particles else particles, (), dtype, seed, threshold)
        guide = make_plan(self.structure, model.declaration.names["static"])
        states = {name for name in guide.worlds if self.roles[name] == "state"}
        useful = guided and any(self.roles[n] == "state" for n in (*guide.integrated, *guide.finite))
        self.guide = _Guide(model, guide, self.dtype) if useful and states < self._states() else None

    def _states(self) -> set[str]:
        return {name for name in self.plan.worlds if self.roles[name] == "state"}

    def divide(self, structure: Structure, given: str | Iterable[str]) -> Plan:
        """Return the plan in which everything is sampled."""
        return make_plan(structure, [node.name for node in structure.hidden if node.random])

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve any model."""
        return Bid(0.4, "all that is hidden is drawn and scored")

    def propagate(self, step: Step, seen: Values) -> Step:
        """Draw the particles' states, guided by what is seen, and weigh them."""
        if self.guide is None:
            return super().propagate(step, seen)
        score, values = self.guide.draw_states(step, seen)
        for name in self.model.declaration.names["state"]:
            if name in self.plan.worlds:
                step.frame.values[name, 0] = values[name, 0]
            elif name in self.plan.computed:
                lead = step.frame.lead(self._parents(name))
                step.frame.values[name, 0] = step.frame.in_all(self.laws, name, lead)  # type: ignore[assignment]
        step.score = step.score + score
        return step


class _Guide(Bank):
    """What is known of the next states of particles whose last ones have values."""

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        return Bid(1.0, "no engine of its own")

    def update(self, belief: Any, action: Any, observation: Any) -> Any:
        raise TypeError("a guide holds no beliefs")

    def draw_states(self, step: Step, seen: Values) -> tuple[Tensor, dict[tuple[str, int], Tensor]]:
        """Return how well what is seen was expected, (rows, particles), and the states drawn, by (name, lag)."""
        frame, lead = step.frame, step.lead
        zero = torch.zeros(lead, dtype=self.dtype)
        here = Step(type(frame)(frame.values), lead, [], [], [], None, zero, zero)
        for block in self.gaussians:
            values = [flat(frame.values[name, 1]).expand(*lead, -1) for name in block.carried]
            mean = torch.cat(values, -1).to(self.dtype) if values else torch.zeros(*lead, 0, dtype=self.dtype)
            size = mean.shape[-1]
            here.gaussian.append(Gaussian(mean, torch.zeros(1, 1, size, size, dtype=torch.float64)))
        for block in self.images:
            images = {name: (frame.values[name, 1], torch.zeros_like(frame.values[name, 1])) for name in block.carried}
            here.fields.append(images)
        if self.summed is not None:
            befores: dict[str, str | Tensor] = {axis.name: frame.values[axis.name, 1] for axis in self.summed.previous}
            here.finite, _ = self.summed.start(frame, befores, lead)
        self.move(here)
        self.sense(here, seen)
        self._draw_all(here)
        return here.score, here.frame.values

    def _draw_all(self, here: Step) -> None:
        for block, belief in zip(self.gaussians, here.gaussian, strict=True):
            vector = drawn(belief, here.lead)
            for name, lag in block.last:
                width = self.linear.size(name)
                shape = self.structure.nodes[name].shape
                here.frame.values[name, lag] = vector[..., :width].reshape(*here.lead, *shape)
                vector = vector[..., width:]
        for images in here.fields:
            for name, (mean, variance) in images.items():
                noise = torch.randn(*here.lead, *mean.shape[2:], dtype=mean.dtype)
                here.frame.values[name, 0] = mean + variance.sqrt() * noise
        if self.summed is not None and here.finite is not None:
            flat = here.finite.flatten(2)
            cell = (flat - torch.log(-torch.log(torch.rand(flat.shape, dtype=flat.dtype)))).argmax(-1)
            for axis, at in zip(self.summed.axes, torch.unravel_index(cell, self.summed.sizes), strict=True):
                here.frame.values[axis.name, 0] = axis.values[at]
