"""An image of independent pixels that is only ever moved: two images, a mean and a variance.

What a move does to means it does to variances; the way back, from what is seen to where it was, is the move's own
derivative (thesis eqs 6.31 to 6.40).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of
from apmodels.laws import Laws
from inference.worlds.cut import Cut, log_density, see_cut
from inference.worlds.frame import Frame

# Image by variable: the mean and the variance, (b, n, *shape).
Images = dict[str, tuple[Tensor, Tensor]]


class FieldBlock:
    """The mean and variance of the image of a group; of a state, perhaps with a static that it begins as.

    What a state began as is forgotten in the first step: from then on the two depend on each other.
    """

    def __init__(self, laws: Laws, names: tuple[str, ...], seen: list[str], roles: dict[str, str], remembered: Any):
        self.laws, self.seen = laws, seen
        self.statics = [name for name in names if roles[name] == "static"]
        self.states = [name for name in names if roles[name] == "state"]
        self.carried = [name for name in self.states if name in remembered]
        self.group = set(names)
        # What every step adds to the variance of images that always move in the same way; and those that never move.
        self.added: dict[str, Tensor] = {}
        self.still: set[str] = set()
        self.cuts: dict[str, Cut] = {}

    def start(self, frame: Frame, befores: dict[str, str | Tensor]) -> Images:
        """Return the images before time began."""
        images: Images = {}
        for name in self.statics:
            images[name] = self._moved(name, frame, images, {})
        for name in self.carried:
            before = befores[name]
            if isinstance(before, str):
                images[name] = images[before]
            else:
                before = before.to(self.laws.dtype)
                images[name] = before, torch.zeros_like(before)
        return images

    def step(self, images: Images, frame: Frame, seen: dict[str, Tensor]) -> tuple[Images, Tensor]:
        """Move the images on and condition on what is seen; return the images and the score, (b, n)."""
        now = self.moved(images, frame)
        total = torch.zeros(1, 1, dtype=self.laws.dtype)
        for name in self.seen:
            source = next(p.name for p in self.laws.variables[name].parents if p.name in self.group)
            now[source], score = self._seen(name, source, frame, now[source], seen[name])
            total = total + score
        return now, total

    def imagine(self, images: Images, frame: Frame, lead: tuple[int, int]) -> dict[str, Tensor]:
        """Draw what would be seen after a step, (*lead, *shape) by name."""
        now = self.moved(images, frame)
        seen = {}
        for name in self.seen:
            centre, spread = self.shown(name, now, frame)
            seen[name] = centre + spread.sqrt() * torch.randn(*lead, *centre.shape[2:], dtype=centre.dtype)
        return seen

    def predicted(self, name: str, images: Images, frame: Frame) -> tuple[Tensor, Tensor]:
        """Return the mean and the variance of what would be seen after a step."""
        return self.shown(name, self.moved(images, frame), frame)

    def moved(self, images: Images, frame: Frame) -> Images:
        """Return the images after a step, before anything is seen of them."""
        now = self._now(images)
        for name in self.states:
            now[name] = self._moved(name, frame, now, images)
        return now

    def _now(self, images: Images) -> Images:
        """What of the last step is still there in this one."""
        return {} if self.states else {name: images[name] for name in self.statics}

    def shown(self, name: str, now: Images, frame: Frame) -> tuple[Tensor, Tensor]:
        """Return the mean and the variance of an observation of images."""
        source = next(p.name for p in self.laws.variables[name].parents if p.name in self.group)
        mean, variance = now[source]
        centre, noise = self.law(name, frame, mean)
        nothing, _ = self.law(name, frame, torch.zeros_like(mean))
        spread, _ = self.law(name, frame, variance)
        return centre, spread - nothing + noise

    def law(self, name: str, frame: Frame, image: Tensor | None) -> tuple[Tensor, Tensor]:
        """A law's mean and variance where its parent in the group is ``image``, (b, n, *shape)."""
        values = dict(frame.values)
        for parent in self.laws.variables[name].parents:
            if parent.name in self.group and image is not None:
                values[parent.name, parent.lag] = image
        here = Frame(values)
        keys = [(p.name, p.lag) for p in self.laws.variables[name].parents]
        law = here.in_all(self.laws, name, here.lead(keys))
        if not isinstance(law, Distribution):
            return law, torch.zeros_like(law)
        base, _ = base_of(law)
        return base.loc, base.scale**2

    def _moved(self, name: str, frame: Frame, now: Images, past: Images) -> tuple[Tensor, Tensor]:
        source = next((p for p in self.laws.variables[name].parents if p.name in self.group), None)
        if source is None:
            return self.law(name, frame, None)
        mean, variance = (past if source.lag else now)[source.name]
        if name in self.still:
            return mean, variance + self.added[name]
        centre, noise = self.law(name, frame, mean)
        spread, _ = self.law(name, frame, variance)
        return centre, spread + self._added(name, frame, mean, noise)

    def _added(self, name: str, frame: Frame, mean: Tensor, noise: Tensor) -> Tensor:
        """The noise that a law adds, less what it makes of an image that is zero; once, if nothing else bears on it."""
        if name in self.added:
            return self.added[name]
        nothing, _ = self.law(name, frame, torch.zeros_like(mean))
        added = noise - nothing
        if all(p.name in self.group for p in self.laws.variables[name].parents) and not added.requires_grad:
            self.added[name] = added[:1, :1]
            numbers = torch.arange(mean[0, 0].numel(), dtype=mean.dtype).reshape(1, 1, *mean.shape[2:])
            if torch.equal(self.law(name, frame, numbers)[0], numbers):
                self.still.add(name)
        return added

    def _seen(
        self, name: str, source: str, frame: Frame, image: tuple[Tensor, Tensor], value: Tensor
    ) -> tuple[tuple[Tensor, Tensor], Tensor]:
        cut = self.cuts.setdefault(name, Cut()).find(lambda numbers: self.law(name, frame, numbers), image[0])
        if cut is not None:
            # An image that never moves got a new variance in this step, which is nobody else's.
            return see_cut(cut, image, value, own=source in self.still and source in self.states)
        mean, variance = image
        centre, spread = self.shown(name, {source: image}, frame)
        lead = torch.broadcast_shapes(centre.shape[:2], value.shape[:2])
        missing = torch.isnan(value)
        surprise = torch.where(missing, 0.0, value - centre)
        weight = torch.where(missing, 0.0, 1 / spread)
        wide = mean.expand(*lead, *mean.shape[2:]), variance.expand(*lead, *variance.shape[2:])
        back = self._back(name, frame, wide[0])
        after = wide[0] + wide[1] * back(surprise * weight)
        shrunk = wide[1] - wide[1] ** 2 * back(weight.expand(*lead, *weight.shape[2:]))
        return (after, shrunk.clamp(min=0)), log_density(surprise, weight, spread, missing)

    def _back(self, name: str, frame: Frame, image: Tensor) -> Any:
        """The way from what is seen to where it was: the transpose of the move."""
        back: Any = torch.func.vjp(lambda x: self.law(name, frame, x)[0].expand(*image.shape[:2], -1, -1), image)[1]
        return lambda value: back(value)[0]
