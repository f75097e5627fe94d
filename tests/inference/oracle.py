"""Brute force: every trajectory of the hidden variables of a finite model, one world at a time.

A law is called as its author wrote it, for one world; its family's formula is scipy's. No state is ever summed out
before the end, so that cost grows exponentially with the record: keep records short.
"""

import itertools
import math

import numpy as np
import torch
from scipy import stats
from torch.distributions import Distribution, Independent

from apmodels import Planted
from apmodels.variables import Variable


def plain(value):
    """A tensor as a number or nested tuples of them, which can be compared and hashed."""
    value = torch.as_tensor(value)
    return float(value) if value.dim() == 0 else tuple(plain(part) for part in value)


def numbers(value):
    return torch.as_tensor(value).double().numpy()


def base_of(law):
    while isinstance(law, Independent):
        law = law.base_dist
    return law


def log_density(law, value):
    """log p(value) under a law for one world; elements that are NaN are missing."""
    law, value = base_of(law), numbers(value)
    family = type(law).__name__
    if isinstance(law, Planted):
        inside = int(law.index)
        scores = _elements(law.elsewhere, value)
        return float(np.delete(scores, inside).sum() + _elements(law.here, value[inside]).sum())
    if family == "MultivariateNormal":
        if np.isnan(value).all():
            return 0.0
        return float(stats.multivariate_normal.logpdf(value, numbers(law.loc), numbers(law.covariance_matrix)))
    return float(_elements(law, value).sum())


def _elements(law, value):
    family = type(law).__name__
    with np.errstate(divide="ignore"):
        if family == "Normal":
            scores = stats.norm.logpdf(value, numbers(law.loc), numbers(law.scale))
        elif family == "Poisson":
            scores = stats.poisson.logpmf(value, numbers(law.rate))
        elif family == "Bernoulli":
            scores = stats.bernoulli.logpmf(value, numbers(law.probs))
        elif family == "Categorical":
            probs = np.broadcast_to(numbers(law.probs), (*value.shape, law.probs.shape[-1]))
            outcome = np.nan_to_num(value).astype(int)
            scores = np.log(np.take_along_axis(probs, outcome[..., None], -1)[..., 0])
        else:
            raise NotImplementedError(family)
    return np.where(np.isnan(value), 0.0, scores)


def outcomes(law):
    """All values of a finite law, as tensors of the type that it draws."""
    shape = law.event_shape
    base = base_of(law)
    if isinstance(base, Planted):
        base = base.elsewhere
    count = {"Bernoulli": lambda: 2, "Categorical": lambda: base.probs.shape[-1]}[type(base).__name__]()
    dtype = torch.int64 if type(base).__name__ == "Categorical" else torch.float64
    return [
        torch.tensor(v, dtype=dtype).reshape(shape) for v in itertools.product(range(count), repeat=math.prod(shape))
    ]


