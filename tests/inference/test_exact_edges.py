"""The exact engine where declarations are unusual, and where something goes wrong halfway."""

import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal, Poisson

import inference.tables.contexts
from apmodels import (
    Box,
    CountModel,
    DeclarationError,
    DetectorSearch,
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
from inference import Exact, Refusal
from tests.inference.oracle import Oracle, plain
from tests.models import Caller, Lamp

NAN = float("nan")


def engine_of(model):
    return Exact(model, torch.float64)


def hold(model, actions, seen, *names):
    """Hold the posterior of variables and the evidence to the oracle; of one observation and at most one action."""
    (observed,) = model.observation_names
    engine = engine_of(model)
    belief = engine.start()
    acts = [dict.fromkeys(model.action_names, value) for value in actions]
    for act, y in zip(actions, seen, strict=True):
        belief = engine.update(belief, act, y)
    record = acts, [{observed: torch.as_tensor(y)} for y in seen]
    assert float(belief.log_evidence) == pytest.approx(Oracle(model).evidence(*record), abs=1e-6)
    for name in names:
        expected = Oracle(model).posterior([name], *record)
        marginal = belief.marginal(name)
        for value, prob in zip(marginal.values, marginal.probs, strict=True):
            assert float(prob) == pytest.approx(expected.get((plain(value),), 0.0), abs=1e-6)


def fair(count=2):
    return static(lambda self: Categorical(torch.ones(count)))


# Unusual declarations.


class Parity(Model):
    """An observation without noise."""

    number = fair(3)

    @observation
    def odd(self, number):
        return number % 2


def test_an_observation_without_noise():
    hold(Parity(), [None], [0], "number")


class Shrinking(Model):
    """A state with two values that begins as a static with three."""

    first = fair(3)

    @state
    def now(self, prev_now=first):
        return Categorical(torch.tensor([[0.7, 0.3], [0.4, 0.6], [0.1, 0.9]])[prev_now])

    @observation
    def seen(self, now):
        return Bernoulli(0.1 + 0.8 * now)


def test_a_state_may_begin_at_a_static_that_has_more_values():
    hold(Shrinking(), [None, None], [1.0, 0.0], "now", "first")


class Begun(Model):
    """A hidden deterministic state that begins as a deterministic static."""

    kind = fair()

    @static
    def first(self, kind):
        return 2 * kind

    @state
    def now(self, kind, prev_now=first):
        return (prev_now + 1).clamp(max=4)

    @observation
    def seen(self, now):
        return Bernoulli(0.1 + 0.2 * now)


def test_a_state_may_begin_at_a_deterministic_static():
    hold(Begun(), [None, None], [1.0, 0.0], "kind", "now")


class Clock(Model):
    """A known state that begins as a known static."""

    kind = fair()
    noon = static(lambda self: torch.tensor(2))

    @state
    def hour(self, prev_hour=noon):
        return (prev_hour + 1) % 4

    @observation
    def bell(self, kind, hour):
        return Bernoulli(0.1 + 0.2 * hour + 0.1 * kind)

    interest = kind


def test_a_known_state_may_begin_at_a_known_static():
    hold(Clock(), [None, None], [1.0, 0.0], "kind")


class Uninterested(Caller):
    """The timer is known, and no interest is declared."""

    interest = None


def test_by_default_the_interest_is_all_that_is_hidden():
    belief = engine_of(Uninterested()).start()
    assert torch.allclose(belief.entropy(), belief.entropy("responsive"))


class Echo(Model):
    """What was observed a step ago is an index."""

    kind = fair()

    @observation
    def note(self, kind, prev_note=0):
        rows = torch.tensor([[0.2, 0.3, 0.5], [0.1, 0.8, 0.1], [0.3, 0.3, 0.4]])
        return Categorical(rows[prev_note] + kind * torch.tensor([0.0, 0.5, 0.5]))


def test_a_remembered_observation_keeps_its_type():
    hold(Echo(), [None, None], [1, 2], "kind")


class Habit(Model):
    kind = fair()

    @observation
    def note(self, kind, prev_note=0):
        return Bernoulli(0.2 + 0.3 * kind + 0.4 * prev_note)


def test_a_missing_observation_that_a_law_remembers_is_refused_in_its_own_words():
    engine = engine_of(Habit())
    belief = engine.update(engine.start(), None, NAN)
    with pytest.raises(ValueOutOfRange, match="missing"):
        engine.update(belief, None, 1.0)


def test_nothing_need_be_hidden():
    class Plain(Model):
        push = action(Finite(2))

        @observation
        def sound(self, push):
            return Bernoulli(0.2 + 0.5 * push)

    try:
        engine = engine_of(Plain())
    except Refusal:
        return
    belief = engine.update(engine.start(), 1, 1.0)
    assert float(belief.log_evidence.exp()) == pytest.approx(0.7)


def test_two_values_before_time_began_are_both_heeded_or_refused():
    try:

        class Torn(Model):
            kind = fair()

            @state
            def count(self, prev_count=0):
                return (prev_count + 1).clamp(max=3)

            @observation
            def sound(self, kind, count, prev_count=3):
                return Bernoulli(0.1 + 0.1 * prev_count + 0.1 * count + 0.1 * kind)

            interest = kind

    except DeclarationError:
        return
    hold(Torn(), [None, None], [1.0, 0.0], "kind")


# Tables that differ between contexts.


class Uneven(Model):
    """What kind of table serves an action depends on it: sparse in one or two elements, dense, of unequal spread."""

    look = action(Finite(4))
    place = fair(9)

    @observation
    def view(self, place, look):
        near = (torch.arange(9) - place).abs() < where(look == 3, 9, look)
        return Normal(1.0 * near * (1 + place), where(look == 2, 1.0 + 0.1 * place, 1.0)).to_event(1)


@pytest.mark.parametrize(
    "actions",
    [
        [0, 1, 2],
        [2, 1],
        [1, 3, 0],
        [3, 2],
    ],
)
def test_contexts_may_need_different_tables(actions):
    glimpses = [torch.linspace(-1, 2, 9).roll(i) for i in range(len(actions))]
    hold(Uneven(), actions, glimpses, "place")


class Counting(Model):
    kind = fair()

    @state
    def steps(self, prev_steps=0):
        return prev_steps + 1

    @observation
    def seen(self, kind, steps):
        return Normal(1.0 * kind * steps, 1.0)

    interest = kind


def test_tables_may_start_again(monkeypatch):
    """Known values without end are as good as a continuum, of which not all are kept."""
    kept = engine_of(Counting()).filter(None, torch.arange(12.0) / 2)[-1]
    monkeypatch.setattr(inference.tables.contexts, "MOST", 5)
    engine = engine_of(Counting())
    for _ in range(2):
        assert torch.allclose(engine.filter(None, torch.arange(12.0) / 2)[-1].log_evidence, kept.log_evidence)


class Rare(Model):
    """One action in a thousand breaks a law."""

    press = action(Finite(1000))

    @state
    def now(self, press, prev_now=0):
        return Categorical(torch.stack([1.0 + press, 100.0 + 0 * press]))

    @observation
    def seen(self, now, press):
        return Normal(1.0 * now, where(press == 999, -1.0, 1.0))


def test_an_update_that_raised_leaves_the_engine_as_it_was():
    engine = engine_of(Rare())
    engine.update(engine.start(), 0, 0.3)
    with pytest.raises(ValueOutOfRange, match="scale = -1"):
        engine.update(engine.start(), 999, 0.3)
    fresh = engine_of(Rare())
    later = engine.update(engine.start(), 500, 0.3)
    assert torch.allclose(later.log_probs, fresh.update(fresh.start(), 500, 0.3).log_probs)


class Delayed(Model):
    press = action(Finite(3))
    kind = fair()

    @observation
    def seen(self, kind, prev_press=0):
        return Bernoulli(0.1 + 0.2 * prev_press + 0.1 * kind)


def test_remembered_actions_can_be_listed_or_are_refused():
    try:
        Exact(Delayed()).prepare()
    except ValueOutOfRange as error:
        assert "listed beforehand" in str(error)


# Numbers.


class Bits(Model):
    """Outcomes that the background excludes, and few of them."""

    look = action(Finite(2))
    place = fair(4)

    @observation
    def marks(self, place, look):
        return Bernoulli(where(torch.arange(4) == place, 0.6 + 0.3 * look, 0.0)).to_event(1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_cannot_be_seen_is_refused(dtype):
    engine = Exact(Bits(), dtype)
    with pytest.raises(ValueOutOfRange, match="no probability"):
        engine.update(engine.start(), 0, [1.0, 1.0, 0.0, 0.0])


class Stairs(Model):
    """A state that cannot go back, nor two steps at a time."""

    @state
    def stair(self, prev_stair=0):
        return Categorical(torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]])[prev_stair])

    @observation
    def sign(self, stair):
        return Categorical(torch.eye(3)[stair])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_cannot_happen_does_not(dtype):
    engine = Exact(Stairs(), dtype)
    belief = engine.update(engine.start(), None, 1)
    with pytest.raises(ValueOutOfRange, match="no probability"):
        engine.update(belief, None, 0)


