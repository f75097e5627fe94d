"""The exact engine where rates are counted, against numerical integration over the rates themselves."""

import itertools
import math

import numpy as np
import pytest
import torch
from pyro.distributions import Bernoulli, Beta, Categorical, Dirichlet, Gamma, Poisson
from scipy import stats

from apmodels import Binary, Box, Contingency, Finite, Model, action, observation, state, static, where
from apmodels.simulation import as_given
from inference import Exact
from inference.records.record import Record
from tests.inference.rates_quadrature import Quadrature, counted, grid, interval, rolled, tossed, triangle

NAN = math.nan
CLOSE = {"rtol": 1e-6, "atol": 1e-6}


# Models, and what their authors would compute by hand: log p(record | hypothesis, rates) on a grid of rates.


class Switchboard(Model):
    """Three tones a step, some of which select the same rate; whose prior depends on the hypothesis."""

    press = action(Finite(3))
    idle = action(Box(-1.0, 1.0))

    @static
    def kind(self):
        return Categorical(torch.tensor([0.2, 0.5, 0.3]))

    @static
    def rates(self, kind):
        return Beta(torch.stack([2.0 + 2 * (kind == 2), torch.tensor(1.0)]), torch.tensor([3.0, 1.0])).to_event(1)

    @state
    def phase(self, press, prev_phase=0):
        return (prev_phase + press) % 3

    @observation
    def tones(self, kind, rates, phase):
        return Bernoulli(rates[torch.stack([0 * kind, where(kind == 0, 1, 0), where(phase == 0, 1, 0)])]).to_event(1)

    interest = kind


def switchboard(actions, seen):
    phases = np.cumsum([int(act["press"]) for act in actions]) % 3
    points, weights = grid(interval(24), interval(24))
    ones = [stats.beta.logpdf(points[:, 0], a, 3) + weights for a in (2, 2, 4)]

    def likelihood(kind, rates):
        total = np.zeros(len(rates))
        for phase, see in zip(phases, seen, strict=True):
            chosen = [0, 1 if kind == 0 else 0, 1 if phase == 0 else 0]
            total += sum(tossed(rates[:, i], [y]) for i, y in zip(chosen, see["tones"].tolist(), strict=True))
        return total

    return Quadrature([0.2, 0.5, 0.3], points, ones, likelihood)


class Doubt(Model):
    """A rate that may be unknown, or may be known."""

    @static
    def kind(self):
        return Bernoulli(0.4)

    @static
    def rate(self):
        return Beta(2.0, 1.0)

    @observation
    def tone(self, kind, rate):
        return Bernoulli(where(kind == 1, rate, 0.3))

    interest = kind


def doubt(actions, seen):
    points, weights = interval(24)
    outcomes = [float(see["tone"]) for see in seen]
    prior = stats.beta.logpdf(points[:, 0], 2, 1) + weights

    def likelihood(kind, rates):
        return tossed(rates[:, 0] if kind == 1 else np.full(len(rates), 0.3), outcomes)

    return Quadrature([0.6, 0.4], points, [prior, prior], likelihood)


class Roof(Model):
    """Drops on three tiles, two of which have the same rate."""

    open = action(Binary())

    @static
    def wet(self):
        return Bernoulli(0.4)

    @static
    def rates(self):
        return Gamma(torch.tensor([2.0, 3.0]), torch.tensor([1.0, 0.5])).to_event(1)

    @observation
    def drops(self, wet, rates, open):
        at = where((wet == 1) & (open == 1), 1, 0)
        return Poisson(rates[torch.stack([at, 0 * at, at])]).to_event(1)

    interest = wet


def roof(actions, seen):
    points, weights = grid(interval(160, 0, 30), interval(160, 0, 60))
    prior = weights + stats.gamma.logpdf(points, [2, 3], scale=[1, 2]).sum(1)

    def likelihood(wet, rates):
        total = np.zeros(len(rates))
        for act, see in zip(actions, seen, strict=True):
            at = 1 if wet and int(act["open"]) else 0
            total += sum(counted(rates[:, i], [y]) for i, y in zip([at, 0, at], see["drops"].tolist(), strict=True))
        return total

    return Quadrature([0.6, 0.4], points, [prior, prior], likelihood)


