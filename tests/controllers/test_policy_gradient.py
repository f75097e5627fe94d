"""Policy gradient: against enumerated expectations, from a flat start, and when it goes wrong."""

import itertools
import math

import numpy as np
import pytest
import torch

import controllers
from apmodels import Grid, ValueOutOfRange, VisualSearch
from controllers import (
    ConvolutionalPolicy,
    Falling,
    Fixated,
    Information,
    LearningWarning,
    LogisticPolicy,
    PolicyGradient,
)
from controllers.policy_experience import to_go
from controllers.policy_watch import Watch
from controllers.rewards import PercentCorrect
from hardware import Simulated
from inference import Exact, Refusal
from tests.models import Caller, Lamp, RandomWalk


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small tensors need one thread, and get it faster on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def lamp():
    return Exact(Lamp(cells=3), torch.float64)


@pytest.fixture(scope="module")
def search():
    return Exact(VisualSearch(grid=Grid(5, 5))).prepare()


def plainly(belief):
    """A reward of the belief alone, by a user."""
    return belief.marginal("lit").probs[..., 0] ** 2


def enumerated(policy, reward, steps, weights):
    """What an episode with the lamps is worth, by summing over all actions and flashes; nothing here is an engine's."""
    prior = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / 6
    flash = torch.tensor(
        [[0.9 if lit == look else 0.2 + 0.05 * look for lit in range(3)] for look in range(3)]
    ).double()

    def ahead(b, t):
        if t == steps:
            return 0.0
        chances = policy(b).softmax(-1)
        total = 0.0
        for u, y in itertools.product(range(3), (0, 1)):
            joint = b * (flash[u] if y else 1 - flash[u])
            after = joint / joint.sum()
            total = total + chances[u] * joint.sum() * (weights[t] * reward(after, u) + ahead(after, t + 1))
        return total

    return ahead(prior, 0)


REWARDS = [
    (Information(), lambda b, u: (b * b.log()).sum()),
    (Fixated(), lambda b, u: b[u]),
    (PercentCorrect(), lambda b, u: b.max()),
    (plainly, lambda b, u: b[0] ** 2),
]


@pytest.mark.parametrize("baseline", ["none", "mean", "belief"])
@pytest.mark.parametrize(("reward", "truly"), REWARDS, ids=lambda r: repr(r)[:12])
def test_gradient_is_that_of_the_expectation(reward, truly, baseline, lamp):
    policy = LogisticPolicy(3, 3, ("belief", "flattened"), spread=2.0, seed=4).double()
    value = enumerated(policy, truly, 2, [1.0, 0.5])
    value.backward()
    true = policy.weights.grad.clone()
    learner = PolicyGradient(lamp, policy, reward, steps=2, batch=2000, baseline=baseline, weights=[1.0, 0.5])
    found, worth = [], []
    for update in range(30):
        policy.weights.grad = None
        earned, entropy = learner.gradient(update)
        found.append(-policy.weights.grad)
        worth.append(earned.mean())
        assert 0 < entropy < math.log(3)
    found, worth = torch.stack(found), torch.stack(worth)
    assert abs(worth.mean() - value.detach()) < 4 * worth.std() / len(worth) ** 0.5
    error = found.std(0) / len(found) ** 0.5
    assert float(((found.mean(0) - true).abs() / error).max()) < 4.5
    assert float(true.abs().max()) > 5 * float(error.max())


def test_baselines_take_noise_away(search):
    noise = {}
    for baseline in ("none", "mean", "belief"):
        learner = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=12, batch=100, baseline=baseline)
        found = []
        for update in range(20):
            learner.policy.weights.grad = None
            learner.gradient(update)
            found.append(learner.policy.weights.grad)
        noise[baseline] = float(torch.stack(found).std(0).norm())
    assert noise["belief"] < 0.8 * noise["mean"] and noise["mean"] < 0.9 * noise["none"]


