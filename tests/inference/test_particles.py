"""Particles: what they say on average is what is so, and they say when there are too few of them.

Many runs are rows of a batch, whose particles are drawn apart, under several seeds. An average over runs is held to
three of its own standard errors, so that these tests can fail by chance only where a seed or a random number changes.
"""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch
from pyro.distributions import Bernoulli, Beta, Categorical, Gamma, Normal, Poisson
from torch import Tensor

from apmodels import Binary, Model, action, observation, state, static, where
from inference import DepletionWarning, Particles
from inference.records.record import Record
from tests.inference.joint_gaussian import JointGaussian
from tests.inference.oracle import Oracle
from tests.inference.rates_quadrature import Quadrature, counted, interval, tossed
from tests.models import Coin, Door, RandomWalk, Tracking

NAN = math.nan
SEEDS, ROWS = 2, 200


class Level(Model):
    """A level that is never seen without a moving error on top."""

    @static
    def level(self):
        return Normal(1.0, 2.0)

    @state
    def error(self, prev_error=0.0):
        return Normal(0.7 * prev_error, 0.5)

    @observation
    def reading(self, level, error):
        return Normal(level + error, 0.8)

    interest = level


class Constant(Model):
    """A level seen through noise."""

    @static
    def level(self):
        return Normal(0.0, 3.0)

    @observation
    def reading(self, level):
        return Normal(level, 1.0)


class Square(Model):
    """Two places, left and right, that look alike."""

    @static
    def place(self):
        return Normal(0.3, 1.0)

    @observation
    def reading(self, place):
        return Normal(place**2, 0.5)


class Rain(Model):
    """A rate, of which all values are positive."""

    @static
    def rate(self):
        return Gamma(2.0, 1.0)

    @observation
    def drops(self, rate):
        return Poisson(rate)


class Toss(Model):
    """A rate, of which all values lie between 0 and 1."""

    @static
    def rate(self):
        return Beta(2.0, 1.0)

    @observation
    def toss(self, rate):
        return Bernoulli(rate)


class Mixed(Model):
    """A finite static and a continuous one that depends on it, and a finite state."""

    @static
    def kind(self):
        return Categorical(torch.tensor([0.2, 0.5, 0.3]))

    @static
    def level(self, kind):
        return Normal(kind * 1.0, 0.5 + 0.5 * kind)

    @state
    def mood(self, prev_mood=0):
        return Bernoulli(0.2 + 0.5 * prev_mood)

    @observation
    def reading(self, level, mood):
        return Normal(level + mood, 0.7)

    interest = level


# What is so.


@dataclasses.dataclass
class Truth:
    """Log evidence; mean and standard deviation of a variable."""

    evidence: float
    mean: float
    deviation: float


def jointly(model, seen, name):
    joint = JointGaussian(model, [{}] * len(seen), [{model.observation_names[0]: y} for y in seen])
    mean, spread = joint.moments(name)
    return Truth(joint.evidence(), float(mean[0]), float(spread[0, 0]) ** 0.5)


def integrated(points, prior, likelihood):
    """Of one rate or place on a grid (n, 1): the log of its prior density with the rule's weights, and the record's."""
    found = Quadrature([1.0], points, [prior], lambda _, rates: likelihood(rates[:, 0]))
    return Truth(found.evidence, float(found.mean[0]), float(found.variance[0]) ** 0.5)


def normal(value, mean, deviation):
    return -0.5 * ((value - mean) / deviation) ** 2 - math.log(deviation) - 0.5 * math.log(2 * math.pi)


def squared(seen):
    points, weights = interval(400, -8, 8)
    prior = weights + normal(points[:, 0], 0.3, 1.0)
    return integrated(points, prior, lambda x: sum(normal(y, x**2, 0.5) for y in seen))


def rained(seen):
    points, weights = interval(200, 0, 40)
    prior = weights + np.log(points[:, 0]) - points[:, 0]
    return integrated(points, prior, lambda x: counted(x, seen))


def tossed_rate(seen):
    points, weights = interval(40)
    return integrated(points, weights + np.log(2 * points[:, 0]), lambda x: tossed(x, seen))