class Dice(Model):
    """Two dice of unknown bias; which of them is thrown first, and which one is thrown apart?"""

    @static
    def kind(self):
        return Bernoulli(0.4)

    @static
    def table(self):
        return Dirichlet(torch.tensor([[1.0, 2.0, 3.0], [2.0, 1.0, 1.0]])).to_event(1)

    @observation
    def rolls(self, kind, table):
        return Categorical(table[torch.stack([kind.long(), 0 * kind.long()])]).to_event(1)

    @observation
    def apart(self, kind, table):
        return Categorical(table[1 - kind.long()])

    interest = kind


def dice(actions, seen):
    points, weights = grid(triangle(14), triangle(14))
    prior = (
        weights
        + stats.dirichlet.logpdf(points[:, :3].T, [1, 2, 3])
        + stats.dirichlet.logpdf(points[:, 3:].T, [2, 1, 1])
    )

    def likelihood(kind, rates):
        dies, total = [rates[:, :3], rates[:, 3:]], np.zeros(len(rates))
        for see in seen:
            first, second = see["rolls"].tolist()
            total += rolled(dies[kind], [first]) + rolled(dies[0], [second])
            total += rolled(dies[1 - kind], [float(see["apart"])])
        return total

    return Quadrature([0.6, 0.4], points, [prior, prior], likelihood)


class Bells(Model):
    """Two rates that are variables of their own, under two observations and two hypotheses, one below the other."""

    @static
    def kind(self):
        return Bernoulli(0.4)

    @static
    def swap(self, kind):
        return Bernoulli(0.2 + 0.5 * kind)

    @static
    def low(self):
        return Beta(1.0, 3.0)

    @static
    def high(self):
        return Beta(3.0, 2.0)

    @observation
    def tone(self, swap, low, high):
        return Bernoulli(where(swap == 1, high, low))

    @observation
    def bell(self, kind, low, high):
        return Bernoulli(where(kind == 1, high, low))

    interest = (kind, swap)


def bells(actions, seen):
    points, weights = grid(interval(20), interval(20))
    prior = weights + stats.beta.logpdf(points, [1, 3], [3, 2]).sum(1)
    tones, rings = ([float(see[name]) for see in seen] for name in ("tone", "bell"))

    def likelihood(h, rates):
        kind, swap = divmod(h, 2)
        return tossed(rates[:, swap], tones) + tossed(rates[:, kind], rings)

    return Quadrature([0.6 * 0.8, 0.6 * 0.2, 0.4 * 0.3, 0.4 * 0.7], points, [prior] * 4, likelihood)


def contingency(actions, seen):
    points, weights = grid(interval(10), interval(10), interval(10))
    timers, timer = [], 4
    for act in actions:
        timer = 0 if int(act["vocalize"]) else min(timer + 1, 4)
        timers.append(timer)

    def likelihood(responsive, rates):
        total = np.zeros(len(rates))
        for timer, see in zip(timers, seen, strict=True):
            which = 0 if timer == 0 else 1 if responsive and timer < 4 else 2
            total += tossed(rates[:, which], [float(see["sound"])])
        return total

    return Quadrature([0.7, 0.3], points, [weights, weights], likelihood)


CASES = {
    "Switchboard": (Switchboard(), switchboard, ("kind",), ("rates",)),
    "Doubt": (Doubt(), doubt, ("kind",), ("rate",)),
    "Roof": (Roof(), roof, ("wet",), ("rates",)),
    "Dice": (Dice(), dice, ("kind",), ("table",)),
    "Bells": (Bells(), bells, ("kind", "swap"), ("low", "high")),
    "Contingency": (Contingency(presence=0.3), contingency, ("responsive",), ("rates",)),
}
all_cases = pytest.mark.parametrize("case", CASES)


def record_of(model, steps, seed, lose=0.0):
    """Actions and observations, each a list of dicts; elements are missing with probability ``lose``."""
    record, random = model.simulate(steps, seed=seed), np.random.default_rng(seed)
    actions = [{n: record[n][t] for n in model.action_names} for t in range(steps)]
    seen = [{n: record[n][t].double() for n in model.observation_names} for t in range(steps)]
    for see in seen:
        for name, value in see.items():
            gone = torch.as_tensor(random.uniform(size=tuple(value.shape)) < lose)
            see[name] = torch.where(gone, torch.nan, value)
    return actions, seen


def after(engine, actions, seen, batch=None):
    belief = engine.start(batch)
    for act, see in zip(actions, seen, strict=True):
        belief = engine.update(belief, as_given(act), as_given(see))
    return belief


def stacked(record):
    """A list of dicts by name as a dict of tensors whose first dimension is time."""
    return {name: torch.stack([torch.as_tensor(step[name]) for step in record]) for name in record[0]} or None


