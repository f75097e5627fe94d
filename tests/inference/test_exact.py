"""The exact engine against brute force, in float64, to 1e-6."""

import dataclasses

import numpy as np
import pytest
import torch
from pyro.distributions import Bernoulli, Beta, Categorical, MultivariateNormal, Normal, Poisson

from apmodels import (
    Calibrated,
    CountModel,
    DetectorSearch,
    Evidence,
    Finite,
    Grid,
    Model,
    Planted,
    ValueOutOfRange,
    VisualSearch,
    action,
    observation,
    state,
    static,
    where,
)
from apmodels.simulation import as_given
from inference import Exact, Refusal
from tests.inference.oracle import Oracle, plain
from tests.models import Caller, Coin, Counter, Coupled, Dial, Door, Drift, Lamp, RandomWalk, Seasons, Twins, Weather

NAN = float("nan")


class Families(Model):
    """One hypothesis, many families, scalars and arrays."""

    kind = static(lambda self: Categorical(torch.tensor([0.2, 0.5, 0.3])))

    @observation
    def count(self, kind):
        return Poisson(1.0 + 2.0 * kind)

    @observation
    def joint(self, kind):
        spread = torch.tensor([[1.0, 0.3], [0.3, 0.5]]) * (1 + kind)
        return MultivariateNormal(torch.stack([kind * 1.0, -kind * 1.0]), spread)

    @observation
    def vector(self, kind):
        return Normal(torch.arange(3.0) * kind, 1.0 + 0.2 * torch.arange(3)).to_event(1)

    @observation
    def spread(self, kind):
        return Normal(torch.zeros(2, 2), 1.0 + kind).to_event(2)

    @observation
    def bits(self, kind):
        return Bernoulli(0.1 + 0.2 * torch.arange(3) + 0.1 * kind).to_event(1)

    @observation
    def marks(self, kind):
        return Categorical(1.0 + torch.arange(4) * (torch.arange(2)[:, None] == kind)).to_event(1)


class Vectors(Model):
    """Hidden vectors: of bits, static and moving."""

    flip = action(Finite(2))
    pattern = static(lambda self: Bernoulli(torch.tensor([0.2, 0.6])).to_event(1))

    @state
    def field(self, flip, pattern, prev_field=lambda self: torch.tensor([1.0, 0.0])):
        return Bernoulli(0.1 + 0.3 * pattern + 0.3 * prev_field + 0.2 * flip).to_event(1)

    @observation
    def view(self, field):
        return Normal(field, 0.7).to_event(1)


class Unremembered(Model):
    """A state that nobody remembers and a deterministic one of it, an action and a static."""

    pull = action(Finite(2))
    bias = static(lambda self: Bernoulli(0.5))

    @state
    def noise(self, bias):
        return Categorical(1.0 + torch.arange(3) * bias)

    @state
    def shown(self, noise, pull):
        return where(pull == 1, noise, 2 - noise)

    @observation
    def seen(self, shown):
        return Normal(shown * 1.0, 0.8)

    interest = bias


class Memory(Model):
    """Known states that remember actions and observations, by way of a known static."""

    press = action(Finite(3))
    side = static(lambda self: Bernoulli(0.4))
    step = static(lambda self: torch.tensor(2))

    @state
    def total(self, press, step, prev_total=1, prev_heard=0, prev_press=1):
        return (prev_total + press * step + prev_heard.long() + prev_press) % 4

    @observation
    def heard(self, side, total, prev_total=1):
        return Bernoulli(0.1 + 0.2 * total * side + 0.05 * prev_total)

    interest = side


class Slow(Model):
    """A hidden deterministic state that drives itself by way of an action and a hidden one."""

    go = action(Finite(2))
    size = static(lambda self: Categorical(torch.ones(2)))

    @state
    def wheel(self, go, size, prev_wheel=0):
        return (prev_wheel + go * (1 + size)) % 5

    @observation
    def spoke(self, wheel, prev_wheel=0):
        return Bernoulli(0.1 + 0.15 * wheel + 0.05 * prev_wheel)

    interest = (size, wheel)


class Shared(Model):
    """Sparse elements of several kinds: more than one element differs."""

    look = action(Finite(2))
    place = static(lambda self: Categorical(torch.ones(9)))

    @observation
    def marks(self, place, look):
        near = (torch.arange(9) == place) | (torch.arange(9) == (place + look) % 9)
        return Categorical(1.0 + 2.0 * near[:, None] * torch.arange(3)).to_event(1)


