"""``check`` agrees with itself, sees a wrong engine, and its brute force is right where a closed form says so."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

import inference
from apmodels import Contingency, ValueOutOfRange
from inference import Exact, Kalman, Refusal
from inference.brute_force.reference import reference
from inference.brute_force.weighed_worlds import drawn, gridded
from inference.check import simulated
from tests.inference.oracle import Oracle, plain
from tests.models import Coin, Coupled, RandomWalk, Tracking


@pytest.mark.parametrize("model", [Coin(), RandomWalk(), Contingency(presence=0.3)], ids=lambda m: type(m).__name__)
def test_exact_engines_agree_with_brute_force(model):
    report = inference.check(model, engines=["Exact", "Kalman", "RaoBlackwell"], records=1)
    assert report, str(report)
    assert str(report).startswith(repr(model)) and "agrees" in str(report) and "agrees" in report._repr_html_()


def test_a_wrong_engine_is_seen(monkeypatch):
    class Overconfident(Kalman):
        def update(self, belief, action, observation):
            return super().update(belief, action, 1.01 * torch.as_tensor(observation))

    Overconfident.__name__ = "Kalman"
    monkeypatch.setitem(inference.check.__globals__, "ENGINES", [Overconfident])
    monkeypatch.setitem(inference.check.__globals__["compare"].__globals__, "ENGINES", [Overconfident])
    monkeypatch.setattr(Overconfident, "filter", lambda self, a, o, batch=None: [_by_steps(self, a, o)])
    report = inference.check(RandomWalk(), engines=["Kalman"], records=1)
    assert not report and "DISAGREES" in str(report)


def _by_steps(engine, actions, observations):
    belief = engine.start()
    for y in observations:
        belief = engine.update(belief, actions, y)
    return belief


def test_an_engine_that_fails_is_told_and_not_hidden(monkeypatch):
    def fails(self, *_, **__):
        raise ArithmeticError("no")

    monkeypatch.setattr(Exact, "filter", fails)
    report = inference.check(Coin(), engines=["Exact"], records=1)
    assert not report and "FAILED: ArithmeticError: no" in str(report)


def test_wrong_questions():
    with pytest.raises(ValueOutOfRange, match=r"no engine Kalmann.*Kalman"):
        inference.check(Coin(), engines=["Kalmann"])
    with pytest.raises(Refusal, match="nothing that is hidden is Gaussian"):
        inference.check(Coin(), engines=["Kalman"])


def test_brute_force_over_a_gaussian_record_is_the_multivariate_normal():
    model = RandomWalk(drift=0.7, noise=1.2)
    y = torch.tensor([0.5, math.nan, -1.0], dtype=torch.float64)
    found = reference(model, {}, {"reading": y}, ["position"])
    spread = np.array([[0.49, 0.49], [0.49, 3 * 0.49]]) + 1.44 * np.eye(2)
    assert found.log_evidence == pytest.approx(stats.multivariate_normal.logpdf([0.5, -1.0], [0, 0], spread), abs=1e-9)


def test_brute_force_over_finite_worlds_is_the_other_oracle():
    model = Coupled()
    actions, seen = simulated(model, 3, 2)
    acts = [{n: v[t] for n, v in actions.items()} for t in range(3)]
    sees = [{n: v[t] for n, v in seen.items()} for t in range(3)]
    found = reference(model, actions, seen, ["near"])
    assert found.log_evidence == pytest.approx(Oracle(model).evidence(acts, sees), abs=1e-9)
    expected = Oracle(model).posterior(["near"], acts, sees)
    for value, prob in zip(model.structure.nodes["near"].values, found.probs["near"], strict=True):
        assert float(prob) == pytest.approx(expected[plain(value),], abs=1e-9)


def test_the_grid_and_the_draws_agree_within_the_draws_own_error():
    model = Contingency(presence=0.3)
    actions, seen = simulated(model, 4, 1)
    exact = gridded(model, actions, seen, ["responsive", "rates"])
    rough = drawn(model, actions, seen, ["responsive", "rates"], 100_000, 0)
    assert abs(exact.log_evidence - rough.log_evidence) < 4 * rough.evidence_error
    assert ((exact.probs["responsive"] - rough.probs["responsive"]).abs() < 4 * rough.errors["responsive"]).all()
    assert ((exact.moments["rates"][0] - rough.moments["rates"][0]).abs() < 4 * rough.errors["rates"]).all()


def test_missing_observations_are_part_of_the_check():
    _, seen = simulated(Tracking(), 400, 0, missing=0.3)
    lost = seen["seen"].isnan()
    assert lost.all(1).equal(lost.any(1)) and 0.2 < lost.all(1).double().mean() < 0.4
