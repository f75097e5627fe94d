"""Random small models that are affine and Gaussian, given finite variables: what engines are held to oracles with."""

import numpy as np
import torch
from hypothesis import assume
from hypothesis import strategies as st
from pyro.distributions import Bernoulli, Categorical, MultivariateNormal, Normal

from apmodels import Box, DeclarationError, Finite, Model, action, observation, state, static

DECORATORS = {"static": static, "state": state, "observation": observation}
STEPS = 3


def affine_law(family, shape, tables, parents, contexts):
    """A law of which the mean is affine in parents, through matrices that contexts (finite or known) look up.

    ``parents`` and ``contexts`` are (argument, before) pairs; ``before`` is None for one of this step.
    """

    def look_up(table, context):
        for value in context:
            table = table[torch.as_tensor(value).long() % len(table)]
        return table.to(torch.get_default_dtype())

    def law(values, context):
        mean = look_up(tables["offset"], context)
        for (argument, _), value in zip(parents, values, strict=True):
            mean = mean + look_up(tables[argument], context) @ value.reshape(-1)
        mean = mean.reshape(shape)
        if family == "deterministic":
            return mean
        if family == "MultivariateNormal":
            return MultivariateNormal(mean, look_up(tables["joint"], context))
        spread = look_up(tables["spread"], context).reshape(shape)
        return Normal(mean, spread).to_event(len(shape)) if shape else Normal(mean, spread)

    return spelled_out(law, parents, contexts)


def spelled_out(law, *groups):
    """A method whose arguments are named, since a law's parents are the names of its arguments."""
    scope = {"law": law}
    header, lagged, calls = ["self"], [], []
    for group in groups:
        scope |= {f"before_{argument}": before for argument, before in group if before is not None}
        header += [argument for argument, before in group if before is None]
        lagged += [f"{argument}=before_{argument}" for argument, before in group if before is not None]
        calls.append(f"({''.join(argument + ', ' for argument, _ in group)})")
    exec(f"def method({', '.join(header + lagged)}):\n    return law({', '.join(calls)})", scope)
    return scope["method"]


@st.composite
def affine_models(draw, finite=True):
    """1 to 3 Gaussian hidden variables and 1 or 2 observations of them; perhaps actions, a clock, a finite parent."""
    random = np.random.default_rng(draw(st.integers(0, 2**31)))
    members, contexts, pushes = {}, [], []
    if draw(st.booleans()):
        members["push"] = action(Box(-1.0, 1.0, (2,)))
        pushes.append("push")
    if draw(st.booleans()):
        members["choice"] = action(Finite(2))
        contexts.append("choice")
    if draw(st.booleans()):
        members["clock"] = state(lambda self, prev_clock=0: prev_clock + 1)
        contexts.append("clock")
    early = []
    if finite and draw(st.booleans()):
        members["kind"] = static(lambda self: Categorical(torch.tensor([0.5, 0.2, 0.3])))
        early.append("kind")
    if finite and draw(st.booleans()):
        members |= _mood(draw(st.booleans()) and bool(early))
    names = _hidden(draw, random, members, contexts, pushes, early)
    for i in range(draw(st.integers(1, 2))):
        known = draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
        arguments = [(name, None) for name in known]
        lagged = [n for n in names if n in _befores(members) and draw(st.booleans())][:1]
        arguments += [(f"prev_{n}", _befores(members)[n]) for n in lagged]
        _add(draw, random, members, f"seen{i}", "observation", arguments, pushes, [*early, *contexts])
    chosen = [n for n in names if members[n].law.family != "deterministic"]
    members["interest"] = tuple(draw(st.lists(st.sampled_from(chosen), min_size=1, unique=True)))
    try:
        return type("Drawn", (Model,), members)()
    except DeclarationError as error:
        assume("nothing can ever inform" not in str(error))
        raise


def _mood(by_kind):
    """A hidden Markov chain that has nothing to do with what is Gaussian, but perhaps with the finite static."""

    def sign(mood, kind):
        table = torch.tensor([[0.6, 0.3, 0.1], [0.1, 0.2, 0.7]])[mood.long()]
        return Categorical(table + 0.2 * kind)

    return {
        "mood": state(lambda self, prev_mood=0: Bernoulli(0.2 + 0.5 * prev_mood)),
        "sign": observation(
            (lambda self, mood, kind: sign(mood, kind)) if by_kind else lambda self, mood: sign(mood, 0)
        ),
    }


