"""A whole record filtered at once against the same record, step by step."""

from dataclasses import fields

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pyro.distributions import Bernoulli, Categorical, Normal
from torch import Tensor

from apmodels import Finite, Model, ValueOutOfRange, action, observation, state, static, where, zeros
from apmodels.simulation import as_given
from inference import Exact, Kalman
from inference.records import finite_record, passage
from inference.records.record import Later, Record, alone
from tests import models
from tests.inference.affine_models import affine_models
from tests.inference.test_exact_random import models as finite_models

STEPS = 12
# Shrinking a random matrix tells little and takes long.
QUICK = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])
GIVEN = st.sampled_from(["all", "alike", "each"])


def stepwise(engine, actions, seen, batch):
    return engine.stepwise(engine.start(batch), Record.of(engine, actions, seen))


def at_once(beliefs):
    """Whether none of them was updated from the one before; ask before they are read."""
    return all(isinstance(item, Later) for item in getattr(beliefs, "_items", beliefs))


def record_of(model, batch, missing, steps=STEPS, seed=0):
    """Actions and observations (batch, steps, *shape), of which a third may be missing: alike in the batch, or not."""
    record = model.simulate(steps, batch=batch, seed=seed)
    draw = torch.Generator().manual_seed(seed)
    seen = {}
    for name in model.observation_names:
        value = record[name].double()
        gone = torch.rand(value[:1].shape if missing == "alike" else value.shape, generator=draw) < 1 / 3
        seen[name] = value if missing == "all" else torch.where(gone, torch.nan, value)
    return {name: record[name] for name in model.action_names} or None, seen


def assert_same(found, expected, close=1e-8):
    """Every tensor of two beliefs, where what is the same in all rows or worlds may be held once."""
    for field in fields(expected):
        if field.name in ("engine", "batch", "time"):
            assert getattr(found, field.name) == getattr(expected, field.name)
        else:
            _assert_same(getattr(found, field.name), getattr(expected, field.name), close, field.name)


def _assert_same(found, expected, close, where):
    if isinstance(expected, Tensor):
        found, wide = torch.broadcast_tensors(found, expected)
        assert wide.shape == expected.shape or where == "gaussian"
        assert found.dtype == expected.dtype
        if where in ("log_weights", "log_probs"):
            found, wide = found.exp(), wide.exp()
        torch.testing.assert_close(found, wide, rtol=close, atol=close)
    elif isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            _assert_same(found[key], value, close, where)
    elif isinstance(expected, (tuple, list)):
        for one, other in zip(found, expected, strict=True):
            _assert_same(one, other, close, where)
    else:
        assert found == expected


def assert_filters(engine, actions, seen, batch, close=1e-8):
    beliefs = engine.filter(actions, seen, batch)
    for found, expected in zip(beliefs, stepwise(engine, actions, seen, batch), strict=True):
        assert_same(found, expected, close)
    return beliefs


@QUICK
@given(affine_models(), st.integers(0, 1000), GIVEN, st.sampled_from([None, 1, 3]))
def test_any_affine_record_is_filtered_as_step_by_step(model, seed, missing, batch):
    actions, seen = record_of(model, batch, missing if batch else "all", seed=seed)
    assert_filters(Kalman(model, torch.float64), actions, seen, batch)


@QUICK
@given(finite_models(), st.integers(0, 1000), GIVEN, st.sampled_from([None, 1, 3]))
def test_any_finite_record_is_filtered_as_step_by_step(model, seed, missing, batch):
    kept = [name for name in model.observation_names if name in model.declaration.remembered]
    actions, seen = record_of(model, batch, missing if batch and not kept else "all", seed=seed)
    assert_filters(Exact(model, torch.float64), actions, seen, batch)


@pytest.mark.parametrize("missing", ["all", "alike", "each"])
@pytest.mark.parametrize("kind", [models.RandomWalk, models.Tracking])
def test_a_gaussian_record_is_filtered_at_once(kind, missing):
    model = kind()
    actions, seen = record_of(model, 4, missing)
    beliefs = Kalman(model, torch.float64).filter(actions, seen, 4)
    assert at_once(beliefs)
    assert_filters(Kalman(model, torch.float64), actions, seen, 4)
    assert len(beliefs) == STEPS and beliefs[-1].time == STEPS
    assert [belief.time for belief in beliefs[2:4]] == [3, 4]
    assert beliefs[3] is beliefs[3]


FINITE = [
    models.Coin,
    models.Seasons,
    models.Door,
    models.Coupled,
    models.Counter,
    models.Caller,
    models.Drift,
    models.Twins,
    models.Lamp,
    models.Dial,
]