def assert_rates(belief, names, truth):
    means = np.concatenate([belief.marginal(name).mean.numpy().reshape(-1) for name in names])
    variances = np.concatenate([belief.marginal(name).variance.numpy().reshape(-1) for name in names])
    np.testing.assert_allclose(means, truth.mean, **CLOSE)
    np.testing.assert_allclose(variances, truth.variance, **CLOSE)


def assert_agrees(belief, names, rates, truth):
    """Evidence, hypotheses and rates, against the integral."""
    assert float(belief.log_evidence) == pytest.approx(truth.evidence, abs=1e-6)
    sizes = [len(belief.marginal(name).values) for name in names]
    table = truth.probabilities.reshape(sizes)
    for axis, name in enumerate(names):
        others = tuple(other for other in range(len(names)) if other != axis)
        np.testing.assert_allclose(belief.marginal(name).probs.numpy(), table.sum(others), **CLOSE)
    assert float(belief.entropy(names)) == pytest.approx(truth.entropy, abs=1e-6)
    assert_rates(belief, rates, truth)


@all_cases
@pytest.mark.parametrize(("steps", "lose"), [(1, 0.0), (6, 0.0), (6, 0.3)])
def test_counts_give_the_integral_over_the_rates(case, steps, lose):
    model, oracle, names, rates = CASES[case]
    for seed in range(3):
        actions, seen = record_of(model, steps, seed, lose)
        assert_agrees(after(Exact(model, torch.float64), actions, seen), names, rates, oracle(actions, seen))


@all_cases
def test_before_any_data_the_rates_have_their_prior(case):
    model, oracle, names, rates = CASES[case]
    assert_agrees(Exact(model, torch.float64).start(), names, rates, oracle([], []))


@all_cases
def test_what_is_missing_says_nothing(case):
    model, oracle, names, rates = CASES[case]
    actions, seen = record_of(model, 4, 3)
    seen[1] = {name: torch.full_like(value, NAN) for name, value in seen[1].items()}
    truth = oracle(actions, seen)
    belief = after(Exact(model, torch.float64), actions, seen)
    assert_agrees(belief, names, rates, truth)
    # And with nothing ever seen, nothing is learned.
    nothing = [{name: torch.full_like(value, NAN) for name, value in see.items()} for see in seen]
    blind = after(Exact(model, torch.float64), actions, nothing)
    assert float(blind.log_evidence) == pytest.approx(0.0, abs=1e-12)
    assert_agrees(blind, names, rates, oracle([], []))


