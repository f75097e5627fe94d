"""Rao-Blackwellised particles of a switching linear system, against enumeration of all its switch paths.

Along each path a Kalman filter is written down in numpy; what the paths say is mixed by their weights.
"""

import dataclasses
import itertools
import math
import warnings

import numpy as np
import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal
from scipy import integrate, stats
from scipy.special import gammaln

from apmodels import Finite, Model, action, observation, state, static, where
from inference import DepletionWarning, RaoBlackwell, Refusal
from inference.records.record import Record
from tests.models import Weather

NAN = math.nan

# The switching system's numbers, by mode.
STAY = np.array([[0.8, 0.15, 0.05], [0.2, 0.7, 0.1], [0.3, 0.3, 0.4]])
PULL, PUSH = np.array([1.0, 0.5, -0.6]), np.array([0.0, 2.0, -1.0])
SHAKE, NOISE = np.array([0.3, 0.5, 1.0]), np.array([0.5, 0.8, 0.5])


def table(values):
    return torch.as_tensor(values)


class Switching(Model):
    """A point that moves by one of three rules; which one it is wanders."""

    @state
    def mode(self, prev_mode=0):
        return Categorical(table(STAY)[prev_mode])

    @state
    def place(self, mode, prev_place=0.5):
        return Normal(table(PULL)[mode] * prev_place + table(PUSH)[mode], table(SHAKE)[mode])

    @observation
    def seen(self, place, mode):
        return Normal(place, table(NOISE)[mode])

    interest = place


SEEN = [0.4, 2.9, 3.1, NAN, -1.8, 0.9]


@dataclasses.dataclass
class Path:
    """One path of modes: log p(path, record), and the place's mean and variance after it."""

    modes: tuple[int, ...]
    weight: float
    mean: float
    variance: float


def step(path, mode, y):
    """A path grown by one mode: the chance of it, a Kalman move, and a Kalman update (nothing if y is NaN)."""
    before = path.modes[-1] if path.modes else 0
    mean = PULL[mode] * path.mean + PUSH[mode]
    variance = PULL[mode] ** 2 * path.variance + SHAKE[mode] ** 2
    weight = path.weight + math.log(STAY[before, mode])
    if not math.isnan(y):
        spread = variance + NOISE[mode] ** 2
        weight += stats.norm.logpdf(y, mean, spread**0.5)
        mean, variance = mean + variance / spread * (y - mean), variance - variance**2 / spread
    return Path((*path.modes, mode), weight, mean, variance)


ROOT = Path((), 0.0, 0.5, 0.0)


class Paths:
    """All of them, after a record."""

    def __init__(self, seen):
        paths = [ROOT]
        for y in seen:
            paths = [step(path, mode, y) for path in paths for mode in range(3)]
        logs = np.array([path.weight for path in paths])
        self.evidence = float(np.logaddexp.reduce(logs))
        self.weights = np.exp(logs - self.evidence)
        self.means, self.variances = np.array([p.mean for p in paths]), np.array([p.variance for p in paths])
        self.last = np.array([p.modes[-1] for p in paths])

    @property
    def modes(self):
        return np.array([self.weights[self.last == mode].sum() for mode in range(3)])

    @property
    def mean(self):
        return float(self.weights @ self.means)

    @property
    def variance(self):
        return float(self.weights @ (self.variances + (self.means - self.mean) ** 2))

    def density(self, x):
        return float(self.weights @ stats.norm.pdf(x, self.means, self.variances**0.5))

    @property
    def entropy(self):
        """Of the place: the integral of -p log p, nats."""

        def integrand(x):
            p = self.density(x)
            return -p * math.log(p) if p > 0 else 0.0

        span = 12 * self.variance**0.5
        return integrate.quad(integrand, self.mean - span, self.mean + span, limit=400, points=[self.mean])[0]


TRUTH = Paths(SEEN)