@pytest.mark.parametrize("beta", [0.0, 0.75, 1.0])
def test_what_follows_is_the_trace_read_backwards(beta):
    """Σ_t r_t z_t with z ← βz + ∇log p (GPOMDP) is Σ_t ∇log p_t G_t."""
    draws = torch.Generator().manual_seed(1)
    slopes = torch.randn(6, 4, 3, generator=draws, dtype=torch.float64)
    rewards = torch.randn(6, 4, generator=draws, dtype=torch.float64)
    trace, total = torch.zeros(4, 3, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
    for slope, reward in zip(slopes, rewards, strict=True):
        trace = beta * trace + slope
        total += reward[:, None] * trace
    torch.testing.assert_close((slopes * to_go(rewards, beta)[..., None]).sum(0), total)


def test_large_batches_come_in_pieces(search, monkeypatch):
    learner = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=4, batch=50)
    monkeypatch.setattr(controllers.policy_gradient, "KEPT", 4 * 25 * 16)
    monkeypatch.setattr(controllers.policy_gradient, "AT_ONCE", 30 * 25)
    worth, _ = learner.gradient(0)
    assert worth.shape == (50,) and len(torch.unique(worth)) == 50


def test_looks_beside_and_not_at(search):
    """From a flat start the kernel gets its peak beside the centre (thesis Fig. 5.7b)."""
    policy = ConvolutionalPolicy(Grid(5, 5))
    learner = PolicyGradient(search, policy, steps=15, batch=300, seed=1)
    history = learner.learn(60)
    weights = policy.weights.detach()[0]
    assert float(weights[1:3].max()) > float(weights[0]) + 10
    first, last = (float(history.worth[part].mean()) for part in (slice(0, 3), slice(-10, None)))
    assert last > first + 0.5 and list(history["update"].values) == list(range(1, 61))
    assert float(history.entropy[-1]) < float(history.entropy[0]) == pytest.approx(math.log(25), abs=1e-4)


def test_looks_at_it_when_that_is_what_counts(search):
    policy = ConvolutionalPolicy(Grid(5, 5))
    PolicyGradient(search, policy, Fixated(), steps=15, batch=300).learn(40)
    weights = policy.weights.detach()[0]
    assert float(weights[0]) > float(weights[1:].max()) + 10


def test_seeds_reproduce_and_learning_goes_on_from_a_file(search, tmp_path):
    def learner():
        return PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=5, batch=20, seed=3)

    one, two = learner(), learner()
    one.learn(4)
    two.learn(2)
    two.act(search.start(5))
    two.save(tmp_path / "kept.npz")
    found = controllers.load(tmp_path / "kept.npz", search)
    assert isinstance(found, PolicyGradient) and found.updates == 2
    found.learn(2)
    assert torch.equal(found.policy.weights, one.policy.weights)
    other = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=5, batch=20, seed=4)
    other.learn(4)
    assert not torch.equal(other.policy.weights, one.policy.weights)
    with pytest.raises(ValueOutOfRange, match="has learned VisualSearch"):
        controllers.load(tmp_path / "kept.npz", Exact(VisualSearch(grid=Grid(5, 5), acuity=lambda e: 1.0 + 0 * e)))


def test_plans_are_loaded_likewise(tmp_path):
    from apmodels import Contingency

    engine = Exact(Contingency())
    plan = controllers.DynamicProgramming(engine, 4)
    plan.save(tmp_path / "plan.npz")
    assert controllers.load(tmp_path / "plan.npz", engine).plan.value == plan.plan.value
    with pytest.raises(Refusal, match="needs its engine"):
        controllers.load(tmp_path / "plan.npz")


@pytest.mark.parametrize("batch", [None, 1, 5])
@pytest.mark.parametrize("greedy", [False, True])
def test_acting(batch, greedy, search):
    policy = ConvolutionalPolicy(Grid(5, 5), spread=9.0)
    learner = PolicyGradient(search, policy, greedy=greedy)
    belief = search.update(search.start(batch), 3, torch.randn(25, generator=torch.Generator().manual_seed(1)))
    drawn = [learner.act(belief) for _ in range(5)]
    assert all(a.shape == (() if batch is None else (batch,)) and a.dtype == torch.int64 for a in drawn)
    best = policy(belief.marginal("target").probs).argmax(-1)
    assert not greedy or all(torch.equal(a, best) for a in drawn)
    learner.reset(7)
    again = learner.act(belief)
    learner.reset(7)
    assert torch.equal(again, learner.act(belief))


def test_draws_follow_the_policy(lamp):
    policy = LogisticPolicy(3, 3, spread=2.0, seed=2)
    belief = lamp.start(20000)
    counts = torch.bincount(PolicyGradient(lamp, policy).act(belief), minlength=3) / 20000
    wanted = policy(belief.marginal("lit").probs[0].float()).softmax(-1).detach()
    assert float((counts - wanted).abs().max()) < 4 * 0.5 / math.sqrt(20000)


