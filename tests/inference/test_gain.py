"""Expected information: exact for finite observations, close for Gaussian ones."""

import numpy as np
import pytest
import torch

from apmodels import Calibrated, Grid, ValueOutOfRange, VisualSearch
from apmodels.simulation import as_given
from inference import Exact
from tests.inference.oracle import Oracle
from tests.models import Caller, Counter, Coupled, Dial, Door, Drift, Lamp, Seasons, Twins


def history(model, engine, steps=2, seed=0):
    record = model.simulate(steps + 1, seed=seed)
    actions = [{n: record[n][t] for n in model.action_names} for t in range(steps)]
    seen = [{n: record[n][t] for n in model.observation_names} for t in range(steps)]
    belief = engine.start()
    for act, sense in zip(actions, seen, strict=True):
        belief = engine.update(belief, as_given(act), as_given(sense))
    return belief, actions, seen


@pytest.mark.parametrize("model", [Door(), Coupled(), Counter(), Caller(), Lamp()], ids=lambda m: type(m).__name__)
def test_finite_gains_are_exact(model):
    engine, oracle = Exact(model, torch.float64), Oracle(model)
    for steps in (0, 2):
        belief, actions, seen = history(model, engine, steps)
        gains = engine.gain(belief)
        choices = range(model.space(model.action_names[0]).size) if model.action_names else [None]
        assert gains.shape == (len(choices),)
        for found, choice in zip(gains, choices, strict=True):
            act = {name: choice for name in model.action_names}
            expected = oracle.gain(list(model.structure.interest), actions, seen, act)
            assert float(found) == pytest.approx(expected, abs=1e-6)


def test_the_gain_about_a_function_of_variables_under_several_actions():
    model = Twins()
    engine = Exact(model, torch.float64)
    belief, actions, seen = history(model, engine)
    pairs = {"left": torch.tensor([0, 1, 1]), "right": torch.tensor([2, 0, 1])}
    for i, found in enumerate(engine.gain(belief, pairs)):
        act = {name: value[i] for name, value in pairs.items()}
        assert float(found) == pytest.approx(Oracle(model).gain(["interest"], actions, seen, act), abs=1e-6)


def gaussian_gain(prior, locations, scale):
    """I(hypothesis; one Gaussian number), by integration on a fine grid."""
    y = np.linspace(locations.min() - 10 * scale, locations.max() + 10 * scale, 20_001)
    density = np.exp(-0.5 * ((y[:, None] - locations) / scale) ** 2) / scale / np.sqrt(2 * np.pi)
    joint = density * prior
    marginal = joint.sum(1, keepdims=True)
    ratio = np.divide(density, marginal, where=joint > 1e-300, out=np.ones_like(joint))
    return float(np.trapezoid((joint * np.log(ratio)).sum(1), y))


def test_the_gain_of_one_gaussian_number_is_its_integral():
    engine = Exact(Dial(), torch.float64)
    belief = engine.update(engine.start(), 0.3, 0.4)
    prior = belief.marginal("side").probs.numpy()
    turns = torch.tensor([-1.0, 0.0, 0.2, 0.7])
    gains = engine.gain(belief, turns, samples=20_000)
    expected = [gaussian_gain(prior, np.array([-t, t]), 0.5) if t else 0.0 for t in turns.numpy()]
    assert gains.numpy() == pytest.approx(expected, abs=0.01)
    assert float(gains[1]) == pytest.approx(0.0, abs=1e-9)


def test_the_gain_of_a_glimpse_is_the_mean_of_many(samples=40_000):
    """An estimate of one's own from many drawn worlds and glimpses; both have errors of about 0.004 nats."""
    model = VisualSearch(grid=Grid(3, 4), acuity=Calibrated(width=2.0))
    engine = Exact(model, torch.float64)
    belief = engine.update(engine.start(), 5, torch.linspace(-1, 2, 12))
    prior = belief.marginal("target").probs.numpy()
    found = engine.gain(belief, samples=4000).numpy()
    random = np.random.default_rng(0)
    entropy = -(prior * np.log(prior)).sum()
    where = np.array([(c // 4, c % 4) for c in range(12)])
    for fixation in (0, 5, 11):
        signal = 1.9 * np.exp(-((np.linalg.norm(where - where[fixation], axis=1) / 2.0) ** 3))
        target = random.choice(12, samples, p=prior)
        glimpse = random.normal(signal[target, None] * np.eye(12)[target])
        logs = np.log(prior) + glimpse * signal - signal**2 / 2
        logs -= np.logaddexp.reduce(logs, axis=1, keepdims=True)
        after = -(np.exp(logs) * logs).sum(1)
        error = after.std() * (1 / samples + 1 / 4000) ** 0.5
        assert found[fixation] == pytest.approx(entropy - after.mean(), abs=5 * error)


def test_a_gain_is_never_much_below_zero():
    for model in (VisualSearch(grid=Grid(3, 3)), Dial(), Drift(), Seasons()):
        engine = Exact(model, torch.float64)
        belief, _, _ = history(model, engine)
        candidates = torch.linspace(-1, 1, 5) if isinstance(model, Dial) else None
        assert engine.gain(belief, candidates, samples=500).min() > -0.05


def test_the_same_seed_imagines_the_same():
    engine = Exact(VisualSearch(grid=Grid(3, 3)))
    belief = engine.start()
    state = torch.get_rng_state()
    first, again, other = (engine.gain(belief, samples=8, seed=s) for s in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(engine.gain(belief, [4, 0], samples=8, seed=1), first[[4, 0]])
    assert torch.equal(torch.get_rng_state(), state)


def test_common_random_numbers_make_differences_surer_than_gains():
    """Two fixations that are nearly the same differ by much less than either gain wavers."""
    engine = Exact(Dial(), torch.float64)
    pairs = torch.stack([engine.gain(engine.start(), [0.50, 0.52], samples=16, seed=s) for s in range(60)])
    assert (pairs[:, 1] - pairs[:, 0]).std() < 0.3 * pairs[:, 0].std()


def test_gains_of_a_batch_are_those_of_its_members():
    model = Coupled()
    engine = Exact(model, torch.float64)
    record = model.simulate(2, batch=3, seed=2)
    batch = engine.filter(record["move"], record["sound"], batch=3)[-1]
    gains = engine.gain(batch)
    assert gains.shape == (3, 3)
    for i in range(3):
        single = engine.filter(record["move"][i], record["sound"][i])[-1]
        assert torch.allclose(gains[i], engine.gain(single), atol=1e-9)
    assert torch.allclose(engine.gain(batch, [2, 0]), gains[:, [2, 0]])


def test_a_gain_harms_no_belief():
    engine = Exact(Door(), torch.float64)
    belief = engine.start()
    kept = belief.log_probs.clone()
    engine.gain(belief)
    assert torch.equal(belief.log_probs, kept) and belief.time == 0


@pytest.mark.parametrize(("model", "actions"), [(Dial(), None), (Dial(), [2.0]), (Lamp(), [0, 4]), (Twins(), None)])
def test_bad_candidates_are_out_of_range(model, actions):
    engine = Exact(model)
    with pytest.raises(ValueOutOfRange):
        engine.gain(engine.start(), actions)