def runs(engine_of, seeds, rows, seen=SEEN):
    """Return the last beliefs of seeds * rows runs, a batch for each seed."""
    record = torch.tensor(seen, dtype=torch.float64).expand(rows, len(seen))
    with warnings.catch_warnings():
        # Few particles are the point here.
        warnings.simplefilter("ignore", DepletionWarning)
        return [engine_of(seed).filter(None, record, rows)[-1] for seed in range(seeds)]


def standard_error(values):
    return values.std(0) / len(values) ** 0.5


def assert_mean(values, expected):
    """The average of runs lies within three of its standard errors."""
    error = standard_error(values)
    assert (error > 0).all(), "runs must differ"
    assert ((values.mean(0) - torch.as_tensor(expected)).abs() < 3 * error).all()


# What is sampled.


def test_what_must_be_sampled_is_and_the_rest_is_integrated():
    plan = RaoBlackwell(Switching()).plan
    assert plan.worlds == ("mode",) and plan.gaussian == (("place",),)


def test_what_is_given_is_sampled_too():
    engine = RaoBlackwell(Switching(), given="place")
    assert set(engine.plan.worlds) == {"mode", "place"} and not engine.plan.integrated
    assert RaoBlackwell(Switching(), given=("place", "mode")).plan == engine.plan
    assert RaoBlackwell(Switching(), given="mode").plan == RaoBlackwell(Switching()).plan
    assert set(engine.start().values) == {"mode", "place"}
    assert set(RaoBlackwell(Switching()).start().values) == {"mode"}


def test_what_is_given_must_be_a_random_hidden_variable():
    with pytest.raises(Refusal, match=r"Switching has no random hidden variable plaice \(nearest: place\)"):
        RaoBlackwell(Switching(), given="plaice")
    with pytest.raises(Refusal, match="no random hidden variable seen"):
        RaoBlackwell(Switching(), given="seen")


@pytest.mark.parametrize("options", [{"particles": 0}, {"particles": -3}, {"candidates": 0}])
def test_there_must_be_a_particle(options):
    with pytest.raises(ValueError, match="1 particle or more"):
        RaoBlackwell(Switching(), **options)


# Evidence and posterior, however few the particles are.

KINDS = {
    "integrated": lambda seed: RaoBlackwell(Switching(), 40, dtype=torch.float64, seed=seed),
    "resampled always": lambda seed: RaoBlackwell(Switching(), 40, dtype=torch.float64, seed=seed, threshold=1.1),
    "never resampled": lambda seed: RaoBlackwell(Switching(), 40, dtype=torch.float64, seed=seed, threshold=0.0),
    "place sampled": lambda seed: RaoBlackwell(Switching(), 200, given="place", dtype=torch.float64, seed=seed),
}


@pytest.mark.parametrize("kind", KINDS)
def test_adaptive_systematic_resampling_leaves_the_evidence_unbiased(kind):
    """And the evidence times what is believed: mean, second moment, and the chances of the modes."""
    beliefs = runs(KINDS[kind], 4, 200)
    ratios = torch.cat([belief.log_evidence for belief in beliefs]).sub(TRUTH.evidence).exp()
    assert float(standard_error(ratios)) < 0.1, "the average would not tell much"
    assert_mean(ratios, 1.0)
    places = [belief.marginal("place") for belief in beliefs]
    means, variances = torch.cat([law.mean for law in places]), torch.cat([law.variance for law in places])
    assert_mean(ratios * means, TRUTH.mean)
    assert_mean(ratios * (variances + means**2), TRUTH.variance + TRUTH.mean**2)
    modes = torch.cat([belief.marginal("mode").probs for belief in beliefs])
    assert_mean(ratios[:, None] * modes, TRUTH.modes)
    if kind != "place sampled":
        for point in (-0.5, 0.5, 1.5, 2.5):
            rows = [law.log_prob(torch.full((len(law.mean),), point, dtype=torch.float64)) for law in places]
            assert_mean(ratios * torch.cat(rows).exp(), TRUTH.density(point))


