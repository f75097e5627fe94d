"""The action after which the best guess is right most often, against expectations made apart."""

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from apmodels import Calibrated, Contingency, Grid, ValueOutOfRange, VisualSearch
from controllers import PercentCorrect
from inference import Exact, Particles, Refusal
from inference.tables.best_guess import best
from tests.models import Coupled, Dial, Door, Tracking


def signals(rows, columns, acuity):
    """d'(place of the target, fixation), with numpy alone."""
    where = np.array([(r, c) for r in range(rows) for c in range(columns)], dtype=float)
    apart = np.linalg.norm(where[:, None] - where[None], axis=-1)
    return acuity.peak * np.exp(-((apart / acuity.width) ** acuity.steepness))


def imagined(prior, signal, samples, random):
    """E[max B] by drawing targets and glimpses, and its standard error."""
    target = random.choice(len(prior), samples, p=prior)
    glimpse = random.normal(signal[target, None] * np.eye(len(prior))[target])
    weights = prior * np.exp(glimpse * signal - signal**2 / 2)
    found = weights.max(1) / weights.sum(1)
    return found.mean(), found.std() / samples**0.5


@pytest.mark.parametrize("sharp", [0.0, 1.0, 4.0])
def test_how_often_the_best_guess_is_right_is_what_many_draws_say(sharp):
    acuity = Calibrated(width=1.5)
    engine = Exact(VisualSearch(grid=Grid(3, 3), acuity=acuity))
    belief = engine.update(engine.start(), 4, sharp * torch.linspace(-1, 1, 9).roll(2))
    prior = belief.marginal("target").probs.double().numpy()
    found = engine.best_guess(belief, samples=64)
    random = np.random.default_rng(0)
    for fixation, signal in enumerate(signals(3, 3, acuity).T):
        expected, error = imagined(prior / prior.sum(), signal, 100_000, random)
        assert float(found[fixation]) == pytest.approx(expected, abs=4 * error + 0.002 * expected)


def test_the_integral_errs_by_less_than_a_percent_and_as_one_over_the_square_of_its_points():
    engine = Exact(VisualSearch(grid=Grid(7, 7)), torch.float64).prepare()
    belief = engine.start()
    true = engine.best_guess(belief, samples=2048)
    errors = {n: float((engine.best_guess(belief, samples=n) / true - 1).abs().max()) for n in (32, 64, 128)}
    assert errors[32] < 0.01 and errors[64] < 0.002 and errors[128] < 0.0005
    single = Exact(VisualSearch(grid=Grid(7, 7)))
    assert float((single.best_guess(single.start(), samples=64) / true - 1).abs().max()) < 0.002


def test_imagining_glimpses_comes_to_the_same():
    """The general way, which any function of the belief may take."""
    engine = Exact(VisualSearch(grid=Grid(3, 4)), torch.float64)
    belief = engine.update(engine.start(), 5, torch.linspace(-1, 2, 12))
    found = torch.stack([engine.expect(belief, best, samples=2000, seed=s) for s in range(4)])
    assert found.mean(0).numpy() == pytest.approx(engine.best_guess(belief, samples=500).numpy(), rel=0.01)


@pytest.mark.parametrize("turn", [-0.6, 0.05, 0.3, 1.0])
def test_two_hypotheses_of_one_number_are_an_error_function(turn):
    """Means -turn and turn, spread 0.5: the best guess changes where the log odds cross zero."""
    engine = Exact(Dial(), torch.float64)
    belief = engine.update(engine.start(), 0.2, 0.3)
    right = float(belief.marginal("side").probs[1])
    found = float(engine.best_guess(belief, torch.tensor([turn]), samples=20_000)[0])

    def most(y):
        densities = stats.norm.pdf(y, [-turn, turn], 0.5)
        return max((1 - right) * densities[0], right * densities[1])

    expected = integrate.quad(most, -6, 6, points=[-turn, turn], limit=200)[0]
    assert found == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize("model", [Door(), Coupled()], ids=lambda m: type(m).__name__)
def test_where_outcomes_are_few_the_expectation_is_a_sum(model):
    engine = Exact(model, torch.float64)
    belief = engine.start()
    names, (action,) = engine.structure.interest, model.action_names
    for value, found in zip(model.space(action).values(), engine.best_guess(belief), strict=True):
        total = 0.0
        for outcome in range(int(engine.forecast(belief, value).component_distribution.probs.shape[-1])):
            try:
                after = engine.update(belief, value, torch.tensor(outcome))
            except ValueOutOfRange:
                continue
            joint = engine.projections.marginal(after.log_probs, names)[1].exp()
            total += float(after.log_evidence.exp() * joint.max())
        assert float(found) == pytest.approx(total, abs=1e-9)


def test_engines_agree_and_gain_is_a_special_case_of_what_they_expect():
    model = Contingency(presence=0.3)
    engine = Exact(model)
    belief = engine.start(3)
    before = belief.entropy()
    found = engine.expect(belief, lambda logs: (logs.exp() * logs).sum(-1))
    assert torch.allclose(found + before[:, None], engine.gain(belief), atol=1e-5)
    search = VisualSearch(grid=Grid(2, 2))
    exact, cloud = Exact(search), Particles(search, particles=400)
    assert cloud.best_guess(cloud.start(), samples=200).numpy() == pytest.approx(
        exact.best_guess(exact.start()).numpy(), abs=0.06
    )


def test_it_looks_where_that_is_largest_for_each_of_a_batch():
    engine = Exact(VisualSearch(grid=Grid(5, 5)))
    glimpses = torch.randn(6, 25, generator=torch.Generator().manual_seed(0))
    batch = engine.update(engine.start(6), 12, glimpses)
    looks = PercentCorrect(engine).act(batch)
    assert torch.equal(looks, engine.best_guess(batch).argmax(1))
    for look, glimpse in zip(looks, glimpses, strict=True):
        assert PercentCorrect(engine).act(engine.update(engine.start(), 12, glimpse)) == look
    some = PercentCorrect(engine, candidates=[3, 20]).act(batch)
    assert bool(((some == 3) | (some == 20)).all())


def test_seeds_reproduce_what_is_imagined():
    engine = Exact(Dial())
    belief, turns = engine.start(), torch.linspace(-1, 1, 9)
    first, again = (PercentCorrect(engine, turns, samples=4, seed=3) for _ in range(2))
    assert [float(first.act(belief)) for _ in range(4)] == [float(again.act(belief)) for _ in range(4)]
    assert torch.equal(engine.best_guess(belief, turns, 8, 1), engine.best_guess(belief, turns, 8, 1))


def test_what_cannot_be_done_is_refused():
    with pytest.raises(Refusal, match="no finite list of values"):
        PercentCorrect(Particles(Tracking()), [[0.5, 0.5]])
    with pytest.raises(ValueOutOfRange, match="imagines 1 observation or more, not 0"):
        PercentCorrect(Exact(Door()), samples=0)
    with pytest.raises(Refusal, match="continuum; give PercentCorrect"):
        PercentCorrect(Exact(Dial()))