class Oracle:
    """Weighs every trajectory of a record: ``actions`` and ``seen`` are lists of dicts by name, one for each step."""

    def __init__(self, model):
        self.model = model
        self.variables = type(model).declaration.variables
        self.memo = {}

    def worlds(self, actions, seen):
        """Return (values by name in the last step, log joint probability) of every trajectory."""
        found = [({}, {}, 0.0)]
        found = [next_ for world in found for next_ in self._branches(world, "static", {})]
        for act, sense in zip(actions, seen, strict=True):
            act = {name: torch.as_tensor(value) for name, value in act.items()}
            found = [({**self._statics(now), **act}, now, weight) for now, _, weight in found]
            found = [next_ for world in found for next_ in self._branches(world, "state", {})]
            found = [next_ for world in found for next_ in self._branches(world, "observation", sense)]
        return [(now, weight) for now, _, weight in found if weight > -math.inf]

    def evidence(self, actions, seen):
        """Return log p(observations | actions)."""
        return float(np.logaddexp.reduce([weight for _, weight in self.worlds(actions, seen)]))

    def posterior(self, names, actions, seen):
        """Return value (a tuple, by name in ``names``) -> probability in the last step. 'interest' is a name too."""
        worlds = self.worlds(actions, seen)
        total = np.logaddexp.reduce([weight for _, weight in worlds])
        posterior = {}
        for now, weight in worlds:
            key = tuple(plain(self._value(name, now)) for name in names)
            posterior[key] = posterior.get(key, 0.0) + math.exp(weight - total)
        return posterior

    def entropy(self, names, actions, seen):
        """Return the joint entropy of variables in nats."""
        probs = np.array(list(self.posterior(names, actions, seen).values()))
        return float(-(probs * np.log(probs, where=probs > 0, out=np.zeros_like(probs))).sum())

    def predictive(self, actions, seen, action, candidate):
        """Return log p(candidate | action, history), a dict by name of observations."""
        return self.evidence([*actions, action], [*seen, candidate]) - self.evidence(actions, seen)

    def gain(self, names, actions, seen, action):
        """Return I(interest; observations) of the next step, for finite observations."""
        nothing = {name: None for name in self.model.observation_names}
        every = {name: set() for name in nothing}
        laws = {}
        for now, _ in self.worlds([*actions, action], [*seen, nothing]):
            for name in every:
                for value in outcomes(now["law of " + name]) if "law of " + name in now else [now[name]]:
                    laws[name, plain(value)] = value
                    every[name].add(plain(value))
        acts = [*actions, action]
        before = self.entropy(names, acts, [*seen, nothing])
        past = self.evidence(actions, seen) if actions else 0.0
        for values in itertools.product(*every.values()):
            sense = {name: laws[name, value] for name, value in zip(every, values, strict=True)}
            if self.worlds(acts, [*seen, sense]):
                chance = math.exp(self.evidence(acts, [*seen, sense]) - past)
                before -= chance * self.entropy(names, acts, [*seen, sense])
        return before

    def _statics(self, now):
        return {name: value for name, value in now.items() if name in self.variables and self._role(name) == "static"}

    def _role(self, name):
        return self.variables[name].role

    def _branches(self, world, role, sense):
        """Extend one world by all variables of a role; one of several worlds for each value of a random one."""
        worlds = [world]
        for name, variable in self.variables.items():
            if variable.role != role:
                continue
            grown = []
            for now, before, weight in worlds:
                law, table = self._law(variable, now, before)
                if not isinstance(law, Distribution):
                    value = law
                    good = role != "observation" or sense[name] is None or plain(value) == plain(sense[name])
                    grown.append(({**now, name: value}, before, weight if good else -math.inf))
                elif role != "observation":
                    grown += [({**now, name: value}, before, weight + score) for value, score in table]
                elif sense[name] is None and name in self.model.declaration.remembered:
                    told = {**now, "law of " + name: law}
                    grown += [({**told, name: v}, before, weight + log_density(law, v)) for v in outcomes(law)]
                else:
                    missing = sense[name] is None
                    value = torch.as_tensor(torch.nan if missing else sense[name])
                    score = 0.0 if missing else log_density(law, value)
                    whole = not value.isnan().any() and type(base_of(law)).__name__ == "Categorical"
                    value = value.to(torch.int64) if whole else value
                    grown.append(({**now, name: value, "law of " + name: law}, before, weight + score))
            worlds = grown
        return worlds

    def _law(self, variable, now, before):
        arguments = {}
        for parent in variable.parents:
            if not parent.lag:
                value = now[parent.name]
            elif parent.name in before:
                value = before[parent.name]
            elif isinstance(parent.before, Variable):
                value = now[parent.before.name]
            else:
                value = parent.before(self.model) if callable(parent.before) else parent.before
            arguments[parent.argument] = torch.as_tensor(value)
        key = variable.name, *(plain(value) for value in arguments.values())
        if key not in self.memo:
            precision = torch.get_default_dtype()
            torch.set_default_dtype(torch.float64)
            try:
                law = variable.law(self.model, **arguments)
            finally:
                torch.set_default_dtype(precision)
            if isinstance(law, Distribution) and variable.role in ("static", "state"):
                self.memo[key] = law, [(value, log_density(law, value)) for value in outcomes(law)]
            else:
                self.memo[key] = (law if isinstance(law, Distribution) else torch.as_tensor(law)), None
        return self.memo[key]

    def _value(self, name, now):
        if name == "interest":
            variable = self.model.declaration.interest
            return self._law(variable, now, {})[0]
        return now[name]
