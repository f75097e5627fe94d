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

from apmodels.distributions import base_of, family, parameters, tensors
from apmodels.errors import DeclarationError, ValueOutOfRange
from apmodels.laws import Laws
from apmodels.simulation import Values, Worlds, seeded
from apmodels.supports import support_of
from apmodels.transforms import recording_moves
from apmodels.variables import Parent, Variable

WORLDS = 24
STEPS = 40
FEWEST = 5
# How many combinations of finite values, and how many numbers, one probe may look at.
COMBINATIONS = 1024
NUMBERS = 20_000_000
IMAGES = 1_000_000  # numbers of one variable in all worlds; of a larger one fewer worlds are probed
# Where on the line through two worlds (0 and 1) a law is evaluated.
LINE = (0.0, 1.0, 0.37, -1.0, 2.6, -4.3, 11.0, -23.0, 61.0)

Kind = tuple[str, str]


class _ProbedWorlds(Worlds):
    """Worlds whose observations are only drawn where some law asks for them."""

    laws_of: dict[str, Any]

    def _draw(self, variable: Variable, values: Values) -> Tensor:
        if not hasattr(self, "laws_of"):
            self.laws_of = {}
            everybody = self.laws.variables.values()
            self.asked_for = {parent.name for other in everybody for parent in other.parents}
        if variable.name not in self.laws_of:
            arguments = self.parents(variable, values)
            law = self.laws.one(variable.name, {name: value[0] for name, value in arguments.items()})
            self.laws_of[variable.name] = law
        if variable.role == "observation" and variable.name not in self.asked_for:
            return torch.full((self.batch,), torch.nan)
        return super()._draw(variable, values)


