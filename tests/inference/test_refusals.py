"""What an engine cannot serve is refused at construction; what a call may not be, at the call, and it harms nothing."""

import math
import warnings

import pytest
import torch
from pyro.distributions import Bernoulli, Beta, Categorical, Dirichlet, Gamma, Normal, Poisson
from torch import Tensor

import inference
from apmodels import (
    Box,
    Contingency,
    Evidence,
    Finite,
    Model,
    ValueOutOfRange,
    action,
    observation,
    ones,
    state,
    static,
    where,
)
from inference import DepletionWarning, Exact, Kalman, Particles, RaoBlackwell, Refusal, Variational
from tests.models import Coin, Coupled, LearningToLook, RandomWalk, Tracking, Weather

NAN, INF = math.nan, math.inf
ENGINES = [Exact, Kalman, RaoBlackwell, Particles, Variational]


# At construction.


class Square(Model):
    """Seen through a curve."""

    @state
    def place(self, prev_place=0.0):
        return Normal(prev_place, 1.0)

    @observation
    def seen(self, place):
        return Normal(place**2, 1.0)


class Whispers(Model):
    """An observation that depends on another one of the same step."""

    @static
    def level(self):
        return Normal(0.0, 1.0)

    @observation
    def first(self, level):
        return Normal(level, 1.0)

    @observation
    def second(self, level, first):
        return Normal(level + first, 1.0)


class Chain(Model):
    """The same, of finite variables."""

    @static
    def kind(self):
        return Bernoulli(0.5)

    @observation
    def first(self, kind):
        return Bernoulli(0.2 + 0.5 * kind)

    @observation
    def second(self, kind, first):
        return Bernoulli(0.2 + 0.3 * kind + 0.3 * first)


class Listener(Model):
    """What can be scored and not drawn."""

    @static
    def here(self):
        return Bernoulli(0.5)

    @observation
    def sound(self, here):
        return Evidence(lambda heard: heard * here)


class Fish(Model):
    """A number that has no bound."""

    @static
    def count(self):
        return Poisson(3.0)

    @observation
    def splash(self, count):
        return Normal(1.0 * count, 1.0)


class Steps(Model):
    """A law without a slope."""

    @static
    def level(self):
        return Normal(0.0, 1.0)

    @observation
    def seen(self, level):
        return Normal(level.floor(), 1.0)


class Switching(Model):
    """A rule of motion that changes."""

    @state
    def mode(self, prev_mode=0):
        return Categorical(torch.tensor([[0.8, 0.2], [0.3, 0.7]])[prev_mode])

    @state
    def place(self, mode, prev_place=0.0):
        return Normal(prev_place + mode, 0.5)

    @observation
    def seen(self, place):
        return Normal(place, 1.0)


REFUSED = [
    (Exact, RandomWalk(), "position", "integrated, not enumerated"),
    (Exact, Tracking(), "start", "integrated, not enumerated"),
    (Exact, Square(), "place", "sampled, not enumerated"),
    (Exact, Fish(), "count", "not enumerated"),
    (Exact, Weather(), "weather", "changes from step to step"),
    (Exact, Chain(), "second", "depends on first, an observation of the same step"),
    (Exact, Listener(), "sound", "is an Evidence"),
    (Kalman, Square(), "place", "is sampled"),
    (Kalman, Switching(), "mode", "changes from step to step"),
    (Kalman, LearningToLook(), "motion", "is sampled"),
    (Kalman, Whispers(), "second", "depends on first, an observation of the same step"),
    (Kalman, Coin(), "", "nothing that is hidden is Gaussian"),
    (Kalman, Contingency(), "", "nothing that is hidden is Gaussian"),
    (Variational, Fish(), "count", "neither finite nor continuous"),
    (Variational, Whispers(), "second", "depends on first, an observation of the same step"),
    (Variational, Steps(), "seen", "changes in steps with level"),
]


