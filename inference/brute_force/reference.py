"""Brute force: what a belief must be, computed without any engine.

Worlds are enumerated where hidden variables are finite; what is Gaussian given those is conditioned on as one joint
Gaussian of the whole record; static rates are integrated on a grid; what is neither is drawn from its prior and
weighed, with a standard error.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import base_of, log_prob_of
from apmodels.laws import Laws
from apmodels.simulation import Values
from apmodels.variables import Variable
from inference.brute_force.weighed_worlds import WORLDS, Reference, drawn, gridded, same

# So many trajectories of finite values are enumerated.
TRAJECTORIES = 20_000


def reference(
    model: Any, actions: Values, seen: Values, names: list[str], worlds: int = WORLDS, seed: int = 0
) -> Reference:
    """Return what is to be believed after a record: ``actions`` and ``seen`` (steps, *shape) by name."""
    steps = len(next(iter(seen.values())))
    actions = {name: value.double() if value.is_floating_point() else value for name, value in actions.items()}
    structure = model.structure
    finite = [node for node in structure.hidden if node.random and node.values is not None]
    rest = [node for node in structure.hidden if node.random and node.values is None]
    number = math.prod(len(n.values) ** (1 if n.role == "static" else steps) for n in finite if n.values is not None)
    if rest and all(_on_grid(model, node) for node in (*finite, *rest)):
        found = gridded(model, actions, seen, names)
        if found is not None:
            return found
    gaussian = all(node.plan == "integrated" for node in rest)
    if number <= TRAJECTORIES and gaussian and (not rest or _affine_seen(structure)):
        return _enumerated(model, actions, seen, names)
    return drawn(model, actions, seen, names, worlds, seed)


def _on_grid(model: Any, node: Any) -> bool:
    """Whether a variable is static, and finite or a Beta without parents: to be integrated exactly on a grid."""
    return node.role == "static" and (
        node.values is not None or (node.family == "Beta" and not model.structure.into(node.name))
    )


def _affine_seen(structure: Any) -> bool:
    """Whether all that depends on something integrated is Gaussian."""
    integrated = {node.name for node in structure.planned("integrated")}
    touched = {a.child for a in structure.arrows if a.parent in integrated}
    return all(structure.nodes[name].family in ("Normal", "MultivariateNormal", "deterministic") for name in touched)


class _World:
    """One trajectory: finite variables have values, Gaussian ones are affine in standard normals."""

    def __init__(self, model: Any, actions: Values, seen: Values, choices: dict[tuple[str, int], Tensor]):
        self.laws = Laws(model, torch.float64)
        self.model, self.actions, self.seen, self.choices = model, actions, seen, choices
        self.integrated = {node.name for node in model.structure.planned("integrated")}
        self.steps = len(next(iter(seen.values())))

    def run(self, noise: Tensor | None) -> tuple[Values, float, list[tuple[Tensor, Tensor]]]:
        """Return the last values, log p of the finite choices and of what hangs on them alone, and (mean, y) pairs.

        ``noise``: the standard normals, in the order in which they are used; None counts them.
        """
        self.noise, self.used, self.score = noise, 0, 0.0
        self.pairs: list[tuple[Tensor, Tensor]] = []
        declaration = self.model.declaration
        now: Values = {}
        for variable in declaration.of_role("static"):
            now[variable.name] = self._value(variable, now, {}, 0)
        statics = dict(now)
        past = {name: self._before(name, statics) for name in declaration.remembered}
        for t in range(self.steps):
            now = {**statics, **{name: value[t] for name, value in self.actions.items()}}
            for variable in declaration.of_role("state", "observation"):
                now[variable.name] = self._value(variable, now, past, t + 1)
            past = {name: now[name] for name in past}
        return now, self.score, self.pairs

    def _before(self, name: str, statics: Values) -> Tensor:
        before = self.laws.before(name)
        return statics[before.name] if isinstance(before, Variable) else before

    def _value(self, variable: Variable, now: Values, past: Values, t: int) -> Tensor:
        parents = {p.argument: (past if p.lag else now)[p.name] for p in variable.parents}
        law = self.laws.one(variable.name, parents)
        name = variable.name
        if variable.role == "observation":
            return self._seen(variable, law, self.seen[name][t - 1].double())
        if not isinstance(law, Distribution):
            return law
        if (name, t) in self.choices:
            value = self.choices[name, t]
            self.score += float(_log_prob(law, value))
            return value
        return self._noisy(law)

    def _noisy(self, law: Distribution) -> Tensor:
        size = law.event_shape.numel()
        noise = (
            torch.zeros(size, dtype=torch.float64) if self.noise is None else self.noise[self.used : self.used + size]
        )
        self.used += size
        base: Any = base_of(law)[0]
        if type(base).__name__ == "MultivariateNormal":
            return base.loc + base.scale_tril @ noise
        return base.loc + base.scale * noise.reshape(base.loc.shape)

    def _seen(self, variable: Variable, law: Any, y: Tensor) -> Tensor:
        node = self.model.structure.nodes[variable.name]
        gaussian = any(a.parent in self.integrated for a in self.model.structure.into(variable.name))
        if not gaussian:
            if isinstance(law, Distribution):
                self.score += float(log_prob_of(law, y))
            elif not bool((torch.isnan(y) | (law == y)).all()):
                self.score = -math.inf
        else:
            self.pairs.append((self._noisy(law) if isinstance(law, Distribution) else law, y))
        whole = node.family == "Categorical" and not bool(torch.isnan(y).any())
        return y.long() if whole else y


def _log_prob(law: Any, value: Tensor) -> Tensor:
    base = base_of(law)[0]
    if type(base).__name__ == "Categorical":
        return base.probs.gather(-1, value.long()[..., None]).log().sum()
    if type(base).__name__ == "Bernoulli":
        return torch.where(value == 1, base.probs, 1 - base.probs).log().sum()
    return law.log_prob(value)


def _choices(model: Any, steps: int) -> Any:
    keys, values = [], []
    for node in model.structure.hidden:
        if node.random and node.values is not None:
            for t in [0] if node.role == "static" else range(1, steps + 1):
                keys.append((node.name, t))
                values.append(list(node.values))
    for some in itertools.product(*values):
        yield dict(zip(keys, some, strict=True))


def _enumerated(model: Any, actions: Values, seen: Values, names: list[str]) -> Reference:
    steps = len(next(iter(seen.values())))
    logs, found = [], []
    for choices in _choices(model, steps):
        score, values = _conditioned(_World(model, actions, seen, choices), names)
        if score > -math.inf:
            logs.append(score)
            found.append(values)
    weights = torch.tensor(logs, dtype=torch.float64)
    evidence = float(weights.logsumexp(0))
    weights = (weights - evidence).exp()
    probs, moments, errors = {}, {}, {}
    for name in names:
        node = model.structure.nodes[name]
        means = torch.stack([values[name][0] for values in found])
        wide = weights.reshape(-1, *[1] * (means.dim() - 1))
        if node.values is not None:
            probs[name] = (weights[:, None] * same(means, node.values)).sum(0)
            errors[name] = torch.zeros_like(probs[name])
            continue
        mean = (wide * means).sum(0)
        second = torch.stack([values[name][1] for values in found]) + (means - mean) ** 2
        moments[name] = mean, (wide * second).sum(0).clamp(min=0).sqrt()
        errors[name] = torch.zeros_like(mean)
    gaussian = ", joint Gaussian conditioning" if any(n.plan == "integrated" for n in model.structure.hidden) else ""
    return Reference(f"enumeration of worlds{gaussian}", evidence, 0.0, probs, moments, errors)


def _conditioned(world: _World, names: list[str]) -> tuple[float, dict[str, tuple[Tensor, Tensor]]]:
    """Log p(trajectory, record), and (mean, variance) of variables in the last step, by conditioning the joint."""
    now, score, pairs = world.run(None)
    size = world.used
    if not size or score == -math.inf:
        return score, {name: (now[name].double(), torch.zeros_like(now[name].double())) for name in names}
    runs = [world.run(unit) for unit in torch.eye(size, dtype=torch.float64)]
    mean = torch.cat([m.flatten() for m, _ in pairs])
    y = torch.cat([v.flatten() for _, v in pairs])
    slopes = torch.stack([torch.cat([m.flatten() for m, _ in run[2]]) for run in runs], 1) - mean[:, None]
    told = ~torch.isnan(y)
    slopes, off = slopes[told], (y - mean)[told]
    spread = slopes @ slopes.T
    if len(off):
        root = torch.linalg.cholesky(spread)
        white = torch.linalg.solve_triangular(root, off[:, None], upper=False)
        score += float(-0.5 * (white**2).sum() - root.diagonal().log().sum() - 0.5 * len(off) * math.log(2 * math.pi))
        solved = torch.cholesky_solve(slopes, root)
    else:
        solved = slopes
    values = {}
    for name in names:
        here = now[name].double()
        way = torch.stack([run[0][name].double().flatten() for run in runs], 1) - here.flatten()[:, None]
        cross = way @ slopes.T
        after = (
            here.flatten() + (cross @ torch.cholesky_solve(off[:, None], root))[:, 0] if len(off) else here.flatten()
        )
        variance = (way * way).sum(1) - ((cross @ solved) * way).sum(1)
        values[name] = after.reshape(here.shape), variance.reshape(here.shape)
    return score, values
