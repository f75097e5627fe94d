"""The entropy-limit rule, against convolutions and divergences made with numpy."""

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from apmodels import Calibrated, Contingency, CountModel, DetectorSearch, Grid, VisualSearch
from controllers import EntropyLimit
from inference import Exact, Particles, Refusal
from tests.models import Coupled, Dial


def kernel(rows, columns, acuity):
    """d'² by offset, (2 rows - 1, 2 columns - 1)."""
    apart = np.hypot(*np.mgrid[1 - rows : rows, 1 - columns : columns])
    return (acuity.peak * np.exp(-((apart / acuity.width) ** acuity.steepness))) ** 2


@pytest.mark.parametrize("shape", [(3, 3), (4, 7), (11, 11)])
def test_it_is_the_belief_convolved_with_the_square_of_d(shape):
    acuity = Calibrated(width=2.5)
    engine = Exact(VisualSearch(grid=Grid(*shape), acuity=acuity), torch.float64)
    glimpses = torch.randn(3, shape[0] * shape[1], generator=torch.Generator().manual_seed(1))
    belief = engine.update(engine.start(3), 4, glimpses)
    found = engine.discriminability(belief)
    looks = EntropyLimit(engine).act(belief)
    for row in range(3):
        probs = belief.marginal("target").probs[row].numpy().reshape(shape)
        expected = convolve2d(probs, kernel(*shape, acuity))
        expected = expected[shape[0] - 1 : 2 * shape[0] - 1, shape[1] - 1 : 2 * shape[1] - 1].ravel()
        assert found[row].numpy() == pytest.approx(expected, abs=1e-9)
        assert looks[row] == expected.argmax()


def test_of_counts_it_is_twice_the_divergence_from_the_background():
    random = np.random.default_rng(0)
    here, there = (random.dirichlet(np.ones(4), (3, 3)) for _ in range(2))
    model = DetectorSearch(grid=Grid(4, 5), counts=CountModel(torch.tensor(here), torch.tensor(there)))
    engine = Exact(model, torch.float64)
    belief = engine.update(engine.start(), 7, torch.tensor([2.0] * 3 + [0.0] * 17))
    probs = belief.marginal("target").probs.numpy().reshape(4, 5)
    found = engine.discriminability(belief).numpy().reshape(4, 5)
    divergence = (here * np.log(here / there)).sum(-1)
    for look in np.ndindex(4, 5):
        expected = sum(
            probs[cell] * 2 * divergence[min(abs(cell[0] - look[0]), 2), min(abs(cell[1] - look[1]), 2)]
            for cell in np.ndindex(4, 5)
        )
        assert found[look] == pytest.approx(expected, abs=1e-6)


def test_half_of_it_bounds_the_expected_information():
    for model in (VisualSearch(grid=Grid(4, 4)), DetectorSearch(grid=Grid(5, 5))):
        engine = Exact(model, torch.float64)
        belief = engine.start()
        assert bool((engine.gain(belief, samples=400) <= 0.5 * engine.discriminability(belief) + 0.02).all())


def test_candidates_and_batches():
    engine = Exact(VisualSearch(grid=Grid(5, 5)))
    assert EntropyLimit(engine).act(engine.start()) == 12
    assert EntropyLimit(engine, candidates=[0, 7, 24]).act(engine.start(2)).tolist() == [7, 7]


@pytest.mark.parametrize(
    ("engine", "candidates", "words"),
    [
        (Exact(Dial()), [0.5], "has no discriminability: it needs elements"),
        (Exact(Coupled()), None, "has no discriminability"),
        (Exact(Contingency()), None, "has no table of laws to read d' from"),
        (Particles(VisualSearch(grid=Grid(3, 3))), None, "has no table of laws"),
        (Exact(Dial()), None, "continuum; give EntropyLimit the candidates"),
    ],
)
def test_it_refuses_where_there_is_no_d(engine, candidates, words):
    with pytest.raises(Refusal, match=words):
        EntropyLimit(engine, candidates)