@pytest.mark.parametrize(("kind", "model", "name", "reason"), REFUSED)
def test_what_cannot_be_served_is_refused_with_the_variable_and_the_reason(kind, model, name, reason):
    with pytest.raises(Refusal) as error:
        kind(model)
    text = str(error.value)
    assert text.startswith(f"{kind.__name__} cannot serve {type(model).__name__}: {name}")
    assert reason in text and "\n" not in text
    # The bid says the same.
    bid = inference.bids(model)[kind.__name__]
    assert not bid and bid.competence == 0 and bid.reason in text


EVERY = [Square(), Whispers(), Chain(), Listener(), Fish(), Steps(), Switching(), RandomWalk(), Weather(), Coupled()]


@pytest.mark.parametrize("model", EVERY, ids=repr)
def test_particles_serve_everything(model):
    assert inference.bids(model)["Particles"].competence == pytest.approx(0.4)
    assert Particles(model, 10).start().log_weights.shape == (1, 10)


@pytest.mark.parametrize("model", EVERY, ids=repr)
def test_rao_blackwell_serves_everything_and_bids_high_where_a_part_is_integrated(model):
    bid = inference.bids(model)["RaoBlackwell"]
    engine = RaoBlackwell(model, 10)
    assert bid and set(engine.plan.worlds) <= {node.name for node in model.structure.hidden}
    if not engine.plan.worlds:
        assert "nothing must be sampled" in bid.reason
    elif engine.plan.integrated or engine.plan.finite:
        assert bid.competence > inference.bids(model)["Particles"].competence
    else:
        assert bid.competence < inference.bids(model)["Particles"].competence


@pytest.mark.parametrize("model", EVERY, ids=repr)
def test_a_bid_is_kept(model):
    """What bids is built, and what does not refuses."""
    for kind in ENGINES:
        if inference.bids(model)[kind.__name__]:
            assert isinstance(kind(model), kind)
        else:
            with pytest.raises(Refusal):
                kind(model)


@pytest.mark.parametrize("kind", ENGINES)
@pytest.mark.parametrize(("wrong", "words"), [(RandomWalk, "the class RandomWalk"), (3, "a int"), (None, "a NoneType")])
def test_what_is_no_model_is_refused(kind, wrong, words):
    with pytest.raises(Refusal, match=f"{kind.__name__} needs a model, not {words}"):
        kind(wrong)


# At the call. All models have the same actions and observations; under one push the law of what is seen is broken, and
# under one press the bell cannot ring.

BREAKS, SILENT = 0.125, 5


class Bench(Model):
    """A button, a lever, a reading and a bell."""

    press = action(Finite(10))
    push = action(Box(-1.0, 1.0, (2,)))

    def scale(self, push):
        return where(push[0] == BREAKS, -1.0, 0.7)

    @observation
    def bell(self, press):
        return Bernoulli(where(press == SILENT, 0.0, 0.4))


class Guess(Bench):
    @static
    def kind(self):
        return Categorical(torch.tensor([0.2, 0.5, 0.3]))

    @observation
    def seen(self, kind, push):
        return Normal(push + kind, self.scale(push)).to_event(1)

    interest = kind


class Rates(Bench):
    @static
    def kind(self):
        return Bernoulli(0.3)

    @static
    def rates(self):
        return Beta(2 * ones(2), ones(2)).to_event(1)

    @observation
    def seen(self, kind, rates, push):
        both = rates[torch.stack([0 * kind.long(), kind.long()])]
        return Bernoulli(where(push[0] == BREAKS, 1.5, both)).to_event(1)

    interest = kind


class Walk(Bench):
    @state
    def place(self, push, prev_place=lambda self: torch.zeros(2)):
        return Normal(prev_place + push, 0.5).to_event(1)

    @observation
    def seen(self, place, push):
        return Normal(place, self.scale(push)).to_event(1)

    interest = place


