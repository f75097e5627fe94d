"""Finding the kind of an arrow by evaluating a law at random worlds.

All continuous parents move together: a product a·b is linear in each of them alone, and a kink may lie on one
side of the values that a prior usually gives, so laws are evaluated on lines through pairs of worlds, far beyond
both ends.
"""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of, family, parameters
from apmodels.errors import DeclarationError, ValueOutOfRange
from apmodels.evidence import Evidence
from apmodels.laws import Laws
from apmodels.simulation import Values, Worlds, seeded
from apmodels.transforms import recording_moves
from apmodels.variables import Parent, Variable

WORLDS = 24
STEPS = 4
# Where on the line through two worlds (0 and 1) a law is evaluated.
LINE = (0.0, 1.0, 0.37, -1.0, 2.6, -4.3, 11.0, -23.0, 61.0)
LARGEST_SUPPORT = 4096

Kind = tuple[str, str]


def support_of(law: Any) -> Tensor | None:
    """Return the finitely many values of a law, (size, *event shape), or None."""
    if not isinstance(law, Distribution):
        return None
    base, added = base_of(law)
    if not base.has_enumerate_support or isinstance(base, Evidence):
        return None
    try:
        if added == 0:
            return law.enumerate_support(expand=False)
        flat = type(base).enumerate_support(base, expand=False).flatten()
    except NotImplementedError:
        return None
    elements = torch.Size(law.event_shape).numel()
    if len(flat) ** elements > LARGEST_SUPPORT:
        return None
    return torch.cartesian_prod(*[flat] * elements).reshape(-1, *law.event_shape)


class _ProbedWorlds(Worlds):
    """Worlds whose observations need not be drawable."""

    laws_of: dict[str, Any]

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        if not hasattr(self, "laws_of"):
            self.laws_of = {}
        arguments = self.parents(variable, values)
        law = self.laws.one(variable.name, {name: value[0] for name, value in arguments.items()})
        self.laws_of[variable.name] = law
        if isinstance(law, Evidence):
            return torch.full((self.batch,), torch.nan)
        return super()._draw(variable, values)


