"""By how much an image has been moved: every offset of a lattice is scored at once (thesis eqs 6.34 to 6.40)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from apmodels.simulation import Values
from apmodels.structure import Structure
from inference.worlds.cut import APART, FAR
from inference.worlds.field_block import FieldBlock, Images
from inference.worlds.frame import Frame
from inference.worlds.gaussian import Gaussian
from inference.worlds.plan import Plan

# A displacement is looked for within so many of its standard deviations.
REACH = 2.5


class NoTranslation(Exception):
    """What a variable does to an image is no whole-pixel translation of all of it."""


class NothingSeen(Exception):
    """The image is out of sight wherever it is expected to have been moved to: there is nothing to score."""


@dataclass(frozen=True)
class Displacement:
    """A sampled variable (horizontal, vertical) that moves what is seen of an image, and by nothing but that."""

    name: str
    field: int
    seen: str


def displacements(structure: Structure, plan: Plan, images: list[FieldBlock]) -> list[Displacement]:
    """Return what may be a displacement, by the graph: the last that is sampled before one image is seen."""
    drawn = [name for name in plan.worlds if structure.nodes[name].role == "state"]
    found = []
    for i, block in enumerate(images):
        last = [name for name in drawn if structure.nodes[name].values is None][-1:]
        if last and len(block.seen) == 1 and structure.nodes[last[0]].shape == (2,):
            reached = follow(structure, last[0])
            # What else is drawn must be there before the offsets are scored.
            if block.seen[0] in reached and not (reached & set(drawn)) - {last[0]}:
                found.append(Displacement(last[0], i, block.seen[0]))
    return found


def follow(structure: Structure, name: str) -> set[str]:
    """Return a variable and all that follows from it within a step."""
    reached = {name}
    for other in structure.nodes:
        if any(arrow.parent in reached and not arrow.lag for arrow in structure.into(other)):
            reached.add(other)
    return reached


def offset_scores(seen: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """Return log p(image) for every place in a larger image where it may be seen, nats.

    Three correlations by FFT, instead of one sum over pixels for each offset.

    Args:
        seen: (*batch, h, w); NaN is missing.
        mean: of what is seen there, (*batch, H, W), H >= h and W >= w.
        variance: likewise; above 0.

    Returns:
        (*batch, H - h + 1, W - w + 1), by the row and column of the upper left pixel.
    """
    there = ~torch.isnan(seen)
    # Centred, so that nothing large cancels.
    middle = torch.where(there, seen, 0.0).sum() / there.sum().clamp(min=1)
    y, m = torch.where(there, seen - middle, 0.0), mean - middle
    weight = 1 / variance
    shape = [int(next_fast_len(n, real=True) or n) for n in mean.shape[-2:]]

    def wave(image: Tensor) -> Tensor:
        return torch.fft.rfft2(image, s=shape)

    flat = m * m * weight + variance.log() + math.log(2 * math.pi)
    total = wave(y * y).conj() * wave(weight) - 2 * wave(y).conj() * wave(m * weight)
    total = total + wave(there.to(y.dtype)).conj() * wave(flat)
    rows, columns = (large - small + 1 for large, small in zip(mean.shape[-2:], seen.shape[-2:], strict=True))
    return -0.5 * torch.fft.irfft2(total, s=shape)[..., :rows, :columns]


class Offsets:
    """Where the image of one field block may have been moved to by a displacement.

    How a displacement moves the image is found by moving images of coordinates: the engine knows no model, and a law
    may shift the image itself, or the window through which it is seen.
    """

    def __init__(self, bank: Any, displacement: Displacement):
        self.bank, self.block = bank, bank.images[displacement.field]
        self.name, self.seen, self.field = displacement.name, displacement.seen, displacement.field
        # Mean and variance of what comes in from outside, (rows or 1, worlds or 1), once it is known.
        self.outside: tuple[Tensor, Tensor] | None = None
        # Whether the image moves, if at all, in the same way at every step; then coordinates are moved once.
        parents = [p for state in self.block.states for p in bank.laws.variables[state].parents]
        self.still = all(p.name in self.block.group for p in parents)
        self.moved: Images | None = None
        self.alike: tuple[Tensor, Tensor] | None = None
        self.sign = 0

    def choose(self, step: Any, prior: Gaussian, seen: Values, best: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (rows, worlds, 2) and, for each, log q(pixel) by which it was chosen and log p(pixel).

        A pixel is drawn from what is believed of it once the image has been seen, and the value anywhere in it; or the
        value is the middle of the best pixel.
        """
        mean = prior.mean.expand(*step.lead, 2).double()
        # Of a whole pixel: the density in its middle, were the value spread by as much as a pixel is.
        covariance = prior.covariance.expand(*step.lead, 2, 2).double() + torch.eye(2, dtype=torch.float64) / 12
        joint, log_prior, (near, across, down) = self._lattice(step, mean, covariance, seen[self.seen])
        total = joint.logsumexp(-1, keepdim=True)
        if best:
            at = joint.argmax(-1, keepdim=True)
        else:
            at = torch.distributions.Categorical(logits=joint - total, validate_args=False).sample()[..., None]
        row, column = at[..., 0] // len(across), at[..., 0] % len(across)
        value = near + torch.stack([across[column], down[row]], -1)
        if not best:
            value = value + torch.rand(value.shape, dtype=value.dtype) - 0.5
        chosen, expected = (joint - total).gather(-1, at), log_prior.gather(-1, at)
        return tuple(part.to(self.bank.dtype) for part in (value, chosen[..., 0], expected[..., 0]))  # type: ignore

    def _lattice(self, step: Any, mean: Tensor, covariance: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Any]:
        """log p(pixel, image) and log p(pixel), (rows, worlds, pixels), row by row; and where the pixels are."""
        images = step.fields[self.field]
        field_mean, field_variance = images[next(iter(images)) if len(images) == 1 else self.block.carried[0]]
        near, reach = mean.round(), self._reach(covariance, field_mean.shape[-2:])
        base, noise = self._base(step, near.to(self.bank.dtype), field_mean.shape[-2:])
        variance = field_variance + noise[..., None, None]
        scores = offset_scores(seen, *self._region(field_mean, variance, base, reach, step.lead))
        if self.sign > 0:
            # What moves to the right was further left before.
            scores = scores.flip(-2, -1)
        across, down = (torch.arange(-n, n + 1, dtype=torch.float64) for n in reach)
        apart = near - mean
        x, y = (apart[..., 0, None] + across)[..., None, :], (apart[..., 1, None] + down)[..., :, None]
        precision = torch.linalg.inv(covariance)[..., None, None]
        square = precision[..., 0, 0, :, :] * x * x + precision[..., 1, 1, :, :] * y * y
        square = square + 2 * precision[..., 0, 1, :, :] * x * y
        log_prior = -0.5 * (square + (covariance.logdet() + 2 * math.log(2 * math.pi))[..., None, None])
        return (scores.double() + log_prior).flatten(2), log_prior.flatten(2), (near, across, down)

    def _reach(self, covariance: Tensor, shape: Any) -> tuple[int, int]:
        """How far to look, (columns, rows): the uncertainty says, and no farther than the image is large."""
        far = (REACH * covariance.diagonal(dim1=-2, dim2=-1).sqrt()).amax((0, 1)).ceil() + 1
        return min(int(far[0]), int(shape[-1])), min(int(far[1]), int(shape[-2]))

    def _predicted(self, step: Any, value: Tensor) -> tuple[Tensor, Tensor]:
        """What would be seen, mean and variance, had the displacement this value and the image its own coordinates."""
        bank, values = self.bank, dict(step.frame.values)
        values[self.name, 0] = value
        frame = Frame(values)
        for name in bank.plan.computed:
            if bank.roles[name] == "state":
                keys = [(p.name, p.lag) for p in bank.laws.variables[name].parents]
                frame.values[name, 0] = frame.in_all(bank.laws, name, frame.lead(keys))  # type: ignore[assignment]
        if not self.still or self.moved is None:
            self.moved = moved = self.block.moved(self._coordinates(step), frame)
            source = next(p.name for p in bank.laws.variables[self.seen].parents if p.name in self.block.group)
            least, most = torch.aminmax(moved[source][1].flatten(2), dim=-1)
            self.alike = (moved[source][0], least[..., None, None]) if torch.equal(least, most) else None
        if self.alike is None:
            return self.block.shown(self.seen, self.moved, frame)
        # All pixels have become as uncertain as each other: where one is shown, that is added.
        numbers, uncertain = self.alike
        centre, noise = self.block.law(self.seen, frame, numbers)
        return centre, noise + torch.where(centre >= FAR - 0.5, uncertain, 0.0)

    def _coordinates(self, step: Any) -> Images:
        """Images of pixels' numbers, row by row, of which all are certain."""
        images: Images = {}
        for name, (old, _) in step.fields[self.field].items():
            if old.shape[2:].numel() + FAR > 1 / torch.finfo(old.dtype).eps:
                raise NoTranslation(f"{name} has more pixels than can be numbered")
            numbers = torch.arange(old.shape[2:].numel(), dtype=old.dtype).reshape(1, 1, *old.shape[2:]) + FAR
            images[name] = numbers, torch.zeros_like(numbers)
        return images

    def _base(self, step: Any, value: Tensor, shape: Any) -> tuple[Tensor, Tensor]:
        """Where what is seen begins in the image, (rows, worlds, 2) as (row, column), and the noise on the way."""
        corner, noise, seen = self._corner(step, value, shape)
        if not bool(seen.any()):
            raise NothingSeen(f"nothing is seen of the image where {self.name} is {value.flatten(0, 1)[0].tolist()}")
        if self.outside is None or not self.still:
            self._learn(step, value, corner, shape, seen)
        return corner, noise

    def _corner(self, step: Any, value: Tensor, shape: Any) -> tuple[Tensor, Tensor, Tensor]:
        """The corner (rows, worlds, 2), the noise and whether anything is seen at all (rows or 1, worlds or 1)."""
        centre, spread = self._predicted(step, value)
        # A grid of pixels shows where the image is; all of them are looked at once, when it is new how they move.
        apart = 1 if self.outside is None else APART
        centre, spread = centre[..., ::apart, ::apart], spread[..., ::apart, ::apart]
        inside, number = centre >= FAR - 0.5, (centre - FAR).round().long()
        some = inside.flatten(2).any(-1)
        found = []
        for axis, place in enumerate((number // shape[1], number % shape[1])):
            line = apart * torch.arange(centre.shape[2 + axis])
            origin = place - (line[:, None] if axis == 0 else line)
            low = torch.where(inside, origin, shape[axis] + 1).amin((-2, -1))
            high = torch.where(inside, origin, -apart * centre.shape[2 + axis] - 1).amax((-2, -1))
            if not torch.equal(low[some], high[some]):
                raise NoTranslation(f"{self.name} does more to {self.seen} than to move it")
            # Where nothing is seen, it is all far away.
            found.append(torch.where(some, low, int(10 * FAR)))
        spread = spread.expand_as(centre)
        least = torch.where(inside, spread, torch.inf).amin((-2, -1))
        if not torch.equal(least[some], torch.where(inside, spread, -torch.inf).amax((-2, -1))[some]):
            raise NoTranslation(f"the noise of {self.seen} is not the same in all of it")
        return torch.stack(found, -1).expand(*step.lead, 2), torch.where(some, least, 0.0), some

    def _learn(self, step: Any, near: Tensor, base: Tensor, shape: Any, seen: Tensor) -> None:
        """Find out which way the displacement moves the image, and what comes in from outside."""
        moved = torch.tensor([3.0, -2.0], dtype=near.dtype)
        if not self.sign:
            corner, _, still = self._corner(step, near + moved, shape)
            change = (corner - base)[(seen & still).expand(step.lead)]
            for sign in (1, -1):
                if len(change) and bool((change == -sign * moved.flip(0)).all()):
                    self.sign = sign
            if not self.sign:
                raise NoTranslation(f"{self.name} does not move {self.seen} by whole pixels")
        parts = []
        for part in self._predicted(step, near + 10 * FAR):
            first = part.flatten(2)[..., 0]
            if bool((part != first[..., None, None]).any()):
                raise NoTranslation(f"what comes into {self.seen} from outside is not all alike")
            parts.append(first)
        if bool((parts[0] >= FAR - 0.5).any()):
            raise NoTranslation(f"{self.seen} is of the image however far {self.name} moves it")
        self.outside = parts[0], parts[1]

    def _region(
        self, mean: Tensor, variance: Tensor, base: Tensor, reach: tuple[int, int], lead: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """The part of the image that may be seen, mean and variance, (rows, worlds, h + 2 down, w + 2 across)."""
        assert self.outside is not None
        height, width = mean.shape[-2:]
        size = self.bank.structure.nodes[self.seen].shape
        across, down = reach
        rows = (base[..., 0] - down)[..., None] + torch.arange(size[0] + 2 * down)
        columns = (base[..., 1] - across)[..., None] + torch.arange(size[1] + 2 * across)
        inside = ((rows >= 0) & (rows < height))[..., :, None] & ((columns >= 0) & (columns < width))[..., None, :]
        at = rows.clamp(0, height - 1)[..., :, None] * width + columns.clamp(0, width - 1)[..., None, :]
        parts = []
        for image, fill in zip((mean, variance), self.outside, strict=True):
            flat = image.expand(*lead, height, width).flatten(2)
            picked = flat.gather(2, at.flatten(2)).reshape(inside.shape)
            parts.append(torch.where(inside, picked, fill[..., None, None]))
        return parts[0], parts[1]