def flipped(seen):
    record = [{"push": push} for push in PUSHES], [{"light": torch.tensor(y)} for y in seen]
    chance = Oracle(Door()).posterior(["is_open"], *record)[(1.0,)]
    return Truth(Oracle(Door()).evidence(*record), chance, (chance * (1 - chance)) ** 0.5)


READINGS = [2.5, 3.0, NAN, 3.3, 2.0, 4.1, 3.6]
WALK = [0.3, 1.5, -1.0, 2.0, NAN, 0.7, 2.9]
LIGHTS = [1.0, 0.0, 1.0, 1.0, 0.0, 1.0]
PUSHES = [1, 0, 0, 1, 0, 0]
CASES = {
    "guided walk": (RandomWalk(), {}, WALK, "position", lambda: jointly(RandomWalk(), WALK, "position")),
    "bootstrap walk": (
        RandomWalk(),
        {"guided": False},
        WALK,
        "position",
        lambda: jointly(RandomWalk(), WALK, "position"),
    ),
    "guided level": (Level(), {}, READINGS, "level", lambda: jointly(Level(), READINGS, "level")),
    "bootstrap level": (Level(), {"guided": False}, READINGS, "level", lambda: jointly(Level(), READINGS, "level")),
    "static": (Constant(), {}, READINGS, "level", lambda: jointly(Constant(), READINGS, "level")),
    "square": (Square(), {}, [1.2, 0.7, 1.6, 1.1], "place", lambda: squared([1.2, 0.7, 1.6, 1.1])),
    "positive": (Rain(), {}, [4.0, 7.0, NAN, 5.0], "rate", lambda: rained([4.0, 7.0, NAN, 5.0])),
    "unit interval": (Toss(), {}, [0.0, 0.0, 1.0, 0.0, NAN, 0.0], "rate", lambda: tossed_rate([0, 0, 1, 0, NAN, 0])),
    "mixed": (Mixed(), {}, READINGS[:4], "level", lambda: jointly(Mixed(), READINGS[:4], "level")),
    "guided door": (Door(), {}, LIGHTS, "is_open", lambda: flipped(LIGHTS)),
    "bootstrap door": (Door(), {"guided": False}, LIGHTS, "is_open", lambda: flipped(LIGHTS)),
}
all_cases = pytest.mark.parametrize("case", CASES)


def runs(case, particles, seeds, rows):
    """Return evidences and posterior means of many runs, (seeds * rows,) each, and the last belief."""
    model, options, seen, name, _ = CASES[case]
    record = torch.tensor(seen, dtype=torch.float64).expand(rows, len(seen))
    actions = torch.tensor(PUSHES).expand(rows, -1) if model.action_names else None
    evidences, means = [], []
    for seed in range(seeds):
        engine = Particles(model, particles, dtype=torch.float64, seed=seed, **options)
        with warnings.catch_warnings():
            # Few particles are the point here.
            warnings.simplefilter("ignore", DepletionWarning)
            belief = engine.filter(actions, record, rows)[-1]
        evidences.append(belief.log_evidence)
        means.append(belief.marginal(name).mean)
    return torch.cat(evidences), torch.cat(means), belief


def standard_error(values):
    return float(values.std()) / len(values) ** 0.5


def assert_unbiased(case, particles, seeds, rows, slack=0.0):
    """The average of what is unbiased, however few the particles are, lies within three of its standard errors.

    That is the evidence (not its logarithm), and the evidence times the posterior mean: a Metropolis move that did not
    leave the posterior as it is would show there. ``slack`` is added to the three standard errors.
    """
    truth = CASES[case][4]()
    evidences, means, _ = runs(case, particles, seeds, rows)
    ratios = (evidences - truth.evidence).exp()
    products = ratios * (means - truth.mean) / truth.deviation
    assert len(set(means.tolist())) > 20, "runs must differ"
    for values, expected in ((ratios, 1.0), (products, 0.0)):
        assert standard_error(values) < 0.1, "the average would not tell much"
        # Where the guide knows all, the evidence is exact and has no spread.
        assert abs(float(values.mean()) - expected) < max(3 * standard_error(values) + slack, 1e-9)