def test_integrating_makes_runs_more_alike_than_sampling():
    """The theorem of Rao and Blackwell, with as many particles."""
    spreads = []
    for given in ((), "place"):
        beliefs = runs(lambda s, g=given: RaoBlackwell(Switching(), 100, g, torch.float64, seed=s), 1, 200)
        spreads.append(float(beliefs[0].log_evidence.std()))
    assert spreads[0] < spreads[1]


# Many particles.


@pytest.fixture(scope="module")
def many():
    """Beliefs of twenty runs of many particles."""
    return runs(lambda seed: RaoBlackwell(Switching(), 1_000, dtype=torch.float64, seed=seed), 1, 20)[0]


def test_with_many_particles_marginals_are_those_of_all_paths(many):
    """Within three standard errors, which are small beside what is measured."""
    law = many.marginal("place")
    assert_mean(law.mean, TRUTH.mean)
    assert_mean(law.variance, TRUTH.variance)
    assert_mean(many.marginal("mode").probs, TRUTH.modes)
    assert_mean(many.log_evidence.exp(), math.exp(TRUTH.evidence))
    assert float(law.mean.std()) < 0.1 * TRUTH.variance**0.5
    assert float(many.marginal("mode").probs.std(0).max()) < 0.04


def test_with_many_particles_entropies_are_those_of_all_paths(many):
    """The finite one is nonlinear in chances: their error is squared over them. The place's is an average of draws."""
    modes = many.entropy("mode")
    expected = float(stats.entropy(TRUTH.modes))
    assert_mean(modes, expected)
    places = many.entropy("place")
    # An average of -log p over 2,048 draws, which are fixed: its standard error, and the particles' own.
    draws = many.marginal("place").sample(torch.Size([500]))
    deviation = float(many.marginal("place").log_prob(draws).std())
    assert abs(float(places.mean()) - TRUTH.entropy) < 3 * (deviation / 2_048**0.5 + float(standard_error(places)))


class Jumps(Model):
    """A place that jumps far or stays, of which nothing is remembered but where it is."""

    @state
    def jump(self):
        return Bernoulli(0.5)

    @state
    def place(self, jump, prev_place=0.0):
        return Normal(prev_place + 20.0 * jump, 1.0)

    @observation
    def seen(self, place):
        return Normal(place, 1.0)


def test_the_joint_entropy_of_what_is_sampled_and_integrated_is_that_of_all_paths():
    """After three jumps, none of them seen: the last one, the number of those before, and a Gaussian around each."""
    engine = RaoBlackwell(Jumps(), 2_000, dtype=torch.float64)
    belief = engine.filter(None, [NAN] * 3)[-1]
    expected = math.log(2) + stats.entropy([0.25, 0.5, 0.25]) + 0.5 * math.log(2 * math.pi * math.e * 3)
    # The place alone says how many jumps there were; its entropy is right.
    alone = stats.entropy([1, 3, 3, 1]) + 0.5 * math.log(2 * math.pi * math.e * 3)
    if abs(float(belief.entropy("place")) - alone) > 0.1:
        pytest.fail("the entropy of the place is another matter")
    assert float(belief.entropy(("jump", "place"))) == pytest.approx(expected, abs=0.1)


# One particle: the conditional maximum a posteriori.