class PlantedNormals(Model):
    """A planted element in noise of its own spread."""

    place = static(lambda self: Categorical(torch.ones(3)))

    @observation
    def view(self, place):
        return Planted(place, Normal(1.0 + place, 0.5), Normal(torch.arange(3) * 0.2, 1.0))


class Listener(Model):
    """An Evidence, which has no table."""

    here = static(lambda self: Bernoulli(0.5))

    @observation
    def sound(self, here):
        return Evidence(lambda heard: heard * here)


class Chain(Model):
    """An observation that depends on another of the same step."""

    here = static(lambda self: Bernoulli(0.5))

    @observation
    def first(self, here):
        return Bernoulli(0.2 + 0.5 * here)

    @observation
    def second(self, here, first):
        return Bernoulli(0.2 + 0.3 * here + 0.3 * first)


def counts():
    present = torch.tensor([[[1.0, 2, 3], [1, 2, 2]], [[2, 2, 3], [1, 1, 1]]], dtype=torch.float64)
    return CountModel(present, torch.tensor([[[3.0, 1, 1], [4, 1, 1]]], dtype=torch.float64))


MODELS = {
    "statics": Coin(),
    "chain": Seasons(),
    "action": Door(),
    "coupled": Coupled(),
    "deterministic": Counter(),
    "timer": Caller(),
    "first value": Drift(),
    "dicts": Twins(),
    "finite": Lamp(),
    "box": Dial(),
    "families": Families(),
    "vectors": Vectors(),
    "unremembered": Unremembered(),
    "memory": Memory(),
    "wheel": Slow(),
    "dense": VisualSearch(grid=Grid(1, 3), acuity=Calibrated(width=1.5)),
    "sparse": VisualSearch(grid=Grid(3, 3), acuity=Calibrated(width=1.5)),
    "several sparse": Shared(),
    "detector": DetectorSearch(grid=Grid(2, 3), counts=counts()),
    "planted": PlantedNormals(),
}


def engine_of(model):
    return Exact(model, dtype=torch.float64)


def record_of(model, steps, seed=0):
    """Actions and observations, each a list of dicts."""
    record = model.simulate(steps, seed=seed)
    lists = [
        [{n: record[n][t] for n in names} for t in range(steps)]
        for names in (model.action_names, model.observation_names)
    ]
    return lists


def beliefs_of(engine, actions, seen):
    belief = engine.start()
    for act, sense in zip(actions, seen, strict=True):
        belief = engine.update(belief, as_given(act), as_given(sense))
        yield belief


def hold(belief, oracle, actions, seen, names):
    """Hold every marginal, the joint entropy and the evidence of a belief to the oracle."""
    for name in names:
        marginal = belief.marginal(name)
        expected = oracle.posterior([name], actions, seen)
        found = {(plain(v),): float(p) for v, p in zip(marginal.values, marginal.probs, strict=True)}
        assert all(found.get(v, 0.0) == pytest.approx(p, abs=1e-6) for v, p in expected.items()), name
        assert sum(found.values()) == pytest.approx(1.0, abs=1e-6)
    assert float(belief.entropy(tuple(names))) == pytest.approx(oracle.entropy(names, actions, seen), abs=1e-6)
    assert float(belief.log_evidence) == pytest.approx(oracle.evidence(actions, seen), abs=1e-6)


def inferred(model):
    """The hidden variables about which a belief is held."""
    hidden = [node.name for node in model.structure.hidden]
    remembered = type(model).declaration.remembered
    return [n for n in hidden if n in remembered or model.structure.nodes[n].random]


@pytest.mark.parametrize("name", MODELS)
def test_beliefs_are_those_of_brute_force(name):
    model = MODELS[name]
    oracle, engine = Oracle(model), engine_of(model)
    for seed in (1, 2):
        actions, seen = record_of(model, 3, seed)
        names = inferred(model)
        for t, belief in enumerate(beliefs_of(engine, actions, seen), 1):
            hold(belief, oracle, actions[:t], seen[:t], names)
            assert belief.time == t and belief.batch is None
            assert belief.log_evidence.shape == belief.entropy().shape == ()
        interest = ["interest"] if model.declaration.interest else list(model.structure.interest)
        assert float(belief.entropy()) == pytest.approx(oracle.entropy(interest, actions, seen), abs=1e-6)
        assert float(belief.entropy(bits=True)) == pytest.approx(float(belief.entropy()) / np.log(2))