class Probe:
    """Random worlds of one model after a few steps of random actions, and what its laws do there."""

    def __init__(self, model: Any):
        try:
            self._draw(model, torch.float64, 1e-7)
        except DeclarationError as error:
            # A field that is not a dataclass (a network, say) may keep its own precision.
            if "dtype" not in str(error) and "same type" not in str(error):
                raise
            self._draw(model, torch.float32, 1e-3)
        self.variables = model.declaration.variables

    def _draw(self, model: Any, dtype: torch.dtype, tolerance: float) -> None:
        self.laws = Laws(model, dtype)
        self.tolerance = tolerance
        with seeded(0):
            worlds = _ProbedWorlds(self.laws, WORLDS)
            for _ in range(STEPS):
                before = worlds.previous
                worlds.step({name: model.space(name).sample((WORLDS,)) for name in model.action_names})
        self.values, self.previous, self.laws_of = worlds.values, before, worlds.laws_of

    def is_random(self, name: str) -> bool:
        """Tell whether a variable's law is a distribution."""
        return isinstance(self.laws_of.get(name), Distribution)

    def kinds(self, child: Variable, continuous: list[Parent], conjugate: list[Parent]) -> dict[str, Kind]:
        """Return argument -> (kind, reason) for the continuous parents of a variable.

        ``conjugate`` are those of them that could be selected from: a Beta above a Bernoulli, and so on.
        """
        if not continuous:
            return {}
        if conjugate and self._selects(child, continuous, conjugate):
            chosen = {p.argument: ("selects", "its probability is one of the components") for p in conjugate}
            rest = [p for p in continuous if p not in conjugate]
            return chosen | {p.argument: ("affine", "without effect at every probed world") for p in rest}
        law = self.laws_of[child.name]
        if isinstance(law, Distribution) and family(law) not in ("Normal", "MultivariateNormal"):
            return {p.argument: ("nonlinear", f"a {family(law)} of a continuous variable") for p in continuous}
        return self._linearity(child, continuous)

    def _linearity(self, child: Variable, continuous: list[Parent]) -> dict[str, Kind]:
        kinds: dict[str, Kind] = {}
        rest = []
        for parent in continuous:
            if self._is_affine(child, [parent]):
                rest.append(parent)
            else:
                kinds[parent.argument] = ("nonlinear", "not affine in it, all else fixed")
        # Bilinear laws: sample as few and as small parents as make the others affine together.
        for count in range(len(rest) + 1):
            sets = sorted(itertools.combinations(rest, count), key=lambda some: sum(map(self._numel, some)))
            for some in sets:
                kept = [p for p in rest if p not in some]
                if not kept or self._is_affine(child, kept):
                    given = [p.argument for p in continuous if p not in kept]
                    for p in some:
                        kinds[p.argument] = ("nonlinear", f"multiplies {', '.join(q.argument for q in kept)}")
                    reason = f"given {', '.join(given)}" if given else "constant slope, constant spread"
                    return kinds | {p.argument: (self._moved(child, p) or "affine", reason) for p in kept}
        return kinds

    def _numel(self, parent: Parent) -> int:
        return self._value(parent)[0].numel()

    def _value(self, parent: Parent) -> Tensor:
        return (self.previous if parent.lag else self.values)[parent.name]

    def _arguments(self, child: Variable) -> Values:
        return {p.argument: self._value(p) for p in child.parents}

    def _moving(self, child: Variable, moving: list[Parent]) -> Values:
        """Return arguments (WORLDS, len(LINE), ...) in which some parents move to another world's value and beyond."""
        line = torch.tensor(LINE, dtype=self.laws.dtype)
        names = {p.argument for p in moving}
        moved = {}
        for name, value in self._arguments(child).items():
            along = value[:, None].expand(WORLDS, len(LINE), *value.shape[1:])
            if name in names:
                t = line.reshape(1, -1, *[1] * (value.dim() - 1))
                along = along + t * (value.roll(1, 0) - value + 1e-3 * (value == value.roll(1, 0)))[:, None]
            moved[name] = along
        return moved

    def _is_affine(self, child: Variable, moving: list[Parent]) -> bool:
        try:
            law = self.laws.many(child.name, self._moving(child, moving), (WORLDS, len(LINE)))
        except ValueOutOfRange:
            return False
        if isinstance(law, Tensor):
            centre, spreads = law.to(self.laws.dtype), []
        else:
            given = parameters(law)
            centre = given["loc"]
            spreads = [value for name, value in given.items() if name != "loc"]
        line = torch.tensor(LINE, dtype=centre.dtype).reshape(1, -1, *[1] * (centre.dim() - 2))
        predicted = centre[:, :1] + line * (centre[:, 1:2] - centre[:, :1])
        return self._same(predicted, centre) and all(self._same(s[:, :1].expand_as(s), s) for s in spreads)

    def _same(self, a: Tensor, b: Tensor) -> bool:
        scale = max(1.0, float(b.abs().max())) if b.numel() else 1.0
        return bool(((a - b).abs() <= self.tolerance * scale).all())

    def _moved(self, child: Variable, parent: Parent) -> str | None:
        arguments = {name: value[0] for name, value in self._arguments(child).items()}
        with recording_moves() as moves:
            law = self.laws.one(child.name, arguments)
        centre = law if isinstance(law, Tensor) else parameters(law)["loc"]
        source = arguments[parent.argument]
        for image, moved in moves:
            if image is source and moved.shape == centre.shape and moved.data_ptr() == centre.data_ptr():
                return "moves"
        return None

    def _selects(self, child: Variable, continuous: list[Parent], conjugate: list[Parent]) -> bool:
        """Tell whether, in every world, the child's probability is a component of a parent, whatever its value."""
        here = self._arguments(child)
        names = {p.argument for p in continuous}
        there = {name: value.roll(1, 0) if name in names else value for name, value in here.items()}
        row = self._event_row(child)
        matches, changed = None, None
        for arguments in (here, there):
            law = self.laws.many(child.name, arguments, (WORLDS,))
            chosen = _probability(law, row)
            options = torch.cat([arguments[p.argument].reshape(WORLDS, -1, row) for p in conjugate], 1)
            equal = ((chosen[:, :, None] - options[:, None]).abs() <= self.tolerance * options[:, None].abs()).all(-1)
            matches = equal if matches is None else matches & equal
            changed = chosen if changed is None else ((chosen - changed).abs() > 0).any(-1)
        if matches is None or changed is None:
            return False
        return bool((matches.any(-1) | ~changed).all() and matches.any())

    def _event_row(self, child: Variable) -> int:
        base, _ = base_of(self.laws_of[child.name])
        return base.probs.shape[-1] if type(base).__name__ == "Categorical" else 1


def _probability(law: Any, row: int) -> Tensor:
    """Return the child's probabilities or rates, (WORLDS, elements, row)."""
    base, _ = base_of(law)
    values = base.rate if type(base).__name__ == "Poisson" else base.probs
    return values.reshape(WORLDS, -1, row)
