"""The exact engine against brute force on random finite models: random graphs, random tables."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from pyro.distributions import Bernoulli, Categorical

from apmodels import Binary, DeclarationError, Finite, Model, ValueOutOfRange, action, observation, state, static
from apmodels.simulation import as_given
from inference import Exact
from tests.inference.oracle import Oracle, plain

DECORATORS = {"static": static, "state": state, "observation": observation}


def table_law(kind, table, arguments):
    """A law that looks its parameters up in a table by the values of its parents."""
    body = {
        "Categorical": lambda row: Categorical(row),
        "Bernoulli": lambda row: Bernoulli(row[..., 0] / row.sum(-1)),
        "deterministic": lambda row: row.argmax(-1),
    }[kind]

    def look_up(*values):
        at = table
        for value in values:
            at = at[torch.as_tensor(value).long()]
        return body(at)

    # A law's parents are the names of its arguments, so these must be spelled out.
    header = ", ".join(["self", *(f"{name}={before}" if before is not None else name for name, before in arguments)])
    call = ", ".join(name for name, _ in arguments)
    scope = {"look_up": look_up}
    exec(f"def law({header}):\n    return look_up({call})", scope)
    return scope["law"]


@st.composite
def models(draw):
    """A model of 1 to 3 hidden variables, 1 or 2 observations and perhaps an action, all with 2 or 3 values."""
    roles = draw(st.lists(st.sampled_from(["static", "state"]), min_size=1, max_size=3))
    roles = sorted(roles, reverse=True, key=lambda role: role == "static")
    roles += ["action"] * draw(st.integers(0, 1)) + ["observation"] * draw(st.integers(1, 2))
    random = np.random.default_rng(draw(st.integers(0, 2**31)))
    names, sizes, kinds = [], {}, {}
    for i, role in enumerate(roles):
        name = f"{role}{i}"
        names.append((name, role))
        kinds[name] = draw(st.sampled_from(["Categorical", "Categorical", "Bernoulli", "deterministic"]))
        if role in ("observation", "action") or (role == "static" and i == 0):
            kinds[name] = "Categorical"
        sizes[name] = 2 if kinds[name] == "Bernoulli" else draw(st.integers(2, 3))
    members = {n: action(Finite(sizes[n]) if sizes[n] > 2 else Binary()) for n, r in names if r == "action"}
    for i, (name, role) in enumerate(names):
        if role == "action":
            continue
        parents = [n for n, r in names[:i] if r == "static" or role != "static"]
        if role == "state":
            parents += [n for n, r in names if r == "action"]
        lagged = [n for n, r in names if r in ("state", "action") and role != "static"]
        now = draw(st.lists(st.sampled_from(parents), unique=True, max_size=2)) if parents else []
        now = [n for n in now if not n.startswith("observation")]
        if role == "observation" and not now:
            now = [n for n, r in names if r in ("static", "state")][-1:]
        ago = draw(st.lists(st.sampled_from(lagged), unique=True, max_size=1)) if lagged else []
        arguments = [(n, None) for n in now] + [(f"prev_{n}", min(1, sizes[n] - 1)) for n in ago]
        shape = [sizes[n] for n in (*now, *ago)] + [sizes[name]]
        table = torch.as_tensor(random.uniform(0.05, 1.0, shape) ** 2)
        members[name] = DECORATORS[role](table_law(kinds[name], table, arguments))
    hidden = [n for n, r in names if r in ("static", "state") and kinds[n] != "deterministic"]
    assume(hidden)
    members["interest"] = tuple(draw(st.lists(st.sampled_from(hidden), min_size=1, max_size=2, unique=True)))
    try:
        return type("Drawn", (Model,), members)()
    except DeclarationError as error:
        assume("nothing can ever inform" not in str(error))
        raise


def after(model, seed, lose):
    """A belief after two steps, the second of which may be missing, and the oracle's record."""
    record = model.simulate(2, seed=seed)
    actions = [{n: record[n][t] for n in model.action_names} for t in range(2)]
    seen = [{n: record[n][t] for n in model.observation_names} for t in range(2)]
    if lose:
        seen[1] = dict.fromkeys(seen[1], torch.tensor(torch.nan))
    engine = Exact(model, torch.float64)
    belief = engine.start()
    for act, sense in zip(actions, seen, strict=True):
        belief = engine.update(belief, as_given(act), as_given(sense))
    return belief, (actions, seen)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(models(), st.integers(0, 1000), st.booleans())
def test_any_finite_model_is_filtered_like_brute_force(model, seed, lose):
    oracle = Oracle(model)
    belief, history = after(model, seed, lose)
    assert float(belief.log_evidence) == pytest.approx(oracle.evidence(*history), abs=1e-6)
    spent = {axis.name for axis in belief.engine.layout.spent}
    for node in model.structure.hidden:
        if node.name in spent:
            # Nobody asks for it, and no law does after the first step: it was summed out, and that is said.
            with pytest.raises(ValueOutOfRange, match="let it be of interest"):
                belief.marginal(node.name)
        elif node.random:
            expected = oracle.posterior([node.name], *history)
            marginal = belief.marginal(node.name)
            for value, prob in zip(marginal.values, marginal.probs, strict=True):
                assert float(prob) == pytest.approx(expected.get((plain(value),), 0.0), abs=1e-6)
    interest = list(model.structure.interest)
    assert float(belief.entropy()) == pytest.approx(oracle.entropy(interest, *history), abs=1e-6)


# Shrinking a random table tells little and takes long.
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])
@given(models(), st.integers(0, 1000))
def test_the_gain_of_any_finite_model_is_that_of_brute_force(model, seed):
    belief, history = after(model, seed, False)
    interest, spaces = list(model.structure.interest), [range(model.space(n).size) for n in model.action_names]
    gains = belief.engine.gain(belief).flatten()
    for found, chosen in zip(gains, itertools.product(*spaces), strict=True):
        act = dict(zip(model.action_names, chosen, strict=True))
        assert float(found) == pytest.approx(Oracle(model).gain(interest, *history, act), abs=1e-6)
