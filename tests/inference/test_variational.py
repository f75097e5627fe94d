"""SVI on the exported program, NUTS on the same one, both against exact engines."""

import math

import pyro
import pytest
import torch
from pyro.infer import MCMC, NUTS, Predictive

from apmodels import Contingency, ValueOutOfRange
from apmodels.simulation import as_given
from inference import DepletionWarning, Exact, Kalman, Refusal, Variational
from tests.models import Coupled, Drift, LearningToLook, RandomWalk, Tracking, Twins

ACTIONS = torch.tensor([1, 0, 0, 0, 0, 0, 1, 0])
SOUNDS = torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0, math.nan, 1.0, 1.0])


def last(engine, actions, observations, batch=None):
    return list(engine.filter(actions, observations, batch))[-1]


@pytest.fixture(scope="module")
def answered():
    """An exact belief and a variational one, of the same record."""
    model = Contingency(presence=0.4)
    return [last(kind(model), ACTIONS, SOUNDS) for kind in (Exact, Variational)]


def test_a_binary_marginal_is_within_two_hundredths(answered):
    exact, found = answered
    assert abs(float(exact.marginal("responsive").probs[1] - found.marginal("responsive").probs[1])) < 0.02
    assert abs(float(exact.log_evidence - found.log_evidence)) < 0.05
    assert abs(float(exact.entropy() - found.entropy())) < 0.05


def test_gaussian_models_are_met_too():
    model = Tracking()
    record = model.simulate(3, seed=2)
    exact, found = (last(kind(model), record["push"], record["seen"]) for kind in (Kalman, Variational))
    spread = exact.marginal("place").stddev
    assert ((exact.marginal("place").mean - found.marginal("place").mean).abs() < 0.1 * spread).all()
    assert abs(float(exact.log_evidence - found.log_evidence)) < 0.1


def test_a_batch_is_fitted_in_one_go():
    model = RandomWalk()
    record = model.simulate(3, batch=4, seed=1)
    exact, found = (last(kind(model), None, record["reading"], 4) for kind in (Kalman, Variational))
    assert found.marginal("position").mean.shape == (4,)
    assert float((exact.marginal("position").mean - found.marginal("position").mean).abs().max()) < 0.1
    assert float((exact.log_evidence - found.log_evidence).abs().max()) < 0.1


def test_a_guide_learned_once_serves_every_record():
    model = Contingency(presence=0.4)
    engine = Variational(model)
    losses = engine.learn(steps=8, rounds=80, records=128)
    assert sum(losses[-10:]) < sum(losses[:10])
    for seed in range(3):
        record = model.simulate(8, seed=seed)
        pair = record["vocalize"], record["sound"]
        exact, found = last(Exact(model), *pair), last(engine, *pair)
        assert "parameters" not in found.kept
        assert abs(float(exact.marginal("responsive").probs[1] - found.marginal("responsive").probs[1])) < 0.03
        assert abs(float(exact.log_evidence - found.log_evidence)) < 0.1
    with pytest.raises(ValueOutOfRange, match="nothing to learn"):
        Variational(Drift()).learn()


def test_all_that_is_finite_is_exact():
    model = Drift()
    jumps = torch.tensor([0.5, -1.0, 0.2])
    exact, found = (last(kind(model), None, jumps) for kind in (Exact, Variational))
    assert torch.allclose(exact.marginal("place").probs, found.marginal("place").probs, atol=1e-5)


def test_gain_and_forecast_come_from_the_posterior(answered):
    exact, found = answered
    assert torch.allclose(exact.engine.gain(exact), found.engine.gain(found), atol=0.02)
    chances = [float(belief.engine.forecast(belief, 1).mean) for belief in (exact, found)]
    assert chances[0] == pytest.approx(chances[1], abs=0.05)


def test_the_same_seed_fits_the_same_posterior_and_leaves_the_users_parameters():
    pyro.clear_param_store()
    pyro.param("mine", torch.tensor(3.0))
    beliefs = [last(Variational(RandomWalk(), iterations=20, draws=500), None, torch.tensor([0.3])) for _ in range(2)]
    assert torch.equal(beliefs[0].marginal("position").mean, beliefs[1].marginal("position").mean)
    assert list(pyro.get_param_store().keys()) == ["mine"]
    pyro.clear_param_store()


def test_a_guide_that_does_not_fit_is_told():
    engine = Variational(Tracking(), guide="diagonal", iterations=1, draws=50)
    belief = last(engine, torch.zeros(6, 2), torch.full((6, 3), 9.0))
    with pytest.warns(DepletionWarning, match="covers the posterior"):
        belief.marginal("place")


def test_what_has_no_slope_is_refused_with_the_variable():
    with pytest.raises(Refusal, match="scene changes in steps with motion"):
        Variational(LearningToLook())
    with pytest.raises(ValueOutOfRange, match="no guide normal"):
        Variational(RandomWalk(), guide="normal")


@pytest.mark.slow
def test_nuts_runs_on_the_same_program_and_agrees():
    model = Contingency(presence=0.4)
    exact = last(Exact(model), ACTIONS, SOUNDS)
    pyro.set_rng_seed(0)
    program = model.pyro(actions=ACTIONS, observations=SOUNDS)
    kernel = NUTS(program, max_plate_nesting=0)
    chain = MCMC(kernel, num_samples=4000, warmup_steps=500, disable_progbar=True)
    chain.run()
    rates = chain.get_samples()["rates"]
    assert float((rates.mean(0) - exact.marginal("rates").mean).abs().max()) < 0.02
    # P(responsive) is the mean, over draws of the rates, of what they make of it.
    chances = []
    for value in (0.0, 1.0):
        given = {"responsive": torch.tensor(value)}
        scores = [_score(pyro.condition(program, given | {"rates": draw})) for draw in rates[::2]]
        chances.append(torch.stack(scores))
    share = torch.stack(chances).softmax(0)[1].mean()
    assert float(share) == pytest.approx(float(exact.marginal("responsive").probs[1]), abs=0.02)


def _score(program):
    return pyro.poutine.trace(program).get_trace().log_prob_sum()


def test_the_program_has_the_density_of_the_model():
    for model in (Coupled(), Twins(), Tracking()):
        record = model.simulate(3, seed=4)
        actions = as_given({name: record[name] for name in model.action_names})
        seen = as_given({name: record[name] for name in model.observation_names})
        sites = {name: record[name] for name in model.declaration.names["static"]}
        for name in model.declaration.names["state"]:
            sites |= {f"{name}_{t + 1}": record[name][t] for t in range(3)}
        program = pyro.condition(model.pyro(actions=actions, observations=seen, enumerate_finite=False), sites)
        assert float(_score(program)) == pytest.approx(float(model.log_prob(record)), abs=1e-4)


def test_the_program_draws_what_is_not_given():
    sites = Predictive(Coupled().pyro(steps=2, actions=torch.tensor([0, 2])), num_samples=7)()
    assert set(sites) == {"kind", "near_1", "far_1", "sound_1", "near_2", "far_2", "sound_2"}
    assert sites["near_2"].shape == (7,)
    with pytest.raises(ValueOutOfRange, match="number of steps"):
        RandomWalk().pyro()
