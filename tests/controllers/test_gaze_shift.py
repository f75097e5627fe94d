"""Gaze shifts: against the printed table, gradients, sampling, and another solver between limits."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.distributions import Normal
from scipy.optimize import lsq_linear

from apmodels import (
    Box,
    Finite,
    LearningToLook,
    Model,
    MotorDynamics,
    MotorNoise,
    NoisyMotors,
    ValueOutOfRange,
    action,
    observation,
    static,
)
from apmodels.transforms import zeros
from controllers import GazeShift
from controllers.gaze_shift import expected_error, gaze_shift
from inference import Kalman, RaoBlackwell, Refusal


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


# The controller.

TINY = {"view": (3, 4), "field": (9, 12)}


def known(batch=None, noise=0.0, motors=3):
    """What a head knows of its motors after some movements."""
    engine = Kalman(NoisyMotors(motors=motors, gain=50.0, wear=1.0, straying=noise))
    random, belief = torch.Generator().manual_seed(1), engine.start(batch)
    shape = () if batch is None else (batch,)
    gains = 40 * torch.randn(*shape, 2, motors, generator=random)
    for _ in range(6):
        command = 2 * torch.rand(*shape, motors, generator=random) - 1
        moved = (gains @ command[..., None])[..., 0] + torch.randn(*shape, 2, generator=random)
        belief = engine.update(belief, command, moved)
    return engine, belief


def test_what_is_not_known_of_a_motor_counts_as_its_noise():
    engine, belief = known()
    law, goal = belief.marginal("actuation"), torch.tensor([20.0, -12.0])
    command = GazeShift(engine, goal=goal).act(belief)
    expected = gaze_shift(law.mean, law.variance.double().sqrt(), goal, -1.0, 1.0)
    torch.testing.assert_close(command, expected.float())
    assert command.shape == (3,) and command.dtype == torch.float32
    # Its expected error is that of draws of what is believed, and no other command's is less.
    draws = law.sample((100_000,))
    error = lambda u: float((((draws @ u) - goal) ** 2).sum(-1).mean())  # noqa: E731
    # Entries depend on each other a little, of which it does not know.
    assert all(error(command) < error(command + 0.1 * step) for step in (*torch.eye(3), *-torch.eye(3)))


def test_aim_says_where_to_and_by_default_it_stays():
    engine, belief = known()
    controller = GazeShift(engine)
    assert controller.act(belief).tolist() == [0, 0, 0]
    controller.aim([10.0, 5.0])
    there = controller.act(belief)
    moved = belief.marginal("actuation").mean @ there
    assert moved.tolist() == pytest.approx([10.0, 5.0], abs=1.0) and there.abs().max() > 0.05
    controller.aim(torch.tensor([-10.0, -5.0]))
    torch.testing.assert_close(controller.act(belief), -there)


def test_no_motor_is_told_more_than_its_space_allows():
    engine, belief = known()
    command = GazeShift(engine, goal=torch.tensor([1000.0, -3000.0])).act(belief)
    assert command.abs().max() == 1 and (command.abs() <= 1).all()
    # And it may be carried out.
    engine.update(belief, command, torch.zeros(2))


def test_every_belief_of_a_batch_has_a_command_of_its_own():
    engine, belief = known(batch=4)
    law, goals = belief.marginal("actuation"), 30 * torch.randn(4, 2, generator=torch.Generator().manual_seed(0))
    for goal in (goals, goals[0]):
        command = GazeShift(engine, goal=goal).act(belief)
        assert command.shape == (4, 3)
        for i, own in enumerate(goals if goal.dim() == 2 else goal.expand(4, 2)):
            each = gaze_shift(law.mean[i], law.variance[i].double().sqrt(), own, -1.0, 1.0)
            torch.testing.assert_close(command[i], each.float(), atol=1e-5, rtol=1e-4)


def test_noise_that_is_told_makes_a_motor_do_less():
    engine, belief = known()
    law, goal = belief.marginal("actuation"), torch.tensor([10.0, 5.0])
    noise = torch.tensor([[30.0, 1.0, 0.0], [20.0, 2.0, 0.0]])
    plain, wary = (GazeShift(engine, noise=n, goal=goal).act(belief) for n in (None, noise))
    assert wary[0].abs() < plain[0].abs()
    spread = (noise.double() ** 2 + law.variance.double()).sqrt()
    torch.testing.assert_close(wary, gaze_shift(law.mean, spread, goal, -1.0, 1.0).float())


def test_noise_that_is_believed_has_a_name():
    engine = RaoBlackwell(MotorNoise(gain=8.0, unsteady=4.0, **TINY), particles=20)
    belief = engine.update(engine.start(), torch.zeros(2), torch.rand(3, 4))
    law, noise = belief.marginal("actuation"), belief.marginal("straying").mean
    assert (noise > 0).all()
    found = GazeShift(engine, noise="straying", goal=torch.tensor([2.0, 1.0])).act(belief)
    told = GazeShift(engine, noise=noise, goal=torch.tensor([2.0, 1.0])).act(belief)
    torch.testing.assert_close(found, told)
    assert found.shape == (2,) and law.mean.shape == (2, 2)


def test_who_knows_nothing_of_its_motors_keeps_still():
    engine = RaoBlackwell(LearningToLook(gain=4.0, slip=0.5, **TINY), particles=1)
    belief = engine.start()
    controller = GazeShift(engine, goal=torch.tensor([1.0, 0.0]))
    assert controller.act(belief).tolist() == [0, 0]
    belief = engine.update(belief, torch.zeros(2), torch.rand(3, 4))
    assert controller.act(belief).shape == (2,)


class Levers(Model):
    """A finite choice of levers, and a matrix."""

    lever = action(Finite(3))
    pull = static(lambda self: Normal(zeros(2, 3), 1.0).to_event(2))

    @observation
    def moved(self, pull, lever):
        return Normal(pull[:, 0] * lever, 1.0).to_event(1)


class Ribbon(Model):
    """Levers enough, but none of the variables is a matrix of theirs."""

    command = action(Box(-1.0, 1.0, (2,)))
    pull = static(lambda self: Normal(zeros(2), 1.0).to_event(1))
    wide = static(lambda self: Normal(zeros(2, 3), 1.0).to_event(2))

    @observation
    def moved(self, pull, wide, command):
        return Normal(pull * command + wide[:, 0], 1.0).to_event(1)


@pytest.mark.parametrize(
    ("model", "given", "words"),
    [
        (Levers(), {"by": "pull"}, "needs an action of 3 numbers"),
        (Ribbon(), {"by": "wide"}, "needs an action of 3 numbers"),
        (Ribbon(), {"by": "pull"}, "hidden matrix"),
        (Ribbon(), {}, "actuation is none"),
        (NoisyMotors(), {"noise": "straying"}, "straying is none"),
        (NoisyMotors(), {"by": "motion"}, "motion is none"),
    ],
)
def test_models_that_it_does_not_serve(model, given, words):
    with pytest.raises(Refusal, match=words):
        GazeShift(Kalman(model), **given)


def test_models_with_several_actions_are_refused():
    with pytest.raises(Refusal, match="one action"):
        GazeShift(RaoBlackwell(MotorDynamics(frames=2, **TINY), particles=1))