def test_learns_from_a_body(search):
    body = Simulated(VisualSearch(grid=Grid(5, 5)), batch=40)
    learner = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=6, body=body)
    assert learner.learn(2).sizes["update"] == 2 and learner.batch == 40
    with pytest.raises(ValueOutOfRange, match="2 episodes"):
        PolicyGradient(search, learner.policy, body=Simulated(VisualSearch(grid=Grid(5, 5))))


def test_a_known_timer_and_a_module_of_ones_own():
    engine = Exact(Caller())
    policy = torch.nn.Linear(2, 2)
    PolicyGradient(engine, policy, steps=5, batch=10).learn(1)
    with pytest.raises(Refusal, match="Linear cannot be kept"):
        PolicyGradient(engine, policy).save("nowhere")


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_no_number_is_noticed(bad, search):
    asked = []

    def reward(belief):
        asked.append(belief)
        return belief.marginal("target").probs.amax(-1) * (bad if len(asked) > 18 else 1.0)

    learner = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), reward, steps=6, batch=20)
    with pytest.warns(LearningWarning, match=r"stopped at update 4.*last good parameters"):
        history = learner.learn(10)
    assert history.sizes["update"] == 4
    assert bool(torch.isfinite(learner.policy.weights).all()) and float(learner.policy.weights.detach().norm()) > 0


@pytest.mark.parametrize("rate", [float("nan"), 0.0, -1.0])
def test_a_rate_that_goes_wrong_is_noticed(rate, search):
    policy = ConvolutionalPolicy(Grid(5, 5))
    learner = PolicyGradient(search, policy, steps=4, batch=20, rate=lambda n: 2.0 if n < 3 else rate)
    with pytest.warns(LearningWarning, match="rate of update 3"):
        assert learner.learn(10).sizes["update"] == 3
    assert bool(torch.isfinite(policy.weights).all())


def test_a_collapse_is_noticed_and_undone(search):
    policy = ConvolutionalPolicy(Grid(5, 5))
    learner = PolicyGradient(search, policy, steps=12, batch=200)
    before = float(learner.learn(25).worth[-5:].mean())
    with torch.no_grad():
        # Looks as far away as it can, whatever it sees, and no gradient says that anything else would be better.
        policy.weights.copy_(1e4 * (policy.distances > 5).float())
    with pytest.warns(LearningWarning, match="had been worth"):
        history = learner.learn(30)
    assert history.sizes["update"] < 30 and float(history.worth[-1]) < before - 2
    assert abs(float(learner.learn(3).worth.mean()) - before) < 1


def test_a_fall_and_its_cause_are_told():
    watch = Watch(ConvolutionalPolicy(Grid(2, 2)))
    told = [watch.trouble(worth, 0.1, 1.0) for worth in [-9.0, -8.0, *[-5.0] * 12, *[-5.2] * 12, *[-7.0] * 12]]
    assert not any(told[:26]) and "rate may be too large" in next(filter(None, told))
    assert "collapsed to few actions" in str(watch.trouble(-7.0, 0.1, 0.01))


def test_a_falling_rate(search):
    learner = PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), steps=2, batch=4, rate=Falling(8.0, 4, 0.1))
    assert learner.learn(6).rate.values.tolist() == pytest.approx([8, 6, 4, 2, 0.8, 0.8])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"steps": 0}, "1 step"),
        ({"batch": 1}, "2 episodes"),
        ({"beta": 1.5}, "trace"),
        ({"damping": 0.0}, "damping"),
        ({"rate": 0.0}, "rate"),
        ({"rate": math.nan}, "rate"),
        ({"baseline": "men"}, "mean"),
        ({"weights": "sumed"}, "summed"),
        ({"weights": [1.0]}, "weights"),
        ({"device": "quantum"}, "quantum"),
    ],
)
def test_bad_values(given, words, search):
    with pytest.raises(ValueOutOfRange, match=words):
        PolicyGradient(search, ConvolutionalPolicy(Grid(5, 5)), **given)


def test_rewards_that_cannot_be():
    walk = Exact(Lamp(cells=3))
    with pytest.raises(Refusal, match="asks for the action"):
        Fixated()(walk.start())
    from inference import Kalman

    kalman = Kalman(RandomWalk())
    with pytest.raises(Refusal, match="finitely many values"):
        PercentCorrect()(kalman.start())
    assert float(Fixated()(walk.start(), 2)) == pytest.approx(0.5)
    assert float(PercentCorrect()(walk.start(4))[3]) == pytest.approx(0.5)
    assert np.allclose(Information()(walk.start()), -float(walk.start().entropy()))
