"""Every variable of a whole record as an affine function of standard normals, and then one conditioning of all.

A law is called as its author wrote it, for one world, where all noise is zero and where one noise is one: that gives
its matrices, and no step is ever filtered. Finite variables are walked through value by value, path by path, so that
cost grows exponentially with the record where they change with time: keep records short.
"""

import dataclasses
import math

import numpy as np
import torch
from torch.distributions import Distribution

from apmodels.variables import Variable
from tests.inference.oracle import base_of, log_density, outcomes, plain

GAUSSIAN = ("Normal", "MultivariateNormal")


class JointGaussian:
    """The joint law of a record; ``actions`` and ``seen`` are lists of dicts by name, one for each step.

    Args:
        model: affine and Gaussian, given finite variables; those must not depend on Gaussian ones.
        actions: by name.
        seen: by name; elements that are NaN are missing.
    """

    def __init__(self, model, actions, seen):
        self.model, self.variables = _in_double(model), type(model).declaration.variables
        self.actions = [{n: torch.as_tensor(v) for n, v in act.items()} for act in actions]
        self.seen = [{n: torch.as_tensor(v, dtype=torch.float64) for n, v in see.items()} for see in seen]
        self.memo, self.conditioned = {}, {}
        self.causes = self._causes()
        self.paths = [self._path(values, weight) for values, weight in self._assignments()]

    # What is asked.

    def evidence(self):
        """Return log p(observations | actions)."""
        return float(np.logaddexp.reduce([path["weight"] for path in self.paths]))

    def weights(self):
        """Return the posterior probability of every path of finite values."""
        logs = np.array([path["weight"] for path in self.paths])
        return np.exp(logs - np.logaddexp.reduce(logs))

    def probabilities(self, name, step=None):
        """Return value -> probability of a finite variable at a step, the last one by default."""
        found = {}
        for path, weight in zip(self.paths, self.weights(), strict=True):
            value = plain(path["finite"][self._key(name, step)])
            found[value] = found.get(value, 0.0) + weight
        return found

    def moments(self, name, step=None):
        """Return the mean and covariance of a Gaussian variable's elements at a step, over all paths."""
        parts = [self._marginal(path, [name], step) for path in self.paths]
        weights = self.weights()
        mean = sum(w * m for w, (m, _) in zip(weights, parts, strict=True))
        spread = sum(w * (c + np.outer(m - mean, m - mean)) for w, (m, c) in zip(weights, parts, strict=True))
        return mean, spread

    def entropy(self, names, finite=()):
        """Return the joint entropy, nats, of Gaussian variables, and of finite ones that tell all paths apart."""
        total = 0.0
        for path, weight in zip(self.paths, self.weights(), strict=True):
            total += weight * half_log_det(self._marginal(path, names, None)[1])
        if finite:
            weights = self.weights()
            return total - float((weights * np.log(np.maximum(weights, 1e-300))).sum())
        assert len(self.paths) == 1
        return total

    def chance(self, name, value):
        """Return the probability of a finite observation's value in the last step, where it was not seen."""
        logs = [log_density(path["laws"][name], value) for path in self.paths]
        return float((self.weights() * np.exp(logs)).sum())

    def ahead(self, action):
        """Return the same after one more action, with nothing seen yet."""
        return JointGaussian(self.model, [*self.actions, action], [*self.seen, self._nothing()])

    def gain(self, names, action):
        """Return I(Gaussian variables; observations) of the next step; how much does not depend on what is seen."""
        before = self.ahead(action)
        something = {name: torch.zeros_like(value) for name, value in self._nothing().items()}
        after = JointGaussian(self.model, [*self.actions, action], [*self.seen, something])
        return before.entropy(names) - after.entropy(names)

    # One world at a time.

    def _causes(self):
        """What Gaussian variables depend on, however far back."""
        nodes = self.model.structure.nodes
        found = {name for name, node in nodes.items() if node.family in (*GAUSSIAN, "deterministic")}
        while True:
            parents = [p for name in found for p in self.variables[name].parents]
            more = {p.name for p in parents} | {p.before.name for p in parents if isinstance(p.before, Variable)}
            if more <= found:
                return found
            found |= more

    def _nothing(self):
        nodes = self.model.structure.nodes
        return {n: torch.full(nodes[n].shape, torch.nan, dtype=torch.float64) for n in self.model.observation_names}

    def _key(self, name, step):
        role = self.variables[name].role
        return (name, 0) if role == "static" else (name, len(self.actions) if step is None else step)

    def _assignments(self):
        """Every path of the finite variables, and its log probability with that of the finite observations."""
        waiting, done = [{}], []
        while waiting:
            chosen = waiting.pop()
            try:
                done.append((chosen, self._world(chosen, lambda _, size: np.zeros(size))[1]))
            except _Open as fork:
                waiting += [{**chosen, fork.key: value} for value in outcomes(fork.law)]
        return [(chosen, weight) for chosen, weight in done if weight > -math.inf]

    def _world(self, chosen, noise):
        """Run the record through; return the values by (name, step), and log p of the finite ones."""
        values, weight = {}, 0.0
        for step in range(len(self.actions) + 1):
            for name, variable in self.variables.items():
                if (variable.role == "static") != (step == 0):
                    continue
                key = name, step
                if variable.role == "action":
                    values[key] = self.actions[step - 1][name]
                    continue
                law = self._law(variable, values, step)
                if not isinstance(law, Distribution):
                    values[key] = law
                elif type(base_of(law)).__name__ in GAUSSIAN:
                    centre, root = _moments(law)
                    value = centre + root @ noise(key, len(centre))
                    values[key] = torch.as_tensor(value).reshape(law.event_shape)
                elif variable.role == "observation":
                    values[key], values["law", name] = self.seen[step - 1][name], law
                    weight += log_density(law, values[key])
                elif key not in chosen:
                    raise _Open(key, law)
                else:
                    values[key] = chosen[key]
                    weight += log_density(law, values[key])
        return values, weight

    def _law(self, variable, values, step):
        arguments = {}
        for parent in variable.parents:
            then = 0 if self.variables[parent.name].role == "static" else step - parent.lag
            if not parent.lag or then:
                value = values[parent.name, then]
                if self.variables[parent.name].role == "observation":
                    value = self.seen[then - 1][parent.name]
            elif isinstance(parent.before, Variable):
                value = values[parent.before.name, 0]
            else:
                value = parent.before(self.model) if callable(parent.before) else parent.before
            arguments[parent.argument] = _wide(torch.as_tensor(value))
        mark = variable.name, *(plain(value) for value in arguments.values())
        if mark not in self.memo:
            precision = torch.get_default_dtype()
            torch.set_default_dtype(torch.float64)
            try:
                law = variable.law(self.model, **arguments)
            finally:
                torch.set_default_dtype(precision)
            self.memo[mark] = law if isinstance(law, Distribution) else torch.as_tensor(law)
        return self.memo[mark]

    def _path(self, finite, weight):
        """All Gaussian values as mean + matrix @ noise, conditioned on what was seen."""
        middle, _ = self._world(finite, lambda _, size: np.zeros(size))
        laws = {key[1]: law for key, law in middle.items() if key[0] == "law"}
        mark = tuple((key, plain(value)) for key, value in finite.items() if key[0] in self.causes)
        if mark not in self.conditioned:
            self.conditioned[mark] = self._conditioned(finite)
        told, found = self.conditioned[mark]
        return found | {"finite": finite, "weight": weight + told, "laws": laws}

    def _conditioned(self, finite):
        sizes = {}

        def measured(key, size):
            sizes[key] = size
            return np.zeros(size)

        middle, _ = self._world(finite, measured)
        starts = dict(zip(sizes, np.cumsum([0, *sizes.values()]), strict=False))
        total = sum(sizes.values())
        ends = []
        for unit in np.eye(total):
            world, _ = self._world(finite, lambda key, size, u=unit: u[starts[key] : starts[key] + size])
            ends.append(world)
        places, mean, rows = {}, [], []
        for key, value in middle.items():
            if key[0] == "law" or key in finite or self._is_action(key[0]) or not value.is_floating_point():
                continue
            centre = value.double().numpy().reshape(-1)
            places[key] = np.arange(len(mean), len(mean) + len(centre))
            mean += list(centre)
            rows += list(np.stack([e[key].double().numpy().reshape(-1) - centre for e in ends], 1))
        mean, matrix = np.array(mean), np.array(rows)
        covariance = matrix @ matrix.T
        at, y = [], []
        for step, see in enumerate(self.seen, 1):
            for name, value in see.items():
                if (name, step) in sizes:
                    at += list(places[name, step])
                    y += list(value.numpy().reshape(-1))
        at, y = np.array(at, int), np.array(y)
        at, y = at[~np.isnan(y)], y[~np.isnan(y)]
        spread, cross = covariance[np.ix_(at, at)], covariance[:, at]
        surprise, weight = y - mean[at], 0.0
        if len(at):
            weight = weight - 0.5 * surprise @ np.linalg.solve(spread, surprise)
            weight = weight - 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
            mean = mean + cross @ np.linalg.solve(spread, surprise)
            covariance = covariance - cross @ np.linalg.solve(spread, cross.T)
        return weight, {"mean": mean, "covariance": covariance, "places": places}

    def _is_action(self, name):
        return self.variables[name].role == "action"

    def _marginal(self, path, names, step):
        at = np.concatenate([path["places"][self._key(name, step)] for name in names])
        return path["mean"][at], path["covariance"][np.ix_(at, at)]


class _Open(Exception):
    """A finite variable of which no value has been chosen yet."""

    def __init__(self, key, law):
        self.key, self.law = key, law


def half_log_det(covariance):
    """The entropy of a Gaussian, nats."""
    return 0.5 * np.linalg.slogdet(2 * np.pi * math.e * np.atleast_2d(covariance))[1]


def _in_double(model):
    fields = {field.name: getattr(model, field.name) for field in dataclasses.fields(model)}
    return model.replace(**{name: _wide(value) for name, value in fields.items() if isinstance(value, torch.Tensor)})


def _wide(value):
    return value.double() if value.is_floating_point() else value


def _moments(law):
    base = base_of(law)
    if type(base).__name__ == "MultivariateNormal":
        return base.loc.double().numpy(), np.linalg.cholesky(base.covariance_matrix.double().numpy())
    centre = base.loc.double().numpy().reshape(-1)
    return centre, np.diag(np.broadcast_to(base.scale.double().numpy(), base.loc.shape).reshape(-1))