@pytest.mark.parametrize("kind", FINITE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_finite_record_is_filtered_at_once(kind, dtype):
    model = kind()
    actions, seen = record_of(model, 4, "all" if kind is models.Coupled else "each", steps=40)
    engine = Exact(model, dtype)
    assert at_once(engine.filter(actions, seen, 4))
    assert_filters(engine, actions, seen, 4, 1e-8 if dtype == torch.float64 else 1e-5)


@pytest.mark.parametrize("engine", [Kalman(models.Tracking()), Exact(models.Coupled())])
def test_one_record_goes_for_a_whole_batch(engine):
    actions, seen = record_of(engine.model, None, "all")
    assert_filters(engine, actions, seen, 3, 1e-5)
    actions, _ = record_of(engine.model, 3, "all", seed=1)
    assert_filters(engine, actions, seen, 3, 1e-5)


class Switch(Model):
    """Hypotheses that change how a state moves, a clock, an action, and a finite observation of the hypothesis."""

    push = action(Finite(3))

    @static
    def fast(self):
        return Bernoulli(0.3)

    @state
    def clock(self, push, prev_clock=0):
        return where(push == 2, 0, prev_clock + 1)

    @state
    def speed(self, fast, prev_speed=1.0):
        return Normal((0.5 + 0.4 * fast) * prev_speed, 0.3)

    @state
    def place(self, speed, push, clock, prev_place=0.0):
        return Normal(prev_place + speed + push, 0.1 + 0.1 * (clock % 2))

    @observation
    def reading(self, place, prev_place=0.0):
        return Normal(place - 0.5 * prev_place, 0.5)

    @observation
    def hint(self, fast, clock):
        return Bernoulli(0.4 + 0.1 * fast + 0.01 * (clock % 3))


@pytest.mark.parametrize("missing", ["all", "alike", "each"])
def test_hypotheses_known_states_and_actions(missing):
    model = Switch()
    actions, seen = record_of(model, 4, missing, steps=30)
    engine = Kalman(model, torch.float64)
    assert at_once(engine.filter(actions, seen, 4))
    assert_filters(engine, actions, seen, 4)
    shared = {"push": actions["push"][0]}
    assert_filters(engine, shared, seen, 4)


def test_long_records_are_filtered_in_pieces(monkeypatch):
    from inference.records import bank_record

    monkeypatch.setattr(bank_record, "MOST", 2000)
    monkeypatch.setattr(finite_record, "MOST", 2000)
    for engine in (Kalman(Switch(), torch.float64), Exact(models.Coupled(), torch.float64)):
        actions, seen = record_of(engine.model, 4, "all", steps=100)
        assert at_once(engine.filter(actions, seen, 4))
        assert_filters(engine, actions, seen, 4)
    monkeypatch.setattr(bank_record, "MOST", 100)
    monkeypatch.setattr(finite_record, "MOST", 100)
    for engine in (Kalman(Switch()), Exact(models.Coupled())):
        actions, seen = record_of(engine.model, 4, "all")
        assert not at_once(engine.filter(actions, seen, 4))
        assert_filters(engine, actions, seen, 4, 1e-5)


def test_what_is_wide_is_filtered_step_by_step(monkeypatch):
    from inference.records import bank_record

    monkeypatch.setattr(bank_record, "WIDEST", 1)
    engine = Kalman(models.Tracking())
    assert not at_once(engine.filter(*record_of(engine.model, 2, "all"), 2))
    assert_filters(engine, *record_of(engine.model, 2, "all"), 2)


def test_spans_that_are_not_accurate_are_not_used(monkeypatch):
    monkeypatch.setattr(passage, "gains", lambda *_: None)
    engine = Kalman(models.Tracking())
    assert not at_once(engine.filter(*record_of(engine.model, 2, "all"), 2))
    assert_filters(engine, *record_of(engine.model, 2, "all"), 2)


class Certain(Model):
    """Two sensors without noise of something that never moves, and one with."""

    @static
    def value(self):
        return Normal(zeros(2), 1.0).to_event(1)

    @observation
    def exact(self, value):
        return Normal(value[0], 1e-9)

    @observation
    def rough(self, value):
        return Normal(value.sum(), 1.0)


def test_what_becomes_certain_stays_so():
    model = Certain()
    engine = Kalman(model, torch.float64)
    beliefs = assert_filters(engine, None, {"exact": torch.full((40,), 0.3), "rough": torch.ones(40)}, None, 1e-6)
    assert float(beliefs[-1].marginal("value").mean[0]) == pytest.approx(0.3)


class Sure(Model):
    """What has been seen cannot be unseen: a record may be impossible."""

    @static
    def side(self):
        return Bernoulli(0.5)

    @state
    def lamp(self, side, prev_lamp=0):
        return Categorical(where(prev_lamp == 0, torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.0, 0.3, 0.7])))

    @observation
    def light(self, lamp, side):
        return Normal(1.0 * lamp + side, 0.01)