@pytest.mark.parametrize("seed", range(3))
def test_the_marginal_of_a_rate_is_the_mixture_over_hypotheses(seed):
    """Its density at any point is prior times likelihood, summed over hypotheses, over the evidence."""
    model, oracle, _, _ = CASES["Switchboard"]
    actions, seen = record_of(model, 5, seed, 0.2)
    truth = oracle(actions, seen)
    law = after(Exact(model, torch.float64), actions, seen).marginal("rates")
    # The weights of the integral's own points, divided out, leave the density there.
    _, weights = grid(interval(24), interval(24))
    density = truth.cells.sum(0) / np.exp(weights)
    some = np.arange(0, len(density), 37)
    found = law.log_prob(torch.as_tensor(truth.points[some])).exp().numpy()
    np.testing.assert_allclose(found, density[some], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_drops_without_hypotheses_are_the_gamma_of_the_textbook(seed):
    class Rain(Model):
        @static
        def rate(self):
            return Gamma(2.0, 3.0)

        @observation
        def drops(self, rate):
            return Poisson(rate)

    drops = Rain().simulate(30, seed=seed)["drops"]
    belief = Exact(Rain(), torch.float64).filter(None, drops)[-1]
    law = belief.marginal("rate")
    total = float(drops.sum())
    assert float(law.concentration) == 2 + total and float(law.rate) == 3 + 30
    # Gamma function ratios: a negative multinomial.
    expected = 2 * math.log(3) - (2 + total) * math.log(33) + math.lgamma(2 + total) - math.lgamma(2)
    expected -= sum(math.lgamma(y + 1) for y in drops.tolist())
    assert float(belief.log_evidence) == pytest.approx(expected, abs=1e-6)


def chances(law, outcome):
    """How probable an outcome is in each element of an observation that is expected, mixed over hypotheses."""
    parts, weights = law.component_distribution, law.mixture_distribution.probs
    base = parts.base_dist if law.event_shape else parts
    each = base.log_prob(torch.full(base.batch_shape, outcome, dtype=torch.float64)).exp()
    return torch.tensordot(weights, each, dims=1).numpy().reshape(-1)


@all_cases
def test_every_element_of_the_forecast_is_the_ratio_of_two_integrals(case):
    """Of the record with one more outcome of one element, over that without it."""
    model, oracle, _, _ = CASES[case]
    actions, seen = record_of(model, 4, 5, 0.2)
    engine, ahead = Exact(model, torch.float64), actions[0]
    laws = engine.forecast(after(engine, actions, seen), as_given(ahead))
    laws = laws if isinstance(laws, dict) else {model.observation_names[0]: laws}
    past = oracle(actions, seen).evidence
    nothing = {name: torch.full_like(value, NAN) for name, value in seen[0].items()}
    for name, law in laws.items():
        assert law.event_shape == seen[0][name].shape
        for outcome in (0.0, 1.0):
            for element, chance in enumerate(chances(law, outcome)):
                value = nothing[name].reshape(-1).clone()
                value[element] = outcome
                more = nothing | {name: value.reshape(nothing[name].shape)}
                expected = math.exp(oracle([*actions, ahead], [*seen, more]).evidence - past)
                assert chance == pytest.approx(expected, abs=1e-6)


def test_the_gain_is_the_expected_fall_of_the_integrals_entropy():
    model, oracle, _, _ = CASES["Contingency"]
    actions, seen = record_of(model, 5, 2)
    engine = Exact(model, torch.float64)
    now = oracle(actions, seen)
    gains = engine.gain(after(engine, actions, seen))
    for act, gain in enumerate(gains.tolist()):
        expected = now.entropy
        for sound in (0.0, 1.0):
            then = oracle([*actions, {"vocalize": act}], [*seen, {"sound": sound}])
            expected -= math.exp(then.evidence - now.evidence) * then.entropy
        assert gain == pytest.approx(expected, abs=1e-6)


def test_an_action_that_bears_on_nothing_changes_nothing():
    engine, seen = Exact(Switchboard(), torch.float64), record_of(Switchboard(), 4, 1)[1]
    actions = [{"press": 1, "idle": torch.tensor(0.1 * t)} for t in range(4)]
    others = [{"press": 1, "idle": torch.tensor(-0.2 * t)} for t in range(4)]
    one, other = after(engine, actions, seen), after(engine, others, seen)
    assert torch.equal(one.log_evidence, other.log_evidence)
    assert torch.equal(one.log_weights, other.log_weights)
    assert torch.equal(one.counts[0], other.counts[0])
    # One that bears on what is known does change it.
    third = after(engine, [{**act, "press": 0} for act in actions], seen)
    assert not torch.allclose(one.log_evidence, third.log_evidence)


@all_cases
def test_a_batch_is_as_many_single_runs(case):
    model, _, names, rates = CASES[case]
    runs = [record_of(model, 4, seed, 0.2) for seed in range(3)]
    engine = Exact(model, torch.float64)
    parts = [
        [{n: torch.stack([run[k][t][n] for run in runs]) for n in runs[0][k][t]} for t in range(4)] for k in (0, 1)
    ]
    together = after(engine, *parts, batch=3)
    for i, run in enumerate(runs):
        single = after(engine, *run)
        assert float(together.log_evidence[i]) == pytest.approx(float(single.log_evidence), abs=1e-12)
        assert float(together.entropy(names)[i]) == pytest.approx(float(single.entropy(names)), abs=1e-12)
        for name in names:
            torch.testing.assert_close(together.marginal(name).probs[i], single.marginal(name).probs)
        for name in rates:
            torch.testing.assert_close(together.marginal(name).mean[i], single.marginal(name).mean)
            torch.testing.assert_close(together.marginal(name).variance[i], single.marginal(name).variance)


@all_cases
@pytest.mark.parametrize("batch", [None, 3])
def test_a_filtered_record_is_one_update_after_another(case, batch):
    model, _, names, rates = CASES[case]
    runs = [record_of(model, 7, seed, 0.3) for seed in range(batch or 1)]
    actions, seen = ([stacked(run[k]) for run in runs] for k in (0, 1))
    if batch:
        actions = {n: torch.stack([a[n] for a in actions]) for n in actions[0]} if actions[0] else None
        seen = {n: torch.stack([s[n] for s in seen]) for n in seen[0]}
    else:
        actions, seen = actions[0], seen[0]
    engine = Exact(model, torch.float64)
    beliefs = engine.filter(actions, seen, batch)
    stepwise = engine.stepwise(engine.start(batch), Record.of(engine, actions, seen))
    assert len(beliefs) == len(stepwise) == 7
    for found, expected in zip(beliefs, stepwise, strict=True):
        assert found.time == expected.time and found.known.keys() == expected.known.keys()
        torch.testing.assert_close(found.log_evidence, expected.log_evidence, rtol=1e-9, atol=1e-9)
        for name in names:
            torch.testing.assert_close(found.marginal(name).probs, expected.marginal(name).probs)
        for name in rates:
            torch.testing.assert_close(found.marginal(name).mean, expected.marginal(name).mean)


class Toss(Model):
    """One coin, and no hypothesis."""

    @static
    def rate(self):
        return Beta(1.0, 1.0)

    @observation
    def toss(self, rate):
        return Bernoulli(rate)


def test_a_long_record_is_counted_as_well_as_a_short_one():
    """Ten thousand tosses of one coin, against the Beta function."""
    tosses = (torch.rand(10_000, generator=torch.Generator().manual_seed(0)) < 0.2).double()
    belief = Exact(Toss(), torch.float64).filter(None, tosses)[-1]
    heads, tails = float(tosses.sum()), float((1 - tosses).sum())
    expected = math.lgamma(heads + 1) + math.lgamma(tails + 1) - math.lgamma(10_002)
    assert float(belief.log_evidence) == pytest.approx(expected, rel=1e-9)
    assert float(belief.marginal("rate").mean) == pytest.approx((heads + 1) / 10_002, abs=1e-12)


def test_a_single_belief_about_one_rate_alone_has_a_marginal():
    belief = Exact(Toss(), torch.float64).filter(None, [1.0, 0.0, 1.0])[-1]
    assert float(belief.marginal("rate").mean) == pytest.approx(3 / 5)


# The sufficient statistic of chapter 4.


HISTORIES = 600


@pytest.fixture(scope="module")
def histories():
    """Many random histories of calls and sounds in one batch; and what is believed after each."""
    random = np.random.default_rng(7)
    calls = (random.uniform(size=(HISTORIES, 9)) < 0.3).astype(int)
    sounds = (random.uniform(size=(HISTORIES, 9)) < 0.5).astype(float)
    engine = Exact(Contingency(presence=0.3), torch.float64)
    return calls, sounds, engine, engine.filter(torch.tensor(calls), torch.tensor(sounds), HISTORIES)[-1]


def thesis_statistic(calls, sounds):
    """(Z, P2, P3, Q2, Q3) of eq. 4.52: steps since a call; sounds (P) and silences (Q) while an answer could come
    (2) and while none could (3)."""
    timer, heard = 4, {"P2": 0, "P3": 0, "Q2": 0, "Q3": 0}
    for call, sound in zip(calls, sounds, strict=True):
        timer = 0 if call else min(timer + 1, 4)
        if timer:
            heard[("P" if sound else "Q") + ("2" if timer < 4 else "3")] += 1
    return timer, *heard.values()


def keys_of(found):
    """A batch of statistics as tuples."""
    known = torch.stack([value.reshape(len(found.counts), -1).double() for value in found.known.values()], 1)
    return [tuple(row) for row in torch.cat([known.flatten(1), found.counts.flatten(1)], 1).tolist()]


def groups_of(keys):
    order = sorted(range(len(keys)), key=lambda i: keys[i])
    return [list(group) for _, group in itertools.groupby(order, key=lambda i: keys[i])]


def test_the_statistic_is_the_one_of_the_thesis(histories):
    calls, sounds, engine, belief = histories
    found = engine.statistic(belief)
    by_hand = [thesis_statistic(c, s) for c, s in zip(calls, sounds, strict=True)]
    assert found.known["timer"].tolist() == [z for z, *_ in by_hand]
    # Beta counts are (silences, sounds) of the agent's component and of the background's.
    assert found.counts.tolist() == [[[q2, p2], [q3, p3]] for _, p2, p3, q2, q3 in by_hand]


def test_equal_statistics_are_equal_posteriors(histories):
    _, _, engine, belief = histories
    probs = belief.marginal("responsive").probs[:, 1]
    groups = [g for g in groups_of(keys_of(engine.statistic(belief))) if len(g) > 1]
    assert len(groups) > 20, "the histories must meet"
    for group in groups:
        torch.testing.assert_close(probs[group], probs[group[:1]].expand(len(group)), rtol=0, atol=1e-12)
    # The statistic is not so coarse that it says nothing, nor so fine that it is the history.
    assert float(probs.std()) > 0.05


def test_equal_statistics_have_equal_futures(histories):
    """Whatever is then done and heard (eqs 4.53 and 4.54)."""
    _, _, engine, belief = histories
    groups = [g for g in groups_of(keys_of(engine.statistic(belief))) if len(g) > 1]
    for act in (0, 1):
        chance = engine.forecast(belief, act).log_prob(torch.ones(HISTORIES, dtype=torch.float64))
        # Of one's own echo the statistic says nothing: the chance of hearing it depends on what was counted of it.
        for group in groups if act == 0 else []:
            torch.testing.assert_close(chance[group], chance[group[:1]].expand(len(group)))
    later = belief
    for act, sound in [(1, 1.0), (0, 1.0), (0, 0.0), (1, 0.0), (0, 1.0)]:
        later = engine.update(later, act, sound)
    probs, gains = later.marginal("responsive").probs[:, 1], engine.gain(later)
    keys = keys_of(engine.statistic(later))
    for group in groups:
        torch.testing.assert_close(probs[group], probs[group[:1]].expand(len(group)), rtol=0, atol=1e-12)
        assert len({keys[i] for i in group}) == 1
        torch.testing.assert_close(gains[group], gains[group[:1]].expand(len(group), 2), rtol=0, atol=1e-12)


def test_the_statistic_is_no_finer_than_the_posterior_needs(histories):
    """One more sound or silence in any one of the counts is another posterior, for some history at least."""
    _, _, engine, belief = histories
    found, probs = engine.statistic(belief), belief.marginal("responsive").probs[:, 1].numpy()
    counts = found.counts.flatten(1)
    for column in range(4):
        rest = [c for c in range(4) if c != column]
        keys = [tuple(row) for row in counts[:, rest].tolist()]
        spreads = [float(np.ptp(probs[group])) for group in groups_of(keys)]
        assert max(spreads) > 1e-3, found.labels


def test_what_is_heard_of_oneself_does_not_matter():
    """Histories that differ in the echo alone have the same statistic and the same posterior."""
    engine = Exact(Contingency(presence=0.3), torch.float64)
    calls = torch.tensor([1, 0, 0, 1, 0, 0, 0, 0])
    sounds = torch.tensor([[1, 1, 0, 1, 1, 0, 1, 0], [0, 1, 0, 0, 1, 0, 1, 0], [NAN, 1, 0, 1, 1, 0, 1, 0]])
    belief = engine.filter(calls, sounds, 3)[-1]
    found = engine.statistic(belief)
    assert torch.equal(found.counts, found.counts[:1].expand(3, 2, 2))
    probs = belief.marginal("responsive").probs[:, 1]
    torch.testing.assert_close(probs, probs[:1].expand(3), rtol=0, atol=1e-12)
    echo = belief.marginal("rates").mean[:, 0]
    assert len(set(echo.tolist())) == 3


def test_a_missing_sound_is_counted_nowhere():
    engine = Exact(Contingency(presence=0.3), torch.float64)
    belief = engine.filter(torch.tensor([1, 0, 0, 0, 0]), torch.tensor([1.0, NAN, 1.0, 0.0, NAN]))[-1]
    found = engine.statistic(belief)
    assert found.known["timer"] == 4
    assert found.counts.tolist() == [[1, 1], [0, 0]]


def test_what_no_hypothesis_tells_apart_has_no_statistic():
    engine = Exact(Toss(), torch.float64)
    with pytest.raises(ValueError, match="bears on its hypotheses"):
        engine.statistic(engine.start())


class Kettle(Model):
    """Drops fall at a known rate or at one that is not."""

    @static
    def known(self):
        return Bernoulli(0.5)

    @static
    def rate(self):
        return Gamma(2.0, 1.0)

    @observation
    def drops(self, known, rate):
        return Poisson(where(known == 1, 20.0, rate))

    interest = known


@pytest.mark.parametrize("drops", [0.0, 3.0, 40.0])
def test_the_forecast_of_a_known_rate_beside_a_counted_one_is_what_the_evidence_says(drops):
    engine = Exact(Kettle(), torch.float64)
    said = engine.forecast(engine.start(), None).log_prob(torch.tensor(drops))
    assert float(said) == pytest.approx(float(engine.update(engine.start(), None, drops).log_evidence), abs=1e-5)
