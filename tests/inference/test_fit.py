"""Learning parameters: by counting against counts made by hand, by gradient against a coarse search."""

import math

import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal, Poisson
from torch import Tensor, tensor, where

from apmodels import Contingency, Model, ValueOutOfRange, observation, state, static
from inference import Kalman, Refusal, fit
from tests.models import LearningToLook, RandomWalk


class Chain(Model):
    move: Tensor = tensor([[0.5, 0.5], [0.5, 0.5]])
    hit: Tensor = tensor([0.5, 0.5])
    rate: Tensor = tensor([1.0, 1.5])

    @state
    def at(self, prev_at=0):
        return Categorical(self.move[prev_at])

    @observation
    def click(self, at):
        return Bernoulli(self.hit[at])

    @observation
    def drops(self, at):
        return Poisson(self.rate[at])


@pytest.fixture
def record():
    truth = Chain(move=tensor([[0.8, 0.2], [0.3, 0.7]]), hit=tensor([0.1, 0.8]), rate=tensor([2.0, 6.0]))
    return truth.simulate(60, batch=4, seed=3)


def test_counting_is_counting(record):
    found = fit(Chain(), record, ["move", "hit", "rate"])
    assert set(found.how.values()) == {"counting"}
    at, before = record["at"], torch.nn.functional.pad(record["at"], (1, 0))[:, :-1]
    for i in (0, 1):
        assert float(found.model.hit[i]) == pytest.approx(float(record["click"][at == i].mean()), abs=1e-6)
        assert float(found.model.rate[i]) == pytest.approx(float(record["drops"][at == i].mean()), abs=1e-5)
        for j in (0, 1):
            share = float((at[before == i] == j).double().mean())
            assert float(found.model.move[i, j]) == pytest.approx(share, abs=1e-6)
    assert found.log_evidence[-1] > found.log_evidence[0]


def test_no_neighbour_is_likelier_than_what_was_counted(record):
    best = fit(Chain(), record, "hit").model
    whole = float(best.log_prob(record).sum())
    for step in (0.02, -0.02):
        for i in (0, 1):
            other = best.hit.clone()
            other[i] += step
            assert float(best.replace(hit=other).log_prob(record).sum()) < whole


def test_missing_outcomes_are_not_counted(record):
    click = record["click"].clone()
    click[:, ::2] = math.nan
    found = fit(Chain(), record | {"click": click}, "hit")
    at = record["at"][:, 1::2]
    assert found.how == {"hit": "counting"}
    assert float(found.model.hit[1]) == pytest.approx(float(click[:, 1::2][at == 1].mean()), abs=1e-6)


def test_pseudo_counts(record):
    few = fit(Chain(), {n: v[:1, :1] for n, v in record.items()}, "hit", prior=1.0)
    assert float(few.model.hit.min()) > 0 and float(few.model.hit.max()) < 1


def test_what_is_hidden_is_learned_by_gradient(record):
    hidden = {name: value[:, :25] for name, value in record.items() if name != "at"}
    start = Chain(hit=tensor([0.3, 0.6]), rate=tensor([2.0, 6.0]))
    found = fit(start, hidden, "hit", rounds=12)
    assert found.how == {"hit": "gradient"} and found.log_evidence[-1] > found.log_evidence[0] + 1
    assert found.log_evidence == sorted(found.log_evidence)
    assert float((found.model.hit - tensor([0.1, 0.8])).abs().max()) < 0.2


def test_a_kalman_fit_finds_the_maximum_of_a_coarse_search():
    reading = RandomWalk(drift=0.5, noise=1.0).simulate(40, batch=4, seed=1)["reading"]
    found = fit(RandomWalk(drift=1.0, noise=0.5), {"reading": reading}, ["drift", "noise"])
    for drift in (0.3, 0.45, 0.6):
        for noise in (0.8, 0.95, 1.1):
            engine = Kalman(RandomWalk(drift=drift, noise=noise), torch.float64)
            belief = list(engine.filter(None, reading, batch=4))[-1]
            assert float(belief.log_evidence.sum()) <= found.log_evidence[-1] + 1e-6
    assert isinstance(found.model.drift, float)


class Flip(Model):
    chance: float = 0.5

    @static
    def side(self):
        return Bernoulli(self.chance)

    @observation
    def seen(self, side):
        return Normal(where(side == 1, 1.0, -1.0), 1.0)


def test_a_probability_stays_a_probability():
    data = Flip(chance=0.02).simulate(3, batch=100, seed=0)
    found = fit(Flip(), {"seen": data["seen"]}, "chance")
    assert 0 < found.model.chance < 0.2
    told = fit(Flip(), {"seen": data["seen"]}, {"chance": "unit"})
    assert told.model.chance == pytest.approx(found.model.chance, abs=1e-3)


def test_wrong_questions():
    data = Flip().simulate(2, seed=0)
    with pytest.raises(ValueOutOfRange, match=r"no parameter chanse.*chance"):
        fit(Flip(), data, "chanse")
    with pytest.raises(ValueOutOfRange, match="window is a tuple"):
        fit(Contingency(), {}, "window")
    with pytest.raises(ValueOutOfRange, match="must be one of real"):
        fit(Flip(), {"seen": data["seen"]}, {"chance": "percent"})


def test_what_no_gradient_passes_through_is_refused():
    class Look(LearningToLook):
        spread: float = 0.1

        @state
        def motion(self, actuation, command):
            return Normal(actuation @ (torch.arange(3) == command).to(actuation.dtype), self.spread).to_event(1)

    record = Look().simulate(2, seed=0)
    with pytest.raises(Refusal, match=r"no engine passes a gradient.*motion"):
        fit(Look(), {name: record[name] for name in ("command", "image")}, "spread")