def test_the_gain_is_exact_although_an_outcome_is_excluded():
    engine, oracle = engine_of(Bits()), Oracle(Bits())
    expected = [oracle.gain(["place"], [], [], {"look": look}) for look in (0, 1)]
    assert engine.gain(engine.start()).tolist() == pytest.approx(expected, abs=1e-6)


class Marathon(Model):
    """Strong evidence for one thing and then stronger evidence for the other, while some state moves."""

    side = fair()

    @state
    def weather(self, prev_weather=0):
        return Categorical(torch.ones(2) + prev_weather)

    @observation
    def voice(self, side, weather):
        return Normal(20.0 * side + 0.1 * weather, 1.0)

    interest = side


def test_a_mind_can_be_changed():
    engine = Exact(Marathon(), torch.float32)
    belief = engine.filter(None, torch.tensor([20.0, -20.0]))[-1]
    assert belief.most_probable() == 0


def test_a_belief_has_its_engines_precision():
    class Simple(Model):
        kind = static(lambda self: Bernoulli(0.5))

        @observation
        def seen(self, kind):
            return Normal(kind, 1.0)

    for dtype in (torch.float64, torch.float32):
        engine = Exact(Simple(), dtype)
        belief = engine.update(engine.start(), None, 0.3)
        assert belief.log_probs.dtype == belief.log_evidence.dtype == engine.dtype