@all_cases
def test_evidence_and_posterior_are_right_on_average(case):
    assert_unbiased(case, 100, SEEDS, ROWS)


@pytest.mark.slow
@all_cases
def test_evidence_and_posterior_are_right_on_average_over_thousands_of_runs(case):
    # Moves whose size is taken from the particles that they move are unbiased up to a share of 1 / particles.
    moved = Particles(CASES[case][0], 100).start().past is not None
    assert_unbiased(case, 100, 20, 250, 1 / 100 if moved else 0.0)


def assert_means_cover(case, particles, count=40):
    """At least 95 in 100 runs lie within three standard errors of what is so, and their average does."""
    truth = CASES[case][4]()
    _, means, _ = runs(case, particles, 4, count // 4)
    spread = float(means.std())
    off = (means - truth.mean).abs()
    assert float((off < 3 * spread).double().mean()) >= 0.95
    assert abs(float(means.mean()) - truth.mean) < 3 * standard_error(means)
    # Particles that were all alike would be as far apart as the posterior is wide.
    assert spread < 6 * truth.deviation / particles**0.5


@all_cases
def test_posterior_means_lie_within_three_standard_errors(case):
    assert_means_cover(case, 300)


@pytest.mark.slow
@pytest.mark.parametrize("case", sorted(CASES.keys() - {"mixed"}))
def test_posterior_means_of_many_particles_lie_within_three_standard_errors(case):
    assert_means_cover(case, 20_000)


# Seeds, records, batches, and what is missing.


def tensors_of(value, found=None):
    """All tensors in a belief, in order."""
    found = [] if found is None else found
    if isinstance(value, Tensor):
        found.append(value)
    elif isinstance(value, dict):
        for part in value.values():
            tensors_of(part, found)
    elif isinstance(value, (tuple, list)):
        for part in value:
            tensors_of(part, found)
    return found


def parts_of(belief):
    names = ("log_evidence", "known", "log_weights", "values", "gaussian", "fields", "counts", "finite")
    return tensors_of([getattr(belief, name) for name in names])


def assert_same(one, other):
    for a, b in zip(parts_of(one), parts_of(other), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def last(engine, case):
    model, _, seen, _, _ = CASES[case]
    return engine.filter(torch.tensor(PUSHES) if model.action_names else None, seen)[-1]


@all_cases
def test_the_same_seed_draws_the_same_particles_and_another_seed_others(case):
    model, options, _, _, _ = CASES[case]
    one, again, other = (Particles(model, 300, dtype=torch.float64, seed=s, **options) for s in (3, 3, 4))
    first = last(one, case)
    # What was drawn by others in between does not matter, nor does the engine draw from their numbers.
    torch.manual_seed(9)
    expected = torch.rand(3)
    torch.manual_seed(9)
    assert_same(first, last(again, case))
    assert torch.equal(torch.rand(3), expected)
    assert not all(torch.equal(a, b) for a, b in zip(parts_of(first), parts_of(last(other, case)), strict=True))


@all_cases
@pytest.mark.parametrize("batch", [None, 3])
def test_a_filtered_record_is_one_update_after_another(case, batch):
    model, options, seen, name, _ = CASES[case]
    engine = Particles(model, 300, dtype=torch.float64, seed=1, **options)
    record = torch.tensor(seen, dtype=torch.float64)
    actions = torch.tensor(PUSHES) if model.action_names else None
    if batch:
        record = record + torch.arange(3.0)[:, None] * (name in ("level", "position"))
        actions = actions.expand(3, -1) if actions is not None else None
    stepwise = engine.stepwise(engine.start(batch), Record.of(engine, actions, record))
    for found, expected in zip(engine.filter(actions, record, batch), stepwise, strict=True):
        assert found.time == expected.time
        assert_same(found, expected)


@pytest.mark.parametrize("guided", [True, False])
def test_an_update_changes_no_belief_and_depends_on_nothing_but_it(guided):
    engine = Particles(Level(), 200, dtype=torch.float64, guided=guided)
    belief = engine.update(engine.start(), None, 2.0)
    before = [part.clone() for part in parts_of(belief)]
    one = engine.update(belief, None, 5.0)
    engine.update(engine.update(belief, None, -1.0), None, 3.0)
    assert all(torch.equal(a, b) for a, b in zip(parts_of(belief), before, strict=True))
    assert_same(engine.update(belief, None, 5.0), one)


@pytest.mark.parametrize("guided", [True, False])
def test_what_is_missing_says_nothing(guided):
    """With nothing seen the evidence is 1, all weights stay alike, and the state has its prior law."""
    engine = Particles(RandomWalk(), 20_000, dtype=torch.float64, guided=guided)
    belief = engine.filter(None, [NAN] * 4)[-1]
    assert float(belief.log_evidence) == pytest.approx(0.0, abs=1e-9)
    torch.testing.assert_close(belief.log_weights, torch.full_like(belief.log_weights, -math.log(20_000)))
    law = belief.marginal("position")
    # Four steps of 0.5; the standard error of a variance is sqrt(2 / n) of it.
    assert abs(float(law.mean)) < 3 * 1.0 / 20_000**0.5
    assert abs(float(law.variance) - 1.0) < 3 * (2 / 20_000) ** 0.5


class Pair(Model):
    """Two statics, each seen in an element of its own."""

    @static
    def levels(self):
        return Normal(torch.zeros(2), 2.0).to_event(1)

    @observation
    def readings(self, levels):
        return Normal(levels, 1.0).to_event(1)


def test_an_element_that_is_missing_says_nothing_of_its_own():
    """The first level has been seen three times, the second never."""
    engine = Particles(Pair(), 1_000, dtype=torch.float64)
    rows = 40
    record = torch.tensor([[1.0, NAN], [2.0, NAN], [1.5, NAN]], dtype=torch.float64).expand(rows, 3, 2)
    means = engine.filter(None, record, rows)[-1].marginal("levels").mean
    expected = torch.tensor([4.5 / (3 + 0.25), 0.0], dtype=torch.float64)
    errors = means.std(0) / rows**0.5
    assert ((means.mean(0) - expected).abs() < 3 * errors).all()
    assert (means.std(0) < 0.3).all()


def test_the_rows_of_a_batch_have_their_own_data():
    """Each row has the posterior of what was seen in it, and one row's data leave the others' evidence right."""
    records = [[0.3, 1.5, -1.0], [3.0, 4.0, 5.0], [NAN, 0.0, -2.0]]
    rows = 40
    record = torch.tensor(records, dtype=torch.float64).repeat_interleave(rows, 0)
    belief = Particles(RandomWalk(), 500, dtype=torch.float64).filter(None, record, 3 * rows)[-1]
    means = belief.marginal("position").mean.reshape(3, rows)
    ratios = belief.log_evidence.reshape(3, rows)
    for i, seen in enumerate(records):
        truth = jointly(RandomWalk(), seen, "position")
        assert abs(float(means[i].mean()) - truth.mean) < 3 * standard_error(means[i])
        shares = (ratios[i] - truth.evidence).exp()
        assert abs(float(shares.mean()) - 1) < 3 * standard_error(shares)


def test_actions_of_a_batch_are_its_rows_own():
    record = torch.tensor([1.0, 1.0, 0.0]).expand(400, 3)
    each = [1, 0, 0], [0, 0, 1]
    actions = torch.tensor(each).repeat_interleave(200, 0)
    belief = Particles(Door(), 200, dtype=torch.float64).filter(actions, record, 400)[-1]
    shares = belief.log_evidence.reshape(2, 200)
    for i, acts in enumerate(each):
        truth = Oracle(Door()).evidence(
            [{"push": a} for a in acts], [{"light": torch.tensor(y)} for y in (1.0, 1.0, 0.0)]
        )
        ratios = (shares[i] - truth).exp()
        assert abs(float(ratios.mean()) - 1) < 3 * standard_error(ratios)


# Depletion.


class Needle(Model):
    """A wide prior, and a reading that allows one value in ten thousand."""

    @static
    def place(self):
        return Normal(0.0, 100.0)

    @observation
    def reading(self, place):
        return Normal(place, 0.01)


def test_too_few_particles_say_so():
    engine = Particles(Needle(), 1_000, dtype=torch.float64)
    with pytest.warns(DepletionWarning, match=r"Needle: at step 1 .* of 1000 particles carry the weight"):
        engine.update(engine.start(), None, 3.0)


@pytest.mark.filterwarnings("error")
def test_enough_particles_say_nothing():
    engine = Particles(Level(), 1_000, dtype=torch.float64)
    engine.filter(None, READINGS)


def test_the_warning_is_about_the_row_that_is_worst():
    engine = Particles(Constant(), 1_000, dtype=torch.float64)
    with pytest.warns(DepletionWarning):
        engine.update(engine.start(2), None, torch.tensor([0.0, 14.0]))


def test_a_guide_sees_what_a_bootstrap_filter_misses():
    """The state is drawn as the reading suggests: a reading far off costs a bootstrap filter all its particles."""
    quiet = Particles(RandomWalk(drift=1.0, noise=0.01), 500, dtype=torch.float64)
    quiet.filter(None, [2.0, 4.0, 6.5])
    loud = Particles(RandomWalk(drift=1.0, noise=0.01), 500, dtype=torch.float64, guided=False)
    with pytest.warns(DepletionWarning):
        loud.filter(None, [2.0, 4.0, 6.5])


# Rejuvenation.


LONG = 40


def long_record(model, seed=5):
    return model.simulate(LONG, seed=seed)[model.observation_names[0]].double()


@pytest.mark.parametrize(("model", "name"), [(Constant(), "level"), (Level(), "level")])
def test_after_a_long_record_most_particles_have_values_of_their_own(model, name):
    engine = Particles(model, 500, dtype=torch.float64)
    belief = engine.filter(None, long_record(model))[-1]
    assert len(torch.unique(belief.values[name])) > 250


@pytest.mark.parametrize("model", [Constant(), pytest.param(Level(), marks=pytest.mark.slow)], ids=repr)
def test_after_a_long_record_the_static_has_its_posterior(model):
    """Mean and standard deviation, averaged over many runs of few particles."""
    rows, record = 12, long_record(model)
    truth = jointly_static(model, record.tolist())
    belief = Particles(model, 300, dtype=torch.float64).filter(None, record.expand(rows, LONG), rows)[-1]
    law = belief.marginal("level")
    means, deviations = law.mean, law.variance.sqrt()
    assert abs(float(means.mean()) - truth.mean) < 3 * standard_error(means)
    assert abs(float(deviations.mean()) - truth.deviation) < max(3 * standard_error(deviations), 0.02 * truth.deviation)
    assert float(means.std()) < 0.5 * truth.deviation


def jointly_static(model, seen):
    """The level's posterior from the covariance of a whole record, written down."""
    steps = np.arange(len(seen))
    noise, mean, deviation = (1.0, 0.0, 3.0) if isinstance(model, Constant) else (0.8, 1.0, 2.0)
    spread = noise**2 * np.eye(len(seen))
    if isinstance(model, Level):
        # An autoregression that began at 0: Cov(i, j) = a^|i - j| Var(min(i, j)).
        variance = 0.25 * np.cumsum(0.49**steps)
        spread += 0.7 ** np.abs(steps[:, None] - steps) * variance[np.minimum(steps[:, None], steps)]
    ones, off = np.ones(len(seen)), np.array(seen) - mean
    precision = 1 / deviation**2 + ones @ np.linalg.solve(spread, ones)
    return Truth(0.0, float(mean + ones @ np.linalg.solve(spread, off) / precision), float(precision**-0.5))


def test_without_a_static_that_was_drawn_nothing_is_remembered_for_rejuvenation():
    assert Particles(RandomWalk(), 10).start().past is None
    assert Particles(Level(), 10).start().past is not None


def test_a_finite_static_keeps_its_posterior_through_a_record():
    """On average over runs weighed by their evidence, where several values stay probable."""
    rows, toss, reading = 100, [1.0, 1.0, 0.0, 1.0, 1.0, 1.0], [2.1, 1.0, 3.2, 0.5, 2.8, 1.7]
    each = [{"toss": torch.tensor(a), "reading": torch.tensor(b)} for a, b in zip(toss, reading, strict=True)]
    expected = Oracle(Coin()).posterior(["biased"], [{}] * 6, each)[(1.0,)]
    evidence = Oracle(Coin()).evidence([{}] * 6, each)
    assert 0.1 < expected < 0.9
    seen = {"toss": torch.tensor(toss).expand(rows, 6), "reading": torch.tensor(reading).expand(rows, 6)}
    belief = Particles(Coin(), 100, dtype=torch.float64).filter(None, seen, rows)[-1]
    ratios = (belief.log_evidence - evidence).exp()
    errors = ratios * (belief.marginal("biased").probs[:, 1] - expected)
    assert abs(float(ratios.mean()) - 1) < 3 * standard_error(ratios)
    assert abs(float(errors.mean())) < 3 * standard_error(errors)


class Sides(Model):
    """Left or right?"""

    @static
    def side(self):
        return Bernoulli(0.7)

    @observation
    def voice(self, side):
        return Normal(2.0 * side, 1.0)


def test_a_mind_can_be_changed():
    """Ten nats of evidence for one value, and then 24 for the other."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DepletionWarning)
        belief = Particles(Sides(), 200, dtype=torch.float64).filter(None, [-4.0] + [3.0] * 6)[-1]
    assert float(belief.marginal("side").probs[1]) > 0.99


class Buttons(Model):
    """What an action does to a hidden place, and how well, which is static."""

    press = action(Binary())

    @static
    def strength(self):
        return Normal(1.0, 0.5)

    @state
    def place(self, strength, press, prev_place=0.0):
        return Normal(prev_place + where(press == 1, strength, -0.5), 0.3)

    @observation
    def seen(self, place):
        return Normal(place, 0.4)

    interest = strength


@pytest.mark.parametrize("guided", [True, False])
def test_the_record_is_scored_again_under_its_own_actions(guided):
    acts, seen = [1, 0, 1, 1, 0, 1], [1.2, 0.7, 2.4, 3.3, 2.9, 4.6]
    joint = JointGaussian(Buttons(), [{"press": a} for a in acts], [{"seen": y} for y in seen])
    mean, rows = float(joint.moments("strength")[0][0]), 250
    record = torch.tensor(acts).expand(rows, 6), torch.tensor(seen, dtype=torch.float64).expand(rows, 6)
    belief = Particles(Buttons(), 100, dtype=torch.float64, guided=guided).filter(*record, rows)[-1]
    ratios = (belief.log_evidence - joint.evidence()).exp()
    assert abs(float(ratios.mean()) - 1) < 3 * standard_error(ratios)
    errors = ratios * (belief.marginal("strength").mean - mean)
    assert abs(float(errors.mean())) < 3 * standard_error(errors)


def test_many_elements_move_together():
    """A static vector and a state that is pushed: the posterior of the joint Gaussian, in two dimensions."""
    pushes, rows = [[0.5, -0.2], [0.1, 0.9], [-1.0, 0.3]], 40
    record = Tracking().simulate(3, actions=torch.tensor(pushes), seed=4)["seen"].double()
    joint = JointGaussian(Tracking(), [{"push": p} for p in pushes], [{"seen": y} for y in record])
    engine = Particles(Tracking(), 1_000, dtype=torch.float64)
    belief = engine.filter(torch.tensor(pushes).expand(rows, 3, 2), record.expand(rows, 3, 3), rows)[-1]
    means = belief.marginal("place").mean
    error = means.std(0) / rows**0.5
    expected = torch.as_tensor(joint.moments("place")[0])
    assert ((means.mean(0) - expected).abs() < 3 * error).all()