def test_impossible_statics_and_far_values():
    engine = Exact(Sure())
    # In single precision the first values cannot come back once they are improbable enough.
    seen = torch.tensor([0.0, 0.0, 1.0, 2.0, 1.0, 2.0, 2.0, 2.0, 1.0, 2.0])
    beliefs = assert_filters(engine, None, seen, None, 1e-5)
    assert float(beliefs[0].log_evidence) == pytest.approx(float(stepwise(engine, None, seen, None)[0].log_evidence))


def test_an_impossible_record_is_refused():
    class Never(Model):
        @state
        def lit(self, prev_lit=0):
            return Bernoulli(where(prev_lit == 1, 1.0, 0.5))

        @observation
        def seen(self, lit):
            return Categorical(where(lit == 1, torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0])))

    with pytest.raises(ValueOutOfRange, match="no probability at all"):
        Exact(Never()).filter(None, torch.tensor([0, 1, 1, 0, 1, 1, 1, 1, 1, 1]))
    beliefs = Exact(Never()).filter(None, torch.tensor([0, 0, 0, 0, 0, 0, 0, 0, 1, 1]))
    assert float(beliefs[-1].marginal("lit").probs[1]) == 1


@pytest.mark.parametrize("engine", [Kalman(models.Tracking()), Exact(models.Seasons()), Exact(models.Lamp())])
def test_what_is_wrong_in_a_record_is_said(engine):
    actions, seen = record_of(engine.model, None, "all")
    name = engine.model.observation_names[0]
    bad = seen[name].clone()
    bad[3] = torch.inf
    with pytest.raises(ValueOutOfRange, match=name):
        engine.filter(actions, bad)
    with pytest.raises(ValueOutOfRange, match="shape"):
        engine.filter(actions, torch.ones(3, STEPS, *engine.shown[name]), batch=2)
    if actions:
        with pytest.raises(ValueOutOfRange, match="steps"):
            engine.filter({n: v[:-1] for n, v in actions.items()}, seen)


def test_an_action_outside_its_space_is_said():
    with pytest.raises(ValueOutOfRange, match="look"):
        Exact(models.Lamp()).filter(torch.full((9,), 7), torch.zeros(9))


def test_an_empty_record_leaves_nothing():
    assert len(Exact(models.Seasons()).filter(None, torch.zeros(0))) == 0
    assert len(Kalman(models.RandomWalk()).filter(None, torch.zeros(0))) == 0


class Learned(Model):
    """Laws with fields that may have gradients."""

    drift: Tensor = torch.tensor(0.5)
    table: Tensor = torch.tensor([[0.7, 0.3], [0.2, 0.8]])

    @state
    def position(self, prev_position=0.0):
        return Normal(self.drift * prev_position, 1.0)

    @observation
    def reading(self, position):
        return Normal(position, self.drift)


class LearnedChain(Model):
    table: Tensor = torch.tensor([[0.7, 0.3], [0.2, 0.8]])

    @state
    def mood(self, prev_mood=0):
        return Categorical(self.table[prev_mood])

    @observation
    def sign(self, mood):
        return Categorical(self.table[mood])


@pytest.mark.parametrize(("make", "model", "name"), [(Kalman, Learned(), "drift"), (Exact, LearnedChain(), "table")])
def test_a_record_at_once_has_the_gradient_of_the_record_step_by_step(make, model, name):
    record = model.simulate(10, seed=1)
    seen = record[model.observation_names[0]]
    found = []
    for whole in (True, False):
        field = getattr(model, name).double().requires_grad_()
        engine = make(model.replace(**{name: field}), torch.float64)
        beliefs = engine.filter(None, seen) if whole else stepwise(engine, None, seen, None)
        assert not whole or at_once(beliefs)
        found.append(torch.autograd.grad(beliefs[-1].log_evidence, field)[0])
    torch.testing.assert_close(*found)


def test_small_operations_take_one_thread_and_give_it_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with alone(10):
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
        with alone(1 << 20):
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_as_given_is_understood():
    engine = Exact(models.Door())
    actions, seen = record_of(engine.model, None, "all")
    assert_filters(engine, as_given(actions), as_given(seen), None, 1e-5)