class Modes(Bench):
    @state
    def mode(self, prev_mode=0):
        return Categorical(torch.tensor([[0.8, 0.2], [0.3, 0.7]])[prev_mode])

    @state
    def place(self, mode, push, prev_place=lambda self: torch.zeros(2)):
        return Normal(prev_place + push + mode, 0.5).to_event(1)

    @observation
    def seen(self, place, push):
        return Normal(place, self.scale(push)).to_event(1)

    interest = place


class Curve(Bench):
    @static
    def height(self):
        return Normal(1.0, 0.5)

    @state
    def place(self, height, push, prev_place=lambda self: torch.zeros(2)):
        return Normal(prev_place + push + height, 0.5).to_event(1)

    @observation
    def seen(self, place, push):
        return Normal(place + 0.1 * place**3, self.scale(push)).to_event(1)

    interest = height


GOOD = [
    ({"press": 3, "push": [0.3, -0.2]}, {"seen": [1.0, 0.0], "bell": 1.0}),
    ({"press": 7, "push": [0.1, 0.9]}, {"seen": [1.0, 1.0], "bell": 0.0}),
]
MADE = {
    "Exact": (lambda: Exact(Guess(), torch.float64), "kind"),
    "Counting": (lambda: Exact(Rates(), torch.float64), "rates"),
    "Kalman": (lambda: Kalman(Walk(), torch.float64), "place"),
    "RaoBlackwell": (lambda: RaoBlackwell(Modes(), 50, dtype=torch.float64), "place"),
    "one particle": (lambda: RaoBlackwell(Modes(), 1, dtype=torch.float64), "place"),
    "Particles": (lambda: Particles(Curve(), 50, dtype=torch.float64), "height"),
    "Variational": (lambda: Variational(Walk(), iterations=2, draws=100, dtype=torch.float64), "place"),
}
act, see = GOOD[1]
# What is wrong, and what the sentence must name.
WRONG = {
    "a law out of range": ({**act, "push": [BREAKS, 0.0]}, see, r"seen is (Normal with scale|Bernoulli with probs) = "),
    "an action beyond its space": ({**act, "press": 10}, see, "press is 10, outside"),
    "an action below its space": ({**act, "press": -1}, see, "press is -1, outside"),
    "an action with a fraction": ({**act, "press": 1.5}, see, "press has a fraction"),
    "an action outside its box": ({**act, "push": [2.0, 0.0]}, see, "push reaches"),
    "an infinite action": ({**act, "push": [INF, 0.0]}, see, "push"),
    "a whole action that is NaN": ({**act, "press": NAN}, see, "press is NaN"),
    "an action that is NaN": ({**act, "push": [NAN, 0.0]}, see, "push is NaN"),
    "an action of the wrong shape": ({**act, "push": [0.1]}, see, "push has shape"),
    "an action too few": ({"press": 1}, see, "missing: .'push'"),
    "an action too many": ({**act, "pull": 1}, see, "unknown: .'pull'"),
    "no action": (None, see, "action is needed"),
    "an observation of the wrong shape": (act, {**see, "seen": [1.0, 0.0, 1.0]}, "seen has shape"),
    "a scalar observation that is none": (act, {**see, "bell": [1.0, 0.0]}, "bell has shape"),
    "an infinite observation": (act, {**see, "seen": [INF, 0.0]}, "seen"),
    "an observation below everything": (act, {**see, "seen": [0.0, -INF]}, "seen"),
    "no value of a bell": (act, {**see, "bell": 0.5}, "bell"),
    "no value of a bell either": (act, {**see, "bell": 2.0}, "bell"),
    "an infinite bell": (act, {**see, "bell": INF}, "bell"),
    "what cannot be": ({**act, "press": SILENT}, see | {"bell": 1.0}, "gives what was observed no probability at all"),
    "an observation too few": (act, {"seen": [1.0, 1.0]}, "missing: .'bell'"),
    "no observation": (act, None, "observation is needed"),
    "a word": (act, {**see, "seen": "loud"}, "seen"),
}


