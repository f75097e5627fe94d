"""The Gaussian algebra against conditioning of the whole joint, and over many steps in single precision."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from apmodels import ValueOutOfRange
from inference.worlds.gaussian import Gaussian, condition, move


def drawn(random, n, m):
    root = random.normal(size=(n, n))
    noise = random.normal(size=(m, m))
    parts = random.normal(size=n), root @ root.T, random.normal(size=(m, n)), random.normal(size=m), noise @ noise.T
    return [torch.as_tensor(part) for part in parts]


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(1, 4), st.integers(0, 3))
def test_conditioning_is_that_of_the_joint_gaussian(seed, n, m, lost):
    random = np.random.default_rng(seed)
    mean, covariance, matrix, offset, noise = drawn(random, n, m)
    noise = noise + 0.1 * torch.eye(m, dtype=torch.float64)
    value = torch.as_tensor(random.normal(size=m))
    value[random.permutation(m)[:lost]] = torch.nan
    after, score = condition(Gaussian(mean, covariance), matrix, offset, noise, value)
    seen = ~value.isnan().numpy()
    h, r, y = matrix.numpy()[seen], noise.numpy()[np.ix_(seen, seen)], value.numpy()[seen]
    if not seen.any():
        assert score == 0 and torch.equal(after.mean, mean)
        return
    spread = h @ covariance.numpy() @ h.T + r
    expected = h @ mean.numpy() + offset.numpy()[seen]
    cross = covariance.numpy() @ h.T
    np.testing.assert_allclose(after.mean, mean.numpy() + cross @ np.linalg.solve(spread, y - expected), atol=1e-8)
    remaining = covariance.numpy() - cross @ np.linalg.solve(spread, cross.T)
    np.testing.assert_allclose(after.covariance, remaining, atol=1e-8)
    assert float(score) == pytest.approx(stats.multivariate_normal.logpdf(y, expected, spread), abs=1e-8)


def test_covariances_stay_positive_definite_in_single_precision_over_many_steps():
    matrix = torch.tensor([[1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
    noise = 1e-10 * torch.eye(2, dtype=torch.float64)
    eye, sharp = torch.tensor([[1.0, 0.0]], dtype=torch.float64), torch.full((1, 1), 1e-8, dtype=torch.float64)
    belief = Gaussian(torch.zeros(2), 1e6 * torch.eye(2, dtype=torch.float64))
    nothing = torch.zeros(2), torch.zeros(1)
    for _ in range(2000):
        belief = move(belief, matrix, nothing[0], noise)
        belief, _ = condition(belief, eye, nothing[1], sharp, torch.zeros(1))
        assert torch.linalg.eigvalsh(belief.covariance).min() > 0
    assert belief.mean.dtype == torch.float32


def test_what_is_known_for_certain_moves_and_refuses_to_be_seen_without_noise():
    certain = Gaussian(torch.ones(1), torch.zeros(1, 1, dtype=torch.float64))
    one, none = torch.eye(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    assert torch.equal(move(certain, 2 * one, torch.ones(1), one).mean, torch.tensor([3.0]))
    with pytest.raises(ValueOutOfRange, match="without noise"):
        condition(certain, one, torch.zeros(1), none, torch.ones(1))