class Arm(Model):
    command = action(Box(-1.0, 1.0, (2,)))
    kind = fair()

    @observation
    def place(self, kind, command):
        return Normal(kind * (torch.ones(2) @ command), 1.0)


@pytest.mark.parametrize(
    "dtype",
    [torch.float32, torch.float64],
)
def test_continuous_actions_have_the_engines_precision(dtype):
    engine = Exact(Arm(), dtype)
    belief = engine.update(engine.start(2), [0.5, -0.1], torch.tensor([0.2, NAN]))
    again = engine.update(engine.start(2), torch.tensor([[0.5, -0.1], [0.2, 0.2]]), torch.tensor([0.2, NAN]))
    assert torch.allclose(belief.log_probs, again.log_probs)
    assert float(belief.marginal("kind").probs[0, 1]) == pytest.approx(0.5, abs=1e-6)


# What users pass.


class Table(Model):
    """A law that looks its action up."""

    press = action(Finite(2))
    kind = fair()

    @observation
    def seen(self, kind, press):
        return Bernoulli(torch.tensor([0.2, 0.7])[press] * (1 - 0.5 * kind))


def test_a_boolean_action_is_0_or_1():
    engine = engine_of(Table())
    assert torch.equal(
        engine.update(engine.start(), True, 1.0).log_probs, engine.update(engine.start(), 1, 1.0).log_probs
    )


class Drops(Model):
    kind = fair()

    @observation
    def drops(self, kind):
        return Poisson(1.0 + kind)


COUNTS = DetectorSearch(
    grid=Grid(2, 2), counts=CountModel(torch.tensor([[[1.0, 1.0, 2.0]]]), torch.tensor([[[1.0, 1.0, 0.0]]]))
)


@pytest.mark.parametrize(
    ("model", "wrong"),
    [
        (Drops(), 1.5),
        (Drops(), -1.5),
        (Bits(), [0.0, 2.0, 0.0, 0.0]),
        (Bits(), [0.0, 0.5, 0.0, 0.0]),
        (COUNTS, [0, 1, 3, 0]),
        (COUNTS, [0, 1.5, 0, 0]),
    ],
)
def test_a_bad_count_is_out_of_range_in_every_family(model, wrong):
    engine = Exact(model)
    with pytest.raises(ValueOutOfRange, match=model.observation_names[0]) as error:
        engine.update(engine.start(), 0 if model.action_names else None, wrong)
    assert "\n" not in str(error.value)


def test_elements_of_any_planted_field_may_be_missing():
    class Field(Model):
        place = fair(3)

        @observation
        def drops(self, place):
            return Planted(place, Poisson(3.0), Poisson(torch.ones(3)))

    hold(Field(), [None], [[1.0, NAN, 2.0]], "place")


def test_a_batch_of_records_may_share_its_actions():
    engine = engine_of(Lamp())
    actions, seen = torch.tensor([0, 2]), torch.tensor([[1.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    shared = engine.filter(actions, seen, batch=3)[-1]
    assert torch.equal(shared.log_probs, engine.filter(actions.expand(3, 2), seen, batch=3)[-1].log_probs)


@pytest.mark.parametrize("steps", [(3, 2), (2, 3)])
def test_records_must_have_equal_lengths(steps):
    with pytest.raises(ValueOutOfRange, match="steps"):
        engine_of(Lamp()).filter(torch.zeros(steps[0], dtype=torch.int64), torch.zeros(steps[1]))


@pytest.mark.parametrize("wrong", [2, [[0, 1], [1, 2]]])
def test_candidates_of_the_wrong_shape_are_refused(wrong):
    engine = Exact(VisualSearch(grid=Grid(2, 2)))
    with pytest.raises(ValueOutOfRange, match="fixation"):
        engine.gain(engine.start(), wrong)


def test_few_imagined_observations_are_right_on_average():
    """The mean over 1500 seeds lies within 4 of its standard errors of the value of 100 000 imagined observations."""
    engine = Exact(VisualSearch(grid=Grid(5, 5)))
    belief = engine.start()
    looks = [6, 8, 12]
    gains = torch.stack([engine.gain(belief, looks, samples=8, seed=seed) for seed in range(1500)])
    expected = engine.gain(belief, looks, samples=100_000)
    assert ((gains.mean(0) - expected).abs() < 4 * gains.std(0) / 1500**0.5).all()