def _hidden(draw, random, members, contexts, pushes, early):
    names = []
    roles = sorted(draw(st.lists(st.sampled_from(["static", "state"]), min_size=1, max_size=3)), key="state".__eq__)
    for i, role in enumerate(roles):
        name = f"{role}{i}"
        arguments = (
            [(n, None) for n in draw(st.lists(st.sampled_from(names), max_size=2, unique=True))] if names else []
        )
        befores = _befores(members)
        if role == "state" and draw(st.booleans()):
            statics = [n for n in names if n.startswith("static")]
            like = draw(st.sampled_from([None, *statics]))
            shape = draw(st.sampled_from([(), (2,), (2, 2)])) if like is None else members[like].law.shape
            before = members[like] if like else torch.as_tensor(random.normal(size=shape))
            arguments.append((f"prev_{name}", before))
        else:
            shape = draw(st.sampled_from([(), (2,), (3,)]))
        if role == "state" and befores and draw(st.booleans()):
            other = draw(st.sampled_from(sorted(befores)))
            arguments.append((f"prev_{other}", befores[other]))
        here = [*early, *contexts] if role == "state" else early
        sure = not any(n in names for n, _ in arguments)
        _add(draw, random, members, name, role, arguments, pushes if role == "state" else [], here, shape, sure)
        names.append(name)
    return names


def _befores(members):
    """Hidden states that some law asks for a step late, with their values before time began."""
    found = {}
    for member in members.values():
        for argument, before in getattr(getattr(member, "law", None), "parents", []):
            if before is not None:
                found[argument.removeprefix("prev_")] = before
    return found


def _add(draw, random, members, name, role, arguments, pushes, contexts, shape=None, sure=True):
    shape = draw(st.sampled_from([(), (2,), (2, 2)])) if shape is None else shape
    families = ["Normal", *(["MultivariateNormal"] if len(shape) == 1 else []), *([] if sure else ["deterministic"])]
    family = draw(st.sampled_from(families))
    chosen = [c for c in contexts if draw(st.booleans())]
    lead, size = [2 + (c == "kind") for c in chosen], int(np.prod(shape))
    parents = [*arguments, *((p, None) for p in pushes if draw(st.booleans()))]
    tables = {"offset": random.normal(size=(*lead, size)), "spread": random.uniform(0.3, 1.5, size=(*lead, size))}
    for argument, before in parents:
        width = 2 if argument == "push" else int(np.prod(_shape_of(members, argument, shape, before)))
        tables[argument] = 0.7 * random.normal(size=(*lead, size, width))
    root = random.normal(size=(*lead, size, size))
    tables["joint"] = root @ root.swapaxes(-1, -2) + 0.2 * np.eye(size)
    tables = {key: torch.as_tensor(table) for key, table in tables.items()}
    law = affine_law(family, shape, tables, parents, [(c, None) for c in chosen])
    law.shape, law.family, law.parents = shape, family, arguments
    members[name] = DECORATORS[role](law)


def _shape_of(members, argument, own, before):
    name = argument.removeprefix("prev_")
    return members[name].law.shape if name in members else own


def record_of(model, seed, lose):
    """Actions and observations of a few steps, some elements of which are missing, as the oracles want them."""
    random = np.random.default_rng(seed)
    record = model.simulate(STEPS, seed=seed)
    actions = [{n: record[n][t] for n in model.action_names} for t in range(STEPS)]
    for act in actions:
        act.update({n: _fine(v, random) for n, v in act.items() if v.is_floating_point()})
    seen = [{n: record[n][t].double() for n in model.observation_names} for t in range(STEPS)]
    for see in seen:
        for name, value in see.items():
            gone = torch.as_tensor(random.uniform(size=tuple(value.shape)) < lose)
            see[name] = torch.where(gone, torch.nan, value)
    return actions, seen


def _fine(value, random):
    return torch.as_tensor(random.uniform(-1, 1, size=tuple(value.shape)))