@pytest.mark.parametrize("name", [n for n in MODELS if n not in ("memory", "coupled")])
def test_missing_observations_say_nothing(name):
    """Nothing of the second step is seen, and in the third half the elements; nor do laws of the next step ask."""
    model = MODELS[name]
    actions, seen = record_of(model, 3, 3)
    for key, value in seen[1].items():
        seen[1][key] = torch.full(value.shape, NAN)
    for key, value in seen[2].items():
        if value.dim() and key != "joint":
            seen[2][key] = torch.where(torch.arange(value.numel()).reshape(value.shape) % 2 == 0, value, NAN)
    oracle = Oracle(model)
    for t, belief in enumerate(beliefs_of(engine_of(model), actions, seen), 1):
        hold(belief, oracle, actions[:t], seen[:t], inferred(model))


@pytest.mark.parametrize("name", MODELS)
def test_forecasts_score_like_brute_force(name):
    model = MODELS[name]
    oracle, engine = Oracle(model), engine_of(model)
    actions, seen = record_of(model, 3, 4)
    *_, belief = beliefs_of(engine, actions[:2], seen[:2])
    forecast = engine.forecast(belief, as_given(actions[2]))
    forecast = forecast if isinstance(forecast, dict) else {model.observation_names[0]: forecast}
    nothing = {n: None for n in model.observation_names}
    for key, law in forecast.items():
        alone = {**nothing, key: seen[2][key]}
        expected = oracle.predictive(actions[:2], seen[:2], actions[2], alone)
        value = seen[2][key].to(torch.float64)
        assert float(law.log_prob(value)) == pytest.approx(expected, abs=1e-6), key
        drawn = law.sample((2000,)).double()
        assert drawn.shape == (2000, *value.shape)


def test_forecasts_draw_what_they_score():
    engine = engine_of(Seasons())
    belief = engine.update(engine.start(4), None, torch.tensor([0.0, 2.0, 4.0, NAN]))
    forecast = engine.forecast(belief, None)
    torch.manual_seed(0)
    drawn = forecast.sample((20_000,))
    assert drawn.shape == (20_000, 4)
    assert (drawn.mean(0) - forecast.mean).abs().max() < 5 * 2.5 / 20_000**0.5