class Probe:
    """Random worlds of one model over some steps of random actions, and what its laws do there."""

    def __init__(self, model: Any):
        self.variables = model.declaration.variables
        with torch.no_grad():
            try:
                self._draw(model, torch.float64, 1e-7)
            except DeclarationError as error:
                # A field that is not a dataclass (a network, say) may keep its own precision.
                if "dtype" not in str(error) and "same type" not in str(error):
                    raise
                self._draw(model, torch.float32, 1e-3)

    def _draw(self, model: Any, dtype: torch.dtype, tolerance: float) -> None:
        self.laws = Laws(model, dtype)
        self.tolerance = tolerance
        pools: dict[str, list[Tensor]] = {}
        self.worlds, steps = self._affordable(model)
        with seeded(0):
            worlds = _ProbedWorlds(self.laws, self.worlds)
            for step in range(steps):
                before = worlds.previous
                worlds.step({name: self._action(model, name) for name in model.action_names})
                if step == 3:
                    self.values, self.previous = worlds.values, before
                for name, value in (*worlds.values.items(), *before.items()):
                    pools.setdefault(name, []).append(value)
        self.laws_of = worlds.laws_of
        wanted = worlds.asked_for & set(pools)
        self.pools = {name: self._all_values(model, name, pools[name]) for name in wanted}

    def _affordable(self, model: Any) -> tuple[int, int]:
        """Return how many worlds are probed over how many steps: fewer, where one of them holds a whole image."""
        with seeded(0):
            self.worlds = 2
            first = _ProbedWorlds(self.laws, self.worlds)
            first.step({name: self._action(model, name) for name in model.action_names})
        worlds = max(FEWEST, min(WORLDS, IMAGES // max(value[0].numel() for value in first.values.values())))
        return worlds, STEPS if worlds == WORLDS else FEWEST

    def _action(self, model: Any, name: str) -> Tensor:
        value = model.space(name).sample((self.worlds,))
        return value.to(self.laws.dtype) if value.is_floating_point() else value

    def _all_values(self, model: Any, name: str, found: list[Tensor]) -> Tensor | None:
        """Every value that a variable is known to take, if they may be few; None for a continuum."""
        role = self.variables[name].role
        listed = model.space(name).values() if role == "action" and model.space(name).size else None
        if role != "action" and self.is_random(name):
            listed = support_of(self.laws_of[name])
        if listed is None and (role == "action" or self.is_random(name)):
            return None
        kinds = {value.dtype for value in found}
        rows = [value.reshape(len(value), -1) for value in found if value.dtype == found[-1].dtype or len(kinds) == 1]
        seen = torch.unique(torch.cat(rows), dim=0).reshape(-1, *found[-1].shape[1:])
        if listed is None:
            return seen if len(seen) <= COMBINATIONS else None
        return torch.cat([listed.to(seen.dtype), seen])

    def is_random(self, name: str) -> bool:
        """Tell whether a variable's law is a distribution."""
        return isinstance(self.laws_of.get(name), Distribution)

    def kinds(self, child: Variable, continuous: list[Parent], conjugate: list[Parent]) -> dict[str, Kind]:
        """Return argument -> (kind, reason) for the continuous parents of a variable.

        ``conjugate`` are those of them that could be selected from: a Beta above a Bernoulli, and so on.
        """
        with torch.no_grad():
            return self._kinds(child, continuous, conjugate) if continuous else {}

    def _kinds(self, child: Variable, continuous: list[Parent], conjugate: list[Parent]) -> dict[str, Kind]:
        if conjugate and self._selects(child, continuous, conjugate):
            chosen = {p.argument: ("selects", "its probability is one of the components") for p in conjugate}
            rest = [p for p in continuous if p not in conjugate]
            return chosen | {p.argument: ("affine", "without effect at every probed world") for p in rest}
        if isinstance(law := self.laws_of[child.name], Distribution) and family(law) not in (
            "Normal",
            "MultivariateNormal",
        ):
            return {p.argument: ("nonlinear", f"a {family(law)} of a continuous variable") for p in continuous}
        return self._linearity(child, continuous)

    def _linearity(self, child: Variable, continuous: list[Parent]) -> dict[str, Kind]:
        kinds: dict[str, Kind] = {}
        rest = []
        for parent in continuous:
            if not self._value(parent).is_floating_point():
                kinds[parent.argument] = ("nonlinear", "a whole number that follows from a continuum")
            elif self._is_affine(child, [parent]):
                rest.append(parent)
            else:
                kinds[parent.argument] = ("nonlinear", "not affine in it, all else fixed")
        # Bilinear laws: sample as few and as small parents as make the others affine together.
        for count in range(len(rest) + 1):
            sets = sorted(itertools.combinations(rest, count), key=lambda s: sum(self._value(p).numel() for p in s))
            for some in sets:
                kept = [p for p in rest if p not in some]
                if len(kept) < 2 or self._is_affine(child, kept):
                    given = [p.argument for p in continuous if p not in kept]
                    for p in some:
                        kinds[p.argument] = ("nonlinear", f"multiplies {', '.join(q.argument for q in kept)}")
                    reason = f"given {', '.join(given)}" if given else "constant slope, constant spread"
                    return kinds | {p.argument: (self._moved(child, p) or "affine", reason) for p in kept}
        return kinds

    def is_smooth(self, child: Variable, parent: Parent) -> bool:
        """Tell whether a law moves at all when a parent moves by next to nothing, in some probed world."""
        here = {p.argument: self._value(p) for p in child.parents}
        if not (value := here[parent.argument]).is_floating_point():
            return False
        moved = here | {parent.argument: value * (1 + 1e-4) + 1e-4}
        try:
            with torch.no_grad():
                laws = [self.laws.many(child.name, some, (self.worlds,)) for some in (here, moved)]
        except (ValueOutOfRange, DeclarationError):
            return True
        pairs = zip(tensors(laws[0]), tensors(laws[1]), strict=True)
        # Where next to all worlds stay just as they are, what changes does so in steps.
        changed = [
            (a != b).reshape(self.worlds, -1).any(1).double().mean() for a, b in pairs if a.numel() >= self.worlds
        ]
        return not changed or float(max(changed)) > 0.2

    def _value(self, parent: Parent) -> Tensor:
        return (self.previous if parent.lag else self.values)[parent.name]

    def _arguments(self, child: Variable, continuous: list[Parent]) -> Values:
        """A law's arguments in W worlds (W, *shape), in which whatever is finite takes all its values."""
        names = {p.argument for p in continuous}
        drawn = {p.argument: self._value(p) for p in child.parents}
        pools = {p.argument: self.pools[p.name] for p in child.parents if p.argument not in names}
        pools = {name: pool for name, pool in pools.items() if pool is not None and len(pool) > 1}
        most = max(self.worlds, NUMBERS // (len(LINE) * max(value[0].numel() for value in drawn.values())))
        count, picks = _design([len(pool) for pool in pools.values()], min(COMBINATIONS, most))
        worlds = max(self.worlds, count)
        tiled = {name: value[torch.arange(worlds) % self.worlds] for name, value in drawn.items()}
        for (name, pool), pick in zip(pools.items(), picks, strict=True):
            tiled[name] = pool[pick[torch.arange(worlds) % count]].to(drawn[name].dtype)
        return tiled

    def _is_affine(self, child: Variable, moving: list[Parent]) -> bool:
        here = self._arguments(child, [p for p in child.parents if self.pools[p.name] is None])
        worlds = torch.arange(len(next(iter(here.values()))))
        # Not more numbers at a time than an allocator keeps at hand.
        most = max(1, IMAGES // max(value[0].numel() for value in here.values()))
        return all(self._is_straight(child, {p.argument for p in moving}, here, some) for some in worlds.split(most))

    def _is_straight(self, child: Variable, moving: set[str], here: Values, some: Tensor) -> bool:
        """Whether a law is affine on lines from some worlds to others."""
        line = torch.tensor(LINE, dtype=self.laws.dtype)
        moved = {}
        for name, value in here.items():
            along = value[some][:, None]
            if name in moving:
                t = line.reshape(1, -1, *[1] * (value.dim() - 1))
                # Towards another world, all together; a little aside where that one is the same.
                other = value[(some - 1) % len(value)][:, None]
                along = along + t * (other - along + 1e-3 * (along == other))
            moved[name] = along
        try:
            law = self.laws.many(child.name, moved, (len(some), len(LINE)))
        except (ValueOutOfRange, DeclarationError):
            # A law that fails beyond the values that its parent takes is nonlinear enough.
            return False
        centre = law.to(self.laws.dtype) if isinstance(law, Tensor) else parameters(law)["loc"]
        spreads = [] if isinstance(law, Tensor) else [v for name, v in parameters(law).items() if name != "loc"]
        t = line.to(centre.dtype).reshape(1, -1, *[1] * (centre.dim() - 2))
        same = self._same(centre[:, :1] + t * (centre[:, 1:2] - centre[:, :1]), centre)
        return same and all(self._same(s[:, :1].expand_as(s), s) for s in spreads)

    def _same(self, a: Tensor, b: Tensor) -> bool:
        """Whether values (W, line, ...) agree, by the scale of each component on each line: units do not matter."""
        if torch.equal(a, b):
            return True
        scale = torch.maximum(*(torch.linalg.vector_norm(x, torch.inf, 1) for x in (a, b)))
        return bool((torch.linalg.vector_norm(a - b, torch.inf, 1) <= self.tolerance * scale).all())

    def _moved(self, child: Variable, parent: Parent) -> str | None:
        arguments = {p.argument: self._value(p)[0] for p in child.parents}
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
        here = self._arguments(child, continuous)
        worlds = len(next(iter(here.values())))
        row = self._event_row(child)
        matches, before, changed = None, None, None
        for seed in (1, 2):
            arguments = here | {p.argument: self._anything(p, worlds, seed) for p in conjugate}
            rest = {p.argument for p in continuous} - {p.argument for p in conjugate}
            arguments |= {name: here[name].roll(seed, 0) for name in rest}
            law = self.laws.many(child.name, arguments, (worlds,))
            chosen = _probability(law, row)
            options = torch.cat([arguments[p.argument].reshape(worlds, -1, row) for p in conjugate], 1)
            close = (chosen[:, :, None] - options[:, None]).abs() <= self.tolerance * options[:, None].abs()
            equal = close.all(-1)
            matches = equal if matches is None else matches & equal
            changed = None if before is None else ((chosen - before).abs() > 0).any(-1)
            before = chosen
        if matches is None or changed is None:
            return False
        return bool((matches.any(-1) | ~changed).all() and matches.any())

    def _anything(self, parent: Parent, worlds: int, seed: int) -> Tensor:
        """Values that a Beta, Dirichlet or Gamma could take, likely under its prior or not, (worlds, *shape)."""
        shape = (worlds, *self._value(parent).shape[1:])
        generator = torch.Generator().manual_seed(seed)
        flat = torch.rand(shape, generator=generator, dtype=self.laws.dtype)
        name = family(self.laws_of[parent.name])
        if name == "Beta":
            return flat
        wide = -flat.log() * torch.exp(4 * torch.rand(shape, generator=generator, dtype=self.laws.dtype))
        return wide / wide.sum(-1, keepdim=True) if name == "Dirichlet" else wide

    def _event_row(self, child: Variable) -> int:
        base, _ = base_of(self.laws_of[child.name])
        return base.probs.shape[-1] if type(base).__name__ == "Categorical" else 1


def _design(sizes: list[int], most: int) -> tuple[int, list[Tensor]]:
    """How many worlds, and which value of each finite parent in each: all combinations, or all values in turn."""
    total = torch.Size(sizes).numel()
    if total <= most:
        grid = torch.cartesian_prod(*[torch.arange(n) for n in sizes]).reshape(total, -1) if sizes else None
        return total, [] if grid is None else list(grid.unbind(1))
    count = max(most, *sizes)
    generator = torch.Generator().manual_seed(0)
    return count, [torch.arange(count)[torch.randperm(count, generator=generator)] % n for n in sizes]


def _probability(law: Any, row: int) -> Tensor:
    """Return the child's probabilities or rates, (worlds, elements, row)."""
    base, _ = base_of(law)
    values = base.rate if type(base).__name__ == "Poisson" else base.probs
    return values.reshape(len(values), -1, row)
