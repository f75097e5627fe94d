"""Backward induction against a search through all histories, and against what other controllers reach."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.distributions import Beta
from pyro.distributions.torch import Bernoulli
from scipy.special import betaln

from apmodels import Contingency, Finite, Model, ValueOutOfRange, action, interest, observation, ones, static
from controllers import DynamicProgramming, Information, belief_mdp, rollout
from controllers.belief_mdp import BeliefMDP
from controllers.plan import solve
from hardware import Simulated
from inference import Exact, Kalman, Refusal
from tests.models import RandomWalk


class Histories:
    """Everything that can be done and heard, one history after another; nothing of the library is used.

    ``choices`` notes, by history, what each action is worth.
    """

    def __init__(self, model, horizon, weights):
        self.model, self.horizon, self.weights = model, horizon, weights
        self.choices = {}
        self.value = self.search((), model.window[1] + 1, (0, 0, 0, 0))

    def search(self, history, timer, counts):
        time = len(history)
        own = self.weights[time - 1] * -self.entropy(counts) if time else 0.0
        if time == self.horizon:
            return own
        worth = []
        for call in (0, 1):
            after = 0 if call else min(timer + 1, self.model.window[1] + 1)
            ahead = 0.0
            for sound in (0, 1):
                grown, chance = self.heard(counts, after, sound)
                ahead += chance * self.search((*history, (call, sound)), after, grown)
            worth.append(ahead)
        self.choices[history] = worth
        return own + max(worth)

    def heard(self, counts, timer, sound):
        """What is counted, and how probable it was; an echo is as probable as you like: it tells nothing."""
        first, last = self.model.window
        if self.model.echo[0] <= timer <= self.model.echo[1]:
            return counts, 0.5
        at = (0 if first <= timer <= last else 2) + (1 - sound)
        grown = tuple(n + (i == at) for i, n in enumerate(counts))
        return grown, math.exp(self.log_evidence(grown) - self.log_evidence(counts))

    def both(self, counts):
        """log p(S, what was heard) for S = 0, 1 (4.43, 4.45)."""
        p2, q2, p3, q3 = counts
        (a2, b2), (a3, b3) = self.model.answering, self.model.background
        absent = betaln(a3 + p2 + p3, b3 + q2 + q3) - betaln(a3, b3) + math.log(1 - self.model.presence)
        present = betaln(a2 + p2, b2 + q2) - betaln(a2, b2) + betaln(a3 + p3, b3 + q3) - betaln(a3, b3)
        return absent, present + math.log(self.model.presence)

    def log_evidence(self, counts):
        return float(np.logaddexp(*self.both(counts)))

    def entropy(self, counts):
        absent, present = self.both(counts)
        p = 1 / (1 + math.exp(absent - present))
        return -sum(x * math.log(x) for x in (p, 1 - p) if x > 0)


def assert_best(model, horizon, weights):
    """The same value, and in every history the same action, but for ties."""
    brute = Histories(model, horizon, weights)
    controller = DynamicProgramming(Exact(model, torch.float64), horizon, weights)
    assert controller.plan.value == pytest.approx(brute.value, abs=1e-9)
    for length in range(horizon):
        some = [history for history in brute.choices if len(history) == length]
        engine, belief = controller.engine, controller.engine.start(len(some))
        if length:
            record = torch.tensor(some)
            belief = engine.filter(record[..., 0], record[..., 1].double(), len(some))[-1]
        for history, chosen in zip(some, controller.act(belief).tolist(), strict=True):
            wait, call = brute.choices[history]
            assert abs(wait - call) < 1e-9 or chosen == int(call > wait), (history, wait, call)


pairs = st.tuples(st.floats(0.3, 4), st.floats(0.3, 4))


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 1),
    st.integers(0, 2),
    st.floats(0.01, 0.9),
    pairs,
    pairs,
    st.booleans(),
    st.integers(1, 5),
    st.data(),
)
def test_the_plan_is_that_of_a_search_through_all_histories(last, more, presence, one, other, alike, horizon, data):
    one, other = ((n, n) for n, _ in (one, other)) if alike else (one, other)
    model = Contingency(
        presence=presence, echo=(0, last), window=(last + 1, last + 1 + more), answering=one, background=other
    )
    weights = data.draw(st.lists(st.floats(0, 2), min_size=horizon, max_size=horizon))
    assert_best(model, horizon, weights)


@pytest.mark.parametrize("weights", ["summed", "terminal"])
def test_seven_steps_of_the_thesis_model(weights):
    found = [1.0] * 7 if weights == "summed" else [0.0] * 6 + [1.0]
    assert_best(Contingency(), 7, found)


def test_the_mirror_changes_nothing(monkeypatch):
    mdp = belief_mdp(Exact(Contingency(), torch.float64))
    assert mdp.mirrored
    folded = solve(mdp, 14, [1.0] * 14)
    monkeypatch.setattr(BeliefMDP, "mirrored", False)
    plain = solve(mdp, 14, [1.0] * 14)
    assert plain.states.size > 1.6 * folded.states.size
    assert plain.value == pytest.approx(folded.value, abs=1e-12)
    counts = np.concatenate([plain.states.counts(b) for b in np.flatnonzero(plain.states.earliest <= 4)])
    for left, kind in itertools.product((1, 5, 10), range(4)):
        kinds = np.full(len(counts), kind)
        assert (plain.choose(kinds, counts, left) == folded.choose(kinds, counts, left)).all()


def test_a_receding_horizon_is_the_first_of_a_whole_plan():
    engine = Exact(Contingency(presence=0.2), torch.float64)
    receding = DynamicProgramming(engine, 6, steps=5)
    whole = DynamicProgramming(engine, 6)
    assert torch.equal(receding.act(engine.start(3)), whole.act(engine.start(3)))
    calls = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 0]])
    later = engine.filter(calls, torch.tensor([[1.0, 1, 0], [0, 1, 1], [1, 0, 1]]), 3)[-1]
    # Three steps on it still looks six ahead: as much as a plan over nine looks then.
    assert torch.equal(receding.act(later), DynamicProgramming(engine, 9).act(later))


def test_more_information_than_greedy_or_random_and_what_the_plan_promised():
    model = Contingency(presence=0.5)
    engine = Exact(model, torch.float64)
    plan = DynamicProgramming(engine, 12, "terminal")
    found = rollout(Simulated(model, batch=4000), engine, plan, steps=12, seed=1)
    last = found.entropy.values[:, -1]
    assert plan.plan.value == pytest.approx(-last.mean(), abs=4 * last.std() / 4000**0.5)


class Levers(Model):
    """Which of three levers pays best?"""

    pull = action(Finite(3))

    @static
    def rates(self):
        return Beta(ones(3), ones(3)).to_event(1)

    @observation
    def payoff(self, rates, pull):
        return Bernoulli(rates[pull])

    @interest
    def interest(self, rates):
        return rates.argmax(-1)


def test_it_plans_for_levers_too():
    """Two pulls: after one the best next lever and its worth are found by hand, by drawing rates."""
    engine = Exact(Levers(), torch.float64)
    plan = DynamicProgramming(engine, 2, "terminal")
    random = np.random.default_rng(0)

    def uncertainty(counts):
        draws = random.beta(1 + np.array(counts)[:, 1], 1 + np.array(counts)[:, 0], size=(200_000, 3)).argmax(1)
        share = np.bincount(draws, minlength=3) / len(draws)
        return -(share * np.log(share)).sum()

    def worth(counts, left):
        if not left:
            return -uncertainty(counts)
        found = []
        for lever in range(3):
            zero, one = counts[lever]
            p = (1 + one) / (2 + zero + one)
            ahead = [[list(n) for n in counts] for _ in range(2)]
            ahead[0][lever][0] += 1
            ahead[1][lever][1] += 1
            found.append((1 - p) * worth(ahead[0], left - 1) + p * worth(ahead[1], left - 1))
        return max(found)

    assert plan.plan.value == pytest.approx(worth([[0, 0]] * 3, 2), abs=0.02)
    assert plan.act(engine.start()).shape == ()


def test_policies_are_kept_and_opened_again(tmp_path):
    engine = Exact(Contingency(presence=0.3), torch.float64)
    made = DynamicProgramming(engine, 8)
    made.save(tmp_path / "policy.npz")
    again = DynamicProgramming.load(engine, tmp_path / "policy.npz")
    belief = engine.filter(torch.tensor([0, 1, 0]), torch.tensor([1.0, 1.0, 0.0]))[-1]
    assert again.act(belief) == made.act(belief)
    assert again.plan.value == made.plan.value
    with pytest.raises(ValueOutOfRange, match="is a plan for Contingency"):
        DynamicProgramming.load(Exact(Contingency()), tmp_path / "policy.npz")


def test_a_plan_that_does_not_fit_is_refused_with_the_figure():
    with pytest.raises(ValueOutOfRange, match=r"a plan over 40 steps takes .* GB and about .* s; 0.001 GB may be used"):
        DynamicProgramming(Exact(Contingency()), 40, memory=0.001)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda e: DynamicProgramming(e, 0), "horizon and steps of 1 or more"),
        (lambda e: DynamicProgramming(e, 3, "late"), "there are no late rewards"),
        (lambda e: DynamicProgramming(e, 3, [1.0, 1.0]), "needs as many weights"),
        (lambda e: DynamicProgramming(e, 2).act(e.filter([0, 0], [0.0, 1.0])[-1]), "the plan is for 2 steps"),
    ],
)
def test_what_makes_no_sense_is_told(made, words):
    with pytest.raises(ValueOutOfRange, match=words):
        made(Exact(Contingency()))


def test_engines_without_counts_are_refused():
    with pytest.raises(Refusal, match="no sufficient statistic"):
        DynamicProgramming(Kalman(RandomWalk()), 3)


def test_information_is_minus_the_entropy():
    belief = Exact(Contingency(presence=0.3)).start(2)
    assert torch.equal(Information()(belief), -belief.entropy())
