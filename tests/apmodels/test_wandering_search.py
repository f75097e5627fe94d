"""A target that does not keep still, against Bayes' rule written out by hand."""

import numpy as np
import pytest
import torch

from apmodels import Calibrated, Camera, Exponential, Grid, Human, HumanContrast, ValueOutOfRange, WanderingSearch
from inference import Exact


def test_steps_go_to_neighbours_and_stay_inside():
    chances = WanderingSearch(grid=Grid(3, 4), restless=0.4).steps()
    assert torch.allclose(chances.sum(1), torch.ones(12)) and torch.equal(chances, chances.T)
    # A corner has two neighbours, an edge three, the middle four.
    assert chances.diagonal()[[0, 1, 5]].tolist() == pytest.approx([0.8, 0.7, 0.6])
    assert chances[5, [1, 4, 6, 9]].tolist() == pytest.approx([0.1] * 4) and chances[0, 5] == 0


def test_its_belief_is_bayes_rule():
    model = WanderingSearch(grid=Grid(3, 3), restless=0.4)
    engine, random = Exact(model, torch.float64), np.random.default_rng(0)
    belief, chances = engine.start(), np.full(9, 1 / 9)
    cells = torch.arange(9)
    for _ in range(5):
        look, glimpse = int(random.integers(9)), random.normal(size=9)
        belief = engine.update(belief, look, torch.tensor(glimpse))
        signal = model.acuity(model.grid.distance(cells, torch.tensor(look))).double().numpy()
        chances = chances @ model.steps().double().numpy() * np.exp(signal * (glimpse - signal / 2))
        chances /= chances.sum()
    assert belief.marginal("target").probs.numpy() == pytest.approx(chances, abs=1e-6)


def test_where_it_began_is_forgotten_and_costs_nothing():
    engine = Exact(WanderingSearch(grid=Grid(3, 3)))
    belief = engine.start(2)
    assert belief.log_probs.shape == (2, 9) and torch.allclose(belief.log_probs.exp(), torch.full((2, 9), 1 / 9))
    with pytest.raises(ValueOutOfRange, match="start only says how a state begins"):
        belief.marginal("start")


def test_a_target_that_keeps_still_is_still():
    engine = Exact(WanderingSearch(grid=Grid(2, 2), restless=0.0), torch.float64)
    belief = engine.update(engine.start(), 0, torch.tensor([3.0, 0, 0, 0]))
    for _ in range(3):
        after = engine.update(belief, 3, torch.full((4,), torch.nan))
        assert torch.allclose(after.marginal("target").probs, belief.marginal("target").probs)


def test_acuities():
    e = torch.tensor([0.0, 1.5, 3.0, 3.1, 7.9])
    for acuity in (Calibrated(), Camera(), Exponential(), Human(), HumanContrast()):
        signal = acuity(e)
        assert (signal.diff() <= 0).all() and (signal >= 0).all() and torch.isfinite(signal).all()
    assert Camera(2.0, 3.0)(e).tolist() == [2, 2, 2, 0, 0]
    assert Exponential(3.0, 1.5)(e)[1] == pytest.approx(3 / np.e)
    assert Human()(e)[-1] == pytest.approx(4.09 / np.e)
    # Twice as many cells a degree: what was seen at 3 is seen at 6.
    for acuity in (Human, HumanContrast):
        assert acuity(cells_per_degree=2.0)(torch.tensor(6.0)) == pytest.approx(float(acuity()(torch.tensor(3.0))))
    # At the threshold of a Weibull 1 - exp(-1) / 2 = 81.6 % of two-way choices are right, which is d' = 1.27.
    at = HumanContrast(contrast=0.0598)(torch.tensor(0.0))
    assert at == pytest.approx(1.2736, abs=1e-3)
    assert torch.isfinite(HumanContrast(contrast=1.0)(torch.tensor(0.0)))
