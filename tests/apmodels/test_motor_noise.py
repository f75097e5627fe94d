"""How far motors stray: simulation against the equations, posteriors against importance sampling, known noise."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from apmodels import MotorErrors, MotorNoise, NoisyMotors, ValueOutOfRange
from apmodels.simulation import seeded
from inference import Kalman, RaoBlackwell, fit
from tests.apmodels.test_motor_dynamics import picture, view_of

ACTUATION = torch.tensor([[6.0, 1.0], [-1.0, 5.0]])
STRAYING = torch.tensor([[40.0, 5.0], [8.0, 20.0]])


@pytest.mark.parametrize("kind", [MotorNoise, NoisyMotors])
def test_noise_grows_with_what_each_motor_is_told(kind):
    command = torch.tensor([[1.0, 0.0], [0.0, -0.5], [0.8, 0.6], [0.0, 0.0]])
    if kind is MotorNoise:
        model = MotorNoise(view=(2, 3), field=(4, 6), slip=2.0)
        found = model.simulate(4, command, batch=4000, seed=0, given={"straying": STRAYING.expand(4000, 2, 2)})
    else:
        found = NoisyMotors(slip=2.0, straying=STRAYING).simulate(4, command, batch=4000, seed=0)
    strayed = found["motion"] - (found["actuation"] @ command[:, :, None])[..., 0]
    expected = [[40.0, 8.0], [2.5, 10.0], [math.hypot(32, 3), math.hypot(6.4, 12)], [0, 0]]
    for t, pair in enumerate(expected):
        assert strayed[:, t].std(0).tolist() == pytest.approx([math.hypot(s, 2.0) for s in pair], rel=0.04)


def test_noise_that_is_not_known_is_half_normal():
    found = MotorNoise(view=(2, 3), field=(4, 6), unsteady=7.0).simulate(1, batch=4000, seed=0)["straying"]
    assert found.shape == (4000, 2, 2) and bool((found >= 0).all())
    assert float((found**2).mean()) == pytest.approx(49, rel=0.05)


def babbled(particles, steps=20, unsteady=3.0):
    """What a head with one noisy motor comes to believe; its commands and movements."""
    model = MotorNoise(view=(6, 8), field=(30, 40), gain=6.0, wear=0.05, slip=0.5, unsteady=unsteady)
    engine, scene, place = RaoBlackwell(model, particles=particles, seed=1), picture(80, 100), torch.zeros(2)
    noise, commands, moves = torch.tensor([[2.5, 0.1], [0.1, 0.4]]), [], []
    with seeded(1):
        belief = engine.update(engine.start(), torch.zeros(2), view_of(scene, place, (6, 8)))
        for _ in range(steps):
            # Back to the middle, more or less.
            command = (torch.linalg.solve(ACTUATION, -place) + 1.6 * torch.rand(2) - 0.8).clamp(-1, 1)
            moved = (ACTUATION @ command + (noise**2 @ command**2).sqrt() * torch.randn(2)).round()
            place = place + moved
            belief = engine.update(belief, command, view_of(scene, place, (6, 8)))
            commands.append(command)
            moves.append(moved)
    return belief, torch.stack(commands), torch.stack(moves)


def test_a_motor_that_strays_is_found_out():
    belief, commands, moves = babbled(100)
    law = belief.marginal("straying")
    # Draws from the prior, weighed by how probable they make the movements.
    with seeded(0):
        drawn = (3.0 * torch.randn(20_000, 2, 2)).abs()
    steps = torch.arange(1, len(moves) + 1.0)
    shared = commands @ commands.T * (36 + 0.05**2 * (1 + torch.minimum(steps[:, None], steps)))
    for d in range(2):
        own = drawn[:, d] ** 2 @ (commands**2).T + 0.25 + 1 / 12
        weight = torch.softmax(
            MultivariateNormal(torch.zeros(20), shared + torch.diag_embed(own)).log_prob(moves[:, d]), 0
        )
        mean = weight @ drawn[:, d]
        spread = (weight @ (drawn[:, d] - mean) ** 2).sqrt()
        assert ((law.mean[d] - mean).abs() < spread).all()
    assert law.mean[0, 0] == law.mean.max() and law.mean[0, 0] > 2 * law.mean[1, 0]
    # As unsure as at first it is about nothing: of a HalfNormal, 0.6 of its scale.
    assert (law.variance.sqrt() < 0.5 * 0.6 * 3.0).all()


def test_one_particle_cannot_tell_noise():
    """It keeps the noise with which it was born: one value of it, for good."""
    one, _, _ = babbled(1, steps=3)
    assert (one.marginal("straying").variance == 0).all()


def test_noise_is_found_from_movements_by_evidence():
    truth = NoisyMotors(gain=100.0, wear=0.5, slip=2.0, straying=STRAYING)
    record = truth.simulate(70, batch=4, seed=1)
    begin = truth.replace(straying=torch.full((2, 2), 15.0))
    found = fit(begin, {name: record[name] for name in ("command", "motion")}, {"straying": "real"})
    assert torch.allclose(found.values["straying"].abs(), STRAYING, rtol=0.2, atol=3.0)
    assert found.log_evidence[-1] > found.log_evidence[0] + 10


def test_without_noise_it_is_a_kalman_filter_of_the_gains():
    """One motor, one direction, by hand."""
    model = NoisyMotors(motors=1, gain=10.0, wear=0.5, slip=2.0, straying=((3.0,), (0.0,)))
    engine = Kalman(model)
    belief, mean, variance = engine.start(), 0.0, 100.0
    for command, motion in ((0.5, 4.0), (-1.0, -9.0), (0.2, 3.0)):
        belief = engine.update(belief, torch.tensor([command]), torch.tensor([motion, 0.0]))
        variance += 0.25
        weight = variance * command / (variance * command**2 + 9.0 * command**2 + 4.0)
        mean, variance = mean + weight * (motion - mean * command), variance * (1 - weight * command)
    law = belief.marginal("actuation")
    assert float(law.mean[0, 0]) == pytest.approx(mean, rel=1e-5)
    assert float(law.variance[0, 0]) == pytest.approx(variance, rel=1e-5)


@pytest.mark.parametrize("strays", [30.0, 60.0])
def test_mean_errors_are_less_than_standard_deviations(strays):
    """A motor of known noise: without the factor sqrt(2 / pi) it would be found a fifth too sure."""
    engine, random = Kalman(MotorErrors(motors=1, unsteady=100.0, fading=0.02)), torch.Generator().manual_seed(0)
    belief = engine.start()
    commands = 2 * torch.rand(800, 1, generator=random) - 1
    errors = (strays * commands * torch.randn(800, 2, generator=random)).abs()
    for command, error in zip(commands, errors, strict=True):
        belief = engine.update(belief, command, error)
    assert belief.marginal("straying").mean.flatten().tolist() == pytest.approx([strays] * 2, rel=0.08)


@pytest.mark.parametrize("given", [{"unsteady": 0.0}, {"unsteady": -1.0}, {"bias": True}, {"motors": 0}])
def test_bad_noise(given):
    with pytest.raises(ValueOutOfRange):
        MotorNoise(**given)