def tensors_of(value):
    """All tensors in what a belief says and holds."""
    if isinstance(value, Tensor):
        return [value.detach().clone()]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, (tuple, list)) else []
    return [tensor for part in parts for tensor in tensors_of(part)]


def said(belief, name):
    """What a belief says of itself."""
    law = belief.marginal(name)
    held = [getattr(belief, part, None) for part in ("known", "log_probs", "log_weights", "values", "counts", "finite")]
    moments = [law.probs] if isinstance(law, inference.Marginal) else [law.mean, law.variance]
    return tensors_of([belief.log_evidence, *moments, *held])


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


def updated(engine, belief, action, observed):
    """An update, of which something is asked: some engines do their work then."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DepletionWarning)
        after = engine.update(belief, action, observed)
        return after, float(after.log_evidence)


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_bad_call_is_out_of_range_and_harms_nothing(made, wrong):
    make, name = MADE[made]
    engine = make()
    belief, _ = updated(engine, engine.start(), *GOOD[0])
    before = said(belief, name)
    bad_act, bad_see, words = WRONG[wrong]
    with pytest.raises(ValueOutOfRange, match=words) as error:
        updated(engine, belief, bad_act, bad_see)
    assert "\n" not in str(error.value) and len(str(error.value)) < 250
    assert_same(said(belief, name), before)
    # As if it had never happened: neither in this engine nor beside one that was never called badly.
    later, _ = updated(engine, belief, *GOOD[1])
    fresh = make()
    expected, _ = updated(fresh, updated(fresh, fresh.start(), *GOOD[0])[0], *GOOD[1])
    assert later.time == expected.time == 2
    assert_same(said(later, name), said(expected, name))


@pytest.mark.parametrize("made", [name for name in MADE if name != "Variational"])
def test_one_impossible_row_of_a_batch_is_refused_as_a_whole(made):
    engine = MADE[made][0]()
    belief, bells = engine.start(2), torch.tensor([0.0, 1.0])
    with pytest.raises(ValueOutOfRange, match="no probability at all"):
        engine.update(belief, {**act, "press": SILENT}, {"seen": [1.0, 0.0], "bell": bells})
    # The other row alone is as good as ever.
    assert engine.update(belief, {**act, "press": SILENT}, {"seen": [1.0, 0.0], "bell": 0.0}).time == 1


@pytest.mark.parametrize("made", MADE)
def test_batches_that_do_not_fit_are_refused(made):
    engine = MADE[made][0]()
    for batch in (0, -1):
        with pytest.raises(ValueOutOfRange, match="batch"):
            engine.start(batch)
    with pytest.raises(ValueOutOfRange, match="bell has shape"):
        updated(engine, engine.start(2), act, {**see, "bell": torch.zeros(3)})
    with pytest.raises(ValueOutOfRange, match="press has shape"):
        updated(engine, engine.start(2), {**act, "press": torch.zeros(3, dtype=torch.int64)}, see)


@pytest.mark.parametrize("made", MADE)
def test_a_bad_step_within_a_record_is_refused_like_a_bad_call(made):
    engine, steps = MADE[made][0](), 4
    acts = {"press": torch.tensor([3, 7, 3, 7]), "push": torch.zeros(steps, 2)}
    seen = {"seen": torch.ones(steps, 2), "bell": torch.zeros(steps)}
    bad = seen["seen"].clone()
    bad[2, 1] = INF
    silent = torch.tensor([3, 7, SILENT, 7])
    with pytest.raises(ValueOutOfRange, match="seen"):
        float(engine.filter(acts, {**seen, "seen": bad})[-1].log_evidence)
    with pytest.raises(ValueOutOfRange, match="no probability at all"):
        float(engine.filter({**acts, "press": silent}, {**seen, "bell": torch.ones(steps)})[-1].log_evidence)
    with pytest.raises(ValueOutOfRange, match="press is 10"):
        engine.filter({**acts, "press": torch.tensor([3, 7, 10, 7])}, seen)
    with pytest.raises(ValueOutOfRange, match="steps"):
        engine.filter(acts, {**seen, "bell": torch.zeros(steps + 1)})


@pytest.mark.parametrize("made", MADE)
def test_questions_about_what_is_not_hidden_are_refused(made):
    engine, name = MADE[made][0](), MADE[made][1]
    belief, _ = updated(engine, engine.start(), *GOOD[0])
    before = said(belief, name)
    for wrong in ("nobody", "bell", "press"):
        with pytest.raises(ValueOutOfRange, match=wrong):
            belief.marginal(wrong)
        with pytest.raises(ValueOutOfRange, match=wrong):
            belief.entropy(wrong)
    with pytest.raises(ValueOutOfRange, match="push"):
        engine.forecast(belief, {"press": 1, "push": [5.0, 0.0]})
    assert_same(said(belief, name), before)


class Tosses(Model):
    """Outcomes of three families, all of them counted."""

    @static
    def kind(self):
        return Bernoulli(0.5)

    @static
    def coins(self):
        return Beta(ones(2), ones(2)).to_event(1)

    @static
    def dice(self):
        return Dirichlet(ones(2, 3)).to_event(1)

    @static
    def rates(self):
        return Gamma(ones(2), ones(2)).to_event(1)

    @observation
    def toss(self, coins, kind):
        return Bernoulli(coins[kind.long()])

    @observation
    def roll(self, dice, kind):
        return Categorical(dice[kind.long()])

    @observation
    def drops(self, rates, kind):
        return Poisson(rates[kind.long()])


UNCOUNTABLE = [
    ("toss", 0.5),
    ("toss", 2.0),
    ("toss", -1.0),
    ("roll", 3.0),
    ("roll", -1.0),
    ("roll", 0.5),
    ("drops", 1.5),
]


@pytest.mark.parametrize("kind", [Exact, Particles])
@pytest.mark.parametrize(("name", "value"), [*UNCOUNTABLE, ("drops", -1.0)])
def test_an_outcome_outside_its_support_is_named(kind, name, value):
    engine = kind(Tosses(), dtype=torch.float64)
    with pytest.raises(ValueOutOfRange, match=name):
        engine.update(engine.start(), None, {"toss": 1.0, "roll": 1.0, "drops": 2.0, name: value})


# Very long records.


@pytest.mark.slow
@pytest.mark.parametrize("way", ["steps", "record"])
def test_covariances_stay_positive_definite_over_a_hundred_thousand_steps(way):
    """In single precision, with little noise, much of it far from what is seen, and gaps in between."""
    steps, model = 100_000, Tracking()
    engine = Kalman(model, torch.float32)
    random = torch.Generator().manual_seed(0)
    pushes = 2 * torch.rand(steps, 2, generator=random) - 1
    seen = torch.randn(steps, 3, generator=random)
    seen[torch.rand(steps, generator=random) < 0.2] = NAN
    belief, every = engine.start(), 1_000
    if way == "record":
        beliefs = engine.filter(pushes, seen)
        some = [beliefs[t] for t in range(every - 1, steps, every)]
    else:
        some = []
        for t in range(steps):
            belief = engine.update(belief, pushes[t], seen[t])
            if t % every == every - 1:
                some.append(belief)
    assert len(some) == steps // every
    for belief in some:
        covariance = belief.marginal("place").covariance_matrix.double()
        assert torch.equal(covariance, covariance.mT)
        assert float(torch.linalg.eigvalsh(covariance).min()) > 1e-4
        assert math.isfinite(float(belief.log_evidence))
        for held in belief.gaussian:
            torch.testing.assert_close(held.covariance, held.covariance.mT, rtol=0, atol=1e-12)
            assert float(torch.linalg.eigvalsh(held.covariance).min()) >= -1e-12
