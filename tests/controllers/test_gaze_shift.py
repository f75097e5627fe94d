"""Gaze shifts: against the printed table, gradients, sampling, and another solver between limits."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from apmodels import ValueOutOfRange
from controllers.gaze_shift import expected_error, gaze_shift


def head(motors, directions=2, seed=0):
    draw = torch.Generator().manual_seed(seed)
    a = torch.randn(directions, motors, generator=draw, dtype=torch.float64)
    n = torch.rand(directions, motors, generator=draw, dtype=torch.float64) * 0.4
    return a, n, torch.randn(directions, generator=draw, dtype=torch.float64)


def test_one_eye_undershoots_as_printed():
    command = gaze_shift(torch.ones(1, 1), torch.full((1, 1), 0.145), torch.ones(1))
    assert 1 - float(command[0]) == pytest.approx(1 - 1 / (0.145**2 + 1))


@settings(deadline=None, max_examples=40)
@given(motors=st.integers(1, 6), directions=st.integers(1, 3), seed=st.integers(0, 1000))
def test_no_other_command_is_better(motors, directions, seed):
    a, n, m = head(motors, directions, seed)
    command = gaze_shift(a, n, m).requires_grad_()
    (slope,) = torch.autograd.grad(expected_error(a, n, m, command), command)
    assert slope.abs().max() < 1e-8


def test_the_expected_error_is_that_of_draws():
    a, n, m = head(4)
    u = torch.tensor([0.5, -1.0, 2.0, 0.3], dtype=torch.float64)
    noise = torch.randn(400_000, 2, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    moved = ((a + n * noise) * u).sum(-1)
    drawn = ((moved - m) ** 2).sum(-1)
    assert float(expected_error(a, n, m, u)) == pytest.approx(float(drawn.mean()), abs=4 * float(drawn.std()) / 632)


@settings(deadline=None, max_examples=40)
@given(motors=st.integers(1, 6), seed=st.integers(0, 1000), limit=st.floats(0.01, 2.0))
def test_between_limits_it_is_the_best_there(motors, seed, limit):
    a, n, m = head(motors, 2, seed)
    found = gaze_shift(a, n, m, -limit, limit / 2)
    assert (found >= -limit).all() and (found <= limit / 2).all()
    stacked = np.concatenate([a.numpy(), np.diag((n * n).sum(0).sqrt().numpy())])
    peer = lsq_linear(stacked, np.concatenate([m.numpy(), np.zeros(motors)]), (-limit, limit / 2), tol=1e-12).x
    ours, theirs = (float(expected_error(a, n, m, torch.as_tensor(u))) for u in (found, peer))
    assert ours <= theirs + 1e-9


def test_without_noise_it_is_the_pseudo_inverse_also_where_motors_replace_each_other():
    a = torch.tensor([[2.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    found = gaze_shift(a, torch.zeros(2, 3), torch.tensor([4.0, 1.0]))
    assert found.tolist() == pytest.approx([1.0, 1.0, 0.0])
    bounded = gaze_shift(a, torch.zeros(2, 3), torch.tensor([4.0, 1.0]), high=torch.tensor([0.5, 3.0, 1.0]))
    assert bounded.tolist() == pytest.approx([0.5, 1.5, 0.0])


def test_a_motor_that_cannot_be_relied_upon_is_not_used():
    a, n, m = head(3)
    n[1, 2] = torch.inf
    found = gaze_shift(a, n, m)
    torch.testing.assert_close(found, torch.nn.functional.pad(gaze_shift(a[:, :2], n[:, :2], m), (0, 1)))


def test_batches_are_their_members():
    heads = [head(3, seed=s) for s in range(5)]
    a, n, m = (torch.stack(parts) for parts in zip(*heads, strict=True))
    for low in (None, -0.3):
        together = gaze_shift(a, n, m, low)
        each = torch.stack([gaze_shift(*one, low) for one in heads])
        torch.testing.assert_close(together, each)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((torch.ones(2), torch.ones(2), torch.ones(2)), "directions, motors"),
        ((torch.ones(2, 3), torch.ones(2, 2), torch.ones(2)), "directions, motors"),
        ((torch.ones(2, 3), torch.ones(2, 3), torch.ones(3)), "directions, motors"),
        ((torch.ones(1, 1), torch.ones(1, 1), torch.tensor([torch.nan])), "finite"),
        ((torch.ones(1, 1), torch.ones(1, 1), torch.ones(1), 1.0, 0.0), "least command"),
    ],
)
def test_bad_shifts(given, words):
    with pytest.raises(ValueOutOfRange, match=words):
        gaze_shift(*given)