def greedy(seen):
    """At every step the mode that, after those chosen before, is the most probable with what is seen (eq. 6.7)."""
    path, found = ROOT, []
    for y in seen:
        path = max((step(path, mode, y) for mode in range(3)), key=lambda grown: grown.weight)
        found.append(path)
    return found


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("record", range(4))
def test_one_particle_keeps_the_best_mode_at_every_step(seed, record):
    """Among 256 candidates every mode occurs, so that the best of them is the best there is."""
    seen = SEEN if record == 0 else Switching().simulate(6, seed=record)["seen"].tolist()
    engine = RaoBlackwell(Switching(), particles=1, dtype=torch.float64, seed=seed)
    beliefs = engine.filter(None, torch.tensor(seen, dtype=torch.float64))
    for belief, best in zip(beliefs, greedy(seen), strict=True):
        assert belief.log_weights.shape == (1, 1)
        assert int(belief.values["mode"]) == best.modes[-1]
        law = belief.marginal("place")
        assert float(law.mean) == pytest.approx(best.mean, abs=1e-9)
        assert float(law.variance) == pytest.approx(best.variance, abs=1e-9)


def test_one_particle_is_greedy_where_the_best_path_is_another():
    """There is a record whose best path as a whole begins otherwise: what is kept is the conditional maximum."""
    for seed in range(100):
        seen = Switching().simulate(4, seed=seed)["seen"].tolist()
        paths = [ROOT]
        for y in seen:
            paths = [step(path, mode, y) for path in paths for mode in range(3)]
        best, kept = max(paths, key=lambda path: path.weight), greedy(seen)[-1]
        if best.modes[:-1] != kept.modes[:-1]:
            break
    engine = RaoBlackwell(Switching(), particles=1, dtype=torch.float64)
    beliefs = engine.filter(None, torch.tensor(seen, dtype=torch.float64))
    assert tuple(int(belief.values["mode"]) for belief in beliefs) == kept.modes != best.modes


def test_each_row_of_a_batch_keeps_its_own_best():
    records = [Switching().simulate(5, seed=seed)["seen"].tolist() for seed in range(6)]
    engine = RaoBlackwell(Switching(), particles=1, dtype=torch.float64)
    belief = engine.filter(None, torch.tensor(records, dtype=torch.float64), 6)[-1]
    for i, seen in enumerate(records):
        best = greedy(seen)[-1]
        assert int(belief.values["mode"][i, 0]) == best.modes[-1]
        assert float(belief.marginal("place").mean[i]) == pytest.approx(best.mean, abs=1e-9)


class Kinds(Model):
    """A static kind, hardly ever 1, that a reading speaks for a little."""

    @static
    def kind(self):
        return Bernoulli(0.05)

    @state
    def place(self, kind, prev_place=0.0):
        return Normal(prev_place + kind, 0.5)

    @observation
    def seen(self, place):
        return Normal(place, 0.5)

    interest = kind


def test_one_particle_heeds_the_prior_of_a_static():
    """0.05 N(0.8; 1, sqrt(.5)) is less than 0.95 N(0.8; 0, sqrt(.5)), so that kind 0 scores best."""
    spread = 0.5**0.5
    assert 0.05 * stats.norm.pdf(0.8, 1, spread) < 0.95 * stats.norm.pdf(0.8, 0, spread)
    assert stats.norm.pdf(0.8, 1, spread) > stats.norm.pdf(0.8, 0, spread)
    engine = RaoBlackwell(Kinds(), particles=1, given="kind", dtype=torch.float64)
    assert "kind" in engine.plan.worlds
    belief = engine.update(engine.start(), None, 0.8)
    assert int(belief.values["kind"]) == 0


# Finite states that are summed or sampled, above what is counted.


def weathers(colours, drops):
    """Log evidence and the last weather's chance of 1, over all paths: counts in closed form, by Gamma functions."""
    logs, last = [], []
    for path in itertools.product((0, 1), repeat=len(colours)):
        weight, before = 0.0, 0
        for now in path:
            chance = 0.8 if before else 0.3
            weight += math.log(chance if now else 1 - chance)
            before = now
        for row in (0, 1):
            counts = np.bincount([c for c, now in zip(colours, path, strict=True) if now == row], minlength=3)
            weight += gammaln(3) - gammaln(3 + counts.sum()) + gammaln(1 + counts).sum()
        logs.append(weight)
        last.append(path[-1])
    total = np.logaddexp.reduce(logs)
    n, k = len(drops), sum(drops)
    rain = gammaln(2 + k) - gammaln(2) - (2 + k) * math.log(1 + n) - sum(gammaln(1 + d) for d in drops)
    return float(total + rain), float(np.exp(np.array(logs) - total) @ np.array(last))