def test_the_noisy_forecast_of_visual_search_has_the_right_mean():
    model = MODELS["sparse"]
    engine = engine_of(model)
    belief = engine.update(engine.start(), 4, torch.linspace(-1, 2, 9))
    signal = model.acuity(model.grid.distance(torch.arange(9), torch.tensor(2)))
    assert torch.allclose(engine.forecast(belief, 2).mean, belief.marginal("target").probs * signal, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_a_batch_equals_single_beliefs(name):
    """Also when contexts are met in another order, by another number of beliefs at a time."""
    model, count, steps = MODELS[name], 4, 3
    record = model.simulate(steps, batch=count, seed=5)
    engine, single = engine_of(model), engine_of(model)
    batch = engine.start(batch=count)
    singles = [single.start() for _ in range(count)]
    for t in range(steps):
        acts = {n: record[n][:, t] for n in model.action_names}
        seen = {n: record[n][:, t] for n in model.observation_names}
        batch = engine.update(batch, as_given(acts), as_given(seen))
        for i in range(count):
            one = {n: v[i] for n, v in acts.items()}, {n: v[i] for n, v in seen.items()}
            singles[i] = single.update(singles[i], *map(as_given, one))
    assert batch.log_evidence.shape == batch.entropy().shape == (count,)
    for i, belief in enumerate(singles):
        assert batch.log_evidence[i] == pytest.approx(float(belief.log_evidence), abs=1e-9)
        for key in inferred(model):
            assert torch.allclose(batch.marginal(key).probs[i], belief.marginal(key).probs, atol=1e-9)
            assert batch.marginal(key).mean[i].shape == belief.marginal(key).mean.shape


def test_one_action_serves_a_whole_batch():
    engine = engine_of(Door())
    seen = torch.tensor([0.0, 1.0, NAN])
    shared = engine.update(engine.start(3), 1, seen)
    each = engine.update(engine.start(3), torch.tensor([1, 1, 1]), seen)
    assert torch.equal(shared.log_probs, each.log_probs)
    assert not torch.allclose(shared.log_probs, engine.update(engine.start(3), 0, seen).log_probs)


def test_a_belief_is_a_value():
    engine = engine_of(Caller())
    before = engine.update(engine.start(2), 1, torch.tensor([1.0, 0.0]))
    kept = before.log_probs.clone(), before.log_evidence.clone(), {k: v.clone() for k, v in before.known.items()}
    after = engine.update(before, 0, torch.tensor([0.0, 1.0]))
    for wrong in ((2, [0.0, 0.0]), (0, [2.0, 0.0]), (0, [0.0, float("inf")])):
        with pytest.raises(ValueOutOfRange):
            engine.update(before, *wrong)
    assert torch.equal(before.log_probs, kept[0]) and torch.equal(before.log_evidence, kept[1])
    assert all(torch.equal(before.known[k], v) for k, v in kept[2].items()) and before.time == 1
    again = engine.update(before, 0, torch.tensor([0.0, 1.0]))
    assert torch.equal(again.log_probs, after.log_probs)
    with pytest.raises(dataclasses.FrozenInstanceError):
        before.time = 3


@pytest.mark.parametrize("batch", [None, 1, 3])
def test_a_new_belief_is_the_prior(batch):
    rows = () if batch is None else (batch,)
    belief = engine_of(Coin()).start(batch)
    assert belief.batch == batch and belief.time == 0
    assert belief.log_evidence.shape == rows and not belief.log_evidence.any()
    assert belief.marginal("reader").probs.shape == (*rows, 3)
    assert belief.most_probable("reader").shape == belief.marginal("reader").mean.shape == rows
    assert torch.allclose(belief.marginal("biased").probs, torch.tensor([0.7, 0.3], dtype=torch.float64))
    drift = engine_of(Drift()).start(batch)
    assert torch.allclose(drift.marginal("place").probs, drift.marginal("home").probs)
    assert torch.allclose(drift.entropy(("home", "place")), drift.entropy("home"))


def test_marginals_speak_in_the_variables_units():
    engine = engine_of(Vectors())
    belief = engine.update(engine.start(2), 1, torch.tensor([[1.0, 0.2], [0.0, 1.5]]))
    field = belief.marginal("field")
    assert field.values.shape == (4, 2) and field.mean.shape == (2, 2) and field.probs.shape == (2, 4)
    assert torch.equal(field.mode, belief.most_probable("field"))
    assert torch.allclose(field.mean, torch.einsum("bn,nd->bd", field.probs, field.values.double()))
    assert torch.equal(field.mode, field.values[field.probs.argmax(-1)])


def test_entropies_of_several_variables_do_not_depend_on_their_order():
    engine = engine_of(Coupled())
    *_, belief = beliefs_of(engine, *record_of(Coupled(), 3))
    one = belief.entropy(("near", "far", "kind"))
    assert torch.allclose(one, belief.entropy(("kind", "near", "far")))
    assert belief.entropy("near") <= one <= belief.entropy("near") + belief.entropy("far") + belief.entropy("kind")


@pytest.mark.parametrize(("model", "name"), [(Caller(), "timer"), (Caller(), "vocalize"), (Caller(), "responsiv")])
def test_a_marginal_of_what_is_not_inferred_is_refused(model, name):
    with pytest.raises(ValueOutOfRange, match=name):
        Exact(model).start().marginal(name)


def test_what_a_belief_does_not_keep_is_refused_by_name():
    with pytest.raises(ValueOutOfRange, match="shown depends on pull"):
        Exact(Unremembered()).start().marginal("shown")


class Trust(Model):
    rate = static(lambda self: Beta(1.0, 1.0))

    @observation
    def toss(self, rate):
        return Bernoulli(rate)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (Weather(), "weather changes from step to step"),
        (RandomWalk(), "not enumerated"),
        (Listener(), "sound is an Evidence"),
        (Chain(), "second depends on first"),
    ],
)
def test_a_refusal_names_the_variable_and_the_reason(model, words):
    assert not Exact.bid(model.structure)
    with pytest.raises(Refusal, match=f"Exact cannot serve {type(model).__name__}: .*{words}"):
        Exact(model)


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize(
    "wrong",
    [3, -1, NAN, 1.5, [0, 1, 2], [[0, 0]], None, {"mov": 1}, {}, {"move": 1, "more": 0}, {"move": NAN}, float("inf")],
)
def test_a_bad_action_is_out_of_range(wrong, batch):
    engine = Exact(Coupled())
    with pytest.raises(ValueOutOfRange, match=r"action|move") as error:
        engine.update(engine.start(batch), wrong, 1.0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("wrong", [{"left": 0}, {"left": 0, "rihgt": 1}, 1, {"left": 0, "right": 3}])
def test_bad_actions_of_several_are_out_of_range(wrong):
    engine = Exact(Twins())
    with pytest.raises(ValueOutOfRange, match=r"left|right"):
        engine.update(engine.start(), wrong, {"here": 1.0, "there": 0})


@pytest.mark.parametrize("wrong", [1.5, -1.01, NAN, float("inf"), [0.1, 0.2]])
def test_a_bad_continuous_action_is_out_of_range(wrong):
    engine = Exact(Dial())
    with pytest.raises(ValueOutOfRange, match="turn"):
        engine.update(engine.start(), wrong, 0.0)


def test_an_action_where_there_is_none_is_refused():
    engine = Exact(Seasons())
    with pytest.raises(ValueOutOfRange, match="no action"):
        engine.update(engine.start(), 1, 0.0)


@pytest.mark.parametrize(
    ("name", "key", "wrong"),
    [
        ("chain", "warmth", [0.0, 1.0]),
        ("chain", "warmth", float("inf")),
        ("chain", "warmth", None),
        ("sparse", "glimpse", torch.zeros(8)),
        ("sparse", "glimpse", torch.full((9,), -float("inf"))),
        ("finite", "flash", 2.0),
        ("finite", "flash", 0.5),
        ("finite", "flash", -1),
        ("detector", "glimpse", [0, 0, 3, 0, 0, 0]),
        ("detector", "glimpse", [0, 0, 0.5, 0, 0, NAN]),
        ("detector", "glimpse", [0, 0, -1, 0, 0, 0]),
        ("finite", "flash", {"flahs": 1.0}),
    ],
)
def test_a_bad_observation_is_out_of_range(name, key, wrong):
    model = MODELS[name]
    engine = Exact(model)
    with pytest.raises(ValueOutOfRange, match=f"{key}|observation") as error:
        engine.update(engine.start(), 0 if model.action_names else None, wrong)
    assert "\n" not in str(error.value)


def test_an_observation_of_another_batch_is_out_of_range():
    engine = Exact(Lamp())
    with pytest.raises(ValueOutOfRange, match="flash has shape"):
        engine.update(engine.start(3), 0, torch.zeros(2))


def test_a_record_is_filtered_as_it_is_updated():
    model = Coupled()
    engine = engine_of(model)
    record = model.simulate(4, batch=3, seed=1)
    beliefs = engine.filter(record["move"], record["sound"], batch=3)
    single = engine.filter(record["move"][1], {"sound": record["sound"][1]})
    assert [b.time for b in beliefs] == [1, 2, 3, 4] and single[-1].batch is None
    assert torch.allclose(beliefs[-1].marginal("near").probs[1], single[-1].marginal("near").probs)
    assert torch.allclose(beliefs[2].log_evidence[1], single[2].log_evidence)
    assert [b.time for b in engine_of(Seasons()).filter(None, torch.zeros(2))] == [1, 2]


@pytest.mark.parametrize("name", ["action", "dicts", "sparse", "detector", "chain"])
def test_preparing_changes_no_belief(name):
    model = MODELS[name]
    actions, seen = record_of(model, 3)
    *_, lazy = beliefs_of(engine_of(model), actions, seen)
    prepared = engine_of(model)
    assert prepared.prepare() is prepared
    *_, eager = beliefs_of(prepared, actions, seen)
    assert torch.allclose(lazy.log_probs, eager.log_probs) and torch.allclose(lazy.log_evidence, eager.log_evidence)


@pytest.mark.parametrize("name", ["box", "timer"])
def test_what_cannot_be_listed_cannot_be_prepared(name):
    with pytest.raises(ValueOutOfRange, match="listed beforehand"):
        Exact(MODELS[name]).prepare()


def test_single_precision_is_close_enough():
    for model in (Coupled(), Drift(), MODELS["sparse"], MODELS["detector"]):
        actions, seen = record_of(model, 3)
        *_, low = beliefs_of(Exact(model, torch.float32), actions, seen)
        *_, high = beliefs_of(engine_of(model), actions, seen)
        assert torch.allclose(low.log_evidence.double(), high.log_evidence, atol=1e-4)
        assert torch.allclose(low.entropy().double(), high.entropy(), atol=1e-4)
