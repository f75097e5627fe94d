"""Distributions as trees of tensors, so that a law written for one world can be evaluated for many.

A distribution is taken apart into its tensors and put together again around tensors with leading dimensions;
nothing here knows one family from another.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, constraints
from torch.distributions.transforms import Transform

from apmodels.errors import ValueOutOfRange
from apmodels.evidence import Evidence
from apmodels.planted import Planted, elementwise_log_prob


@contextmanager
def unvalidated() -> Iterator[None]:
    """Build distributions without checking their parameters; inside vmap nothing can be checked."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def rebuilt(thing: Any, visit: Callable[[Tensor], Tensor], lead: tuple[int, ...] = (), drop: int = 0) -> Any:
    """Return a copy in which each tensor t is ``visit(t)``, and ``lead`` replaces ``drop`` batch dimensions."""
    if isinstance(thing, Tensor):
        return visit(thing)
    if isinstance(thing, (list, tuple)) and not isinstance(thing, torch.Size):
        return type(thing)(rebuilt(part, visit, lead, drop) for part in thing)
    if isinstance(thing, (Distribution, Transform)):
        new = copy.copy(thing)
        new.__dict__.update({key: rebuilt(value, visit, lead, drop) for key, value in vars(thing).items()})
        if isinstance(new, Distribution):
            new._batch_shape = torch.Size(lead) + new._batch_shape[drop:]
        return new
    return thing


def tensors(thing: Any) -> list[Tensor]:
    """Return the tensors of a distribution in a fixed order."""
    found: list[Tensor] = []

    def note(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    rebuilt(thing, note)
    return found


def with_tensors(thing: Any, parts: list[Tensor] | tuple[Tensor, ...], lead: tuple[int, ...], drop: int = 0) -> Any:
    """Return ``thing`` around other tensors, each with ``lead`` instead of its first ``drop`` dimensions."""
    remaining = iter(parts)
    return rebuilt(thing, lambda _: next(remaining), lead, drop)


def picked(law: Any, index: Any, lead: tuple[int, ...], drop: int) -> Any:
    """Return a batch of laws indexed in its first ``drop`` batch dimensions, which become ``lead``."""
    return with_tensors(law, [part[index] for part in tensors(law)], lead, drop)


def compact(value: Tensor) -> Tensor:
    """Return an expanded tensor with size 1 where it only repeats itself."""
    for dim, (size, stride) in enumerate(zip(value.shape, value.stride(), strict=True)):
        if size > 1 and stride == 0:
            value = value.narrow(dim, 0, 1)
    return value


def base_of(distribution: Any) -> tuple[Any, int]:
    """Strip ``to_event``: return the elementwise distribution and the number of event dimensions added."""
    added = 0
    while isinstance(distribution, Independent):
        added += distribution.reinterpreted_batch_ndims
        distribution = distribution.base_dist
    return distribution, added


def log_prob_of(distribution: Any, value: Tensor) -> Tensor:
    """Return log p(value) in nats, in which what is NaN is missing.

    Elements may be missing one by one where they are independent; a joint law's value is missing as a whole, and
    one of which a part is missing scores NaN.
    """
    base, added = base_of(distribution)
    if isinstance(base, (Planted, Evidence)):
        return distribution.log_prob(value)
    if not len(base.event_shape):
        scores = elementwise_log_prob(base, value)
        return scores.sum(tuple(range(-added, 0))) if added else scores
    if not value.is_floating_point():
        return distribution.log_prob(value)
    missing = torch.isnan(value)
    gone = missing.flatten(-len(distribution.event_shape))
    scores = distribution.log_prob(torch.where(missing, 0.5, value))
    return torch.where(gone.all(-1), 0.0, torch.where(gone.any(-1), torch.nan, scores))


def family(distribution: Any) -> str:
    """Return the family's name: 'Normal', 'Categorical' ..."""
    return type(base_of(distribution)[0]).__name__


def parameters(distribution: Any) -> dict[str, Tensor]:
    """Return the parameters that were given to the elementwise distribution, by name."""
    base, _ = base_of(distribution)
    names = base.arg_constraints
    given = {name: vars(base)[name] for name in names if isinstance(vars(base).get(name), Tensor)}
    return given or {name: getattr(base, name) for name in names if name != "logits"}


def check_parameters(distribution: Any, where: str) -> None:
    """Raise ValueOutOfRange, naming ``where``, if a parameter violates its family's constraint."""
    base, _ = base_of(distribution)
    for part in vars(base).values():
        if isinstance(part, Distribution):
            check_parameters(part, where)
    for name, value in parameters(distribution).items():
        constraint = base.arg_constraints[name]
        if constraints.is_dependent(constraint):
            continue
        value = compact(value)
        good = _at_a_glance(constraint, value)
        if _watched is not None:
            _watched.append(constraint.check(value).all() if good is None else good)
            continue
        if good is not None and bool(good):
            continue
        # A NaN passes no constraint but those that ask nothing; an infinite location says nothing either.
        good = constraint.check(value)
        if name == "loc" or name == "probs":
            good = good & torch.isfinite(value).all(-1) if good.dim() < value.dim() else good & torch.isfinite(value)
        if not bool(good.all()):
            bad = value[~good] if good.shape == value.shape else value[~good].flatten()
            raise ValueOutOfRange(
                f"{where} is {type(base).__name__} with {name} = {bad.flatten()[0]:g}, "
                f"which is outside {words(constraint)}"
            )


def _at_a_glance(constraint: Any, value: Tensor) -> Tensor | None:
    """Whether a parameter is surely in range, in an operation or two; None where that takes a closer look."""
    if not value.numel() or not value.is_floating_point():
        return None
    kind = type(constraint).__name__.lstrip("_")
    if kind == "Real":
        # Of a number that is not finite, nothing is not zero.
        return value.sum() * 0 == 0
    if kind == "GreaterThan" and isinstance(constraint.lower_bound, (int, float)):
        return value.amin() > constraint.lower_bound
    return None


_watched: list[Tensor] | None = None


@contextmanager
def watched() -> Iterator[list[Tensor]]:
    """Collect whether parameters are in range, each a tensor of one truth value, instead of raising an error."""
    global _watched
    before, _watched = _watched, []
    try:
        yield _watched
    finally:
        _watched = before


def words(constraint: Any) -> str:
    """Say which values a constraint allows."""
    kind = type(constraint).__name__.lstrip("_")
    if kind == "IntegerInterval":
        return f"the whole numbers from {constraint.lower_bound} to {constraint.upper_bound}"
    named = {
        "Interval": "[0, 1]",
        "Boolean": "0 and 1",
        "GreaterThan": "the positive numbers",
        "GreaterThanEq": "the numbers from 0 up",
        "IntegerGreaterThan": "the whole numbers from 0 up",
        "Simplex": "the probabilities that sum to 1",
        "Real": "the finite numbers",
        "IndependentConstraint": "the finite numbers",
    }
    return named.get(kind, str(constraint))