def test_a_hidden_chain_above_unknown_tables_is_that_of_all_paths():
    colours, drops = [0, 0, 2, 1, 0, 2, 2], [1, 3, 0, 2, 2, 4, 1]
    evidence, chance = weathers(colours, drops)
    rows = 300
    seen = {"colour": torch.tensor(colours).expand(rows, 7), "drops": torch.tensor(drops).expand(rows, 7)}
    engine = RaoBlackwell(Weather(), 50, dtype=torch.float64)
    assert engine.plan.worlds == ("weather",) and engine.plan.counted
    belief = engine.filter(None, seen, rows)[-1]
    ratios = (belief.log_evidence - evidence).exp()
    assert_mean(ratios, 1.0)
    assert_mean(ratios * belief.marginal("weather").probs[:, 1], chance)
    # The rate depends on no weather: it is the Gamma of the textbook in every particle.
    law = belief.marginal("rate")
    torch.testing.assert_close(law.mean, torch.full((rows,), (2.0 + sum(drops)) / (1 + 7), dtype=torch.float64))


# Records, seeds, actions.


class Pushed(Switching):
    """An action adds to the place."""

    push = action(Finite(3))

    @state
    def place(self, mode, push, prev_place=0.5):
        return Normal(table(PULL)[mode] * prev_place + where(push == 2, 1.0, 0.0), table(SHAKE)[mode])


@pytest.mark.parametrize("particles", [1, 200])
@pytest.mark.parametrize("batch", [None, 3])
def test_a_filtered_record_is_one_update_after_another(particles, batch):
    model = Pushed()
    engine = RaoBlackwell(model, particles, dtype=torch.float64, seed=2)
    record = torch.tensor(SEEN, dtype=torch.float64)
    pushes = torch.tensor([0, 2, 2, 1, 0, 2])
    if batch:
        record = record + torch.arange(3.0)[:, None]
        pushes = torch.stack([pushes, pushes.flip(0), pushes])
    stepwise = engine.stepwise(engine.start(batch), Record.of(engine, pushes, record))
    for found, expected in zip(engine.filter(pushes, record, batch), stepwise, strict=True):
        torch.testing.assert_close(found.log_evidence, expected.log_evidence, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(found.log_weights, expected.log_weights, rtol=1e-9, atol=1e-9)
        assert torch.equal(found.values["mode"], expected.values["mode"])
        torch.testing.assert_close(found.marginal("place").mean, expected.marginal("place").mean)


def test_the_same_seed_draws_the_same_particles_and_another_seed_others():
    first, again, other = (RaoBlackwell(Switching(), 200, dtype=torch.float64, seed=s) for s in (1, 1, 2))
    torch.manual_seed(0)
    one = first.filter(None, SEEN)[-1]
    torch.manual_seed(5)
    two, three = again.filter(None, SEEN)[-1], other.filter(None, SEEN)[-1]
    assert torch.equal(one.log_evidence, two.log_evidence) and torch.equal(one.values["mode"], two.values["mode"])
    assert not torch.equal(one.log_evidence, three.log_evidence)


def test_with_nothing_seen_the_modes_have_their_prior():
    belief = runs(lambda seed: RaoBlackwell(Switching(), 500, dtype=torch.float64, seed=seed), 1, 40, [NAN] * 3)[0]
    assert float(belief.log_evidence.abs().max()) < 1e-9
    assert_mean(belief.marginal("mode").probs, np.linalg.matrix_power(STAY, 3)[0])
    assert_mean(belief.marginal("place").mean, Paths([NAN] * 3).mean)
