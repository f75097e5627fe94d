"""Being carried elsewhere: simulation, what is learned then, and evidence against a sum written out by hand."""

import math

import pytest
import torch
from torch.distributions import Normal

from apmodels import Kidnapped, LearningToLook, ValueOutOfRange
from apmodels.simulation import seeded
from inference import RaoBlackwell
from tests.apmodels.test_motor_dynamics import ACTUATION, SMALL, picture, view_of


def test_a_scene_is_replaced_as_often_as_is_said():
    model = Kidnapped(view=(4, 5), field=(12, 15), kidnapping=0.3, contrast=0.4, change=0.02, brightness=0.6)
    found = model.simulate(2, batch=3000, seed=0)
    lost = found["lost"][:, 1] == 1
    assert float(found["lost"].double().mean()) == pytest.approx(0.3, abs=0.03)
    before, after = found["scene"][:, 0], found["scene"][:, 1]
    # Elsewhere it is as if never seen; at home it hardly changes.
    assert float(after[lost].std()) == pytest.approx(0.4, rel=0.02)
    assert float(after[lost].mean()) == pytest.approx(0.6, abs=0.01)
    assert abs(float(((after - 0.6) * (before - 0.6))[lost].mean())) < 0.01
    assert float((after - before)[~lost].std()) == pytest.approx(0.02, rel=0.02)


def carried(kind, at=10, movements=20, **more):
    """A head that learns, and is in another scene from a movement on: errors of its gains, and what it believes."""
    # Where it is carried it is as anywhere: photographs have a contrast like this.
    engine = RaoBlackwell(kind(**SMALL | {"contrast": 0.25} | more), particles=1)
    belief, place, errors, lost = engine.start(), torch.zeros(2), [], []
    with seeded(7):
        here = torch.zeros(2)
        for step in range(movements):
            goal = torch.rand(2) - 0.5 if step else here
            command, here = goal - here, goal
            place = place + (ACTUATION @ command).round()
            scene = picture(seed=int(step >= at))
            belief = engine.update(belief, command, view_of(scene, place))
            errors.append(float((belief.marginal("actuation").mean - ACTUATION).norm() / ACTUATION.norm()))
            lost.append(int(belief.values["lost"][0, 0]) if "lost" in belief.values else 0)
    return errors, lost


def test_who_is_carried_off_notices_and_keeps_what_motors_do():
    errors, lost = carried(Kidnapped)
    assert lost == [int(step == 10) for step in range(20)]
    assert errors[9] < 0.06 and max(errors[10:]) < errors[9] + 0.02


def test_who_cannot_be_elsewhere_takes_it_for_a_movement():
    errors, _ = carried(LearningToLook)
    assert errors[9] < 0.06 and max(errors[10:]) > 2 * errors[9] + 0.02


def lattice(seen, mean, variance, corner, motion, spread, outside):
    """log of the sum over whole-pixel motions of p(motion) p(image | motion)."""
    (rows, columns), total = seen.shape, []
    for right in range(-15, 16):
        for down in range(-15, 16):
            chance = sum(
                Normal(m, s).log_prob(torch.tensor(float(x)))
                for m, s, x in zip(motion, spread, (right, down), strict=True)
            )
            top, left = corner[1] - down, corner[0] - right
            m, v = torch.full(seen.shape, outside[0]), torch.full(seen.shape, outside[1])
            for row in range(rows):
                for column in range(columns):
                    if 0 <= top + row < mean.shape[0] and 0 <= left + column < mean.shape[1]:
                        m[row, column], v[row, column] = (
                            mean[top + row, left + column],
                            variance[top + row, left + column],
                        )
            total.append(chance + Normal(m, v.sqrt()).log_prob(seen).sum())
    return torch.stack(total).logsumexp(0)


@pytest.mark.parametrize("strange", [False, True])
def test_evidence_is_the_sum_over_being_lost_and_all_offsets(strange):
    model = Kidnapped(
        view=(3, 4), field=(9, 12), gain=1.0, wear=0.1, slip=0.5, contrast=0.3, change=0.05, noise=0.1, kidnapping=0.4
    )
    with seeded(2):
        first = (0.5 + 0.3 * torch.randn(3, 4)).clone()
        second = 1 - first if strange else first + 0.1 * torch.randn(3, 4)
    command = torch.tensor([0.5, -0.25])
    engine = RaoBlackwell(model, particles=1)
    assert set(engine.every) == {"lost"} and engine.candidates == 2
    one = engine.update(engine.start(), torch.zeros(2), first)
    assert one.values["motion"].flatten().tolist() == [0, 0] and int(one.values["lost"]) == 0
    two = engine.update(one, command, second)
    # All is in the middle after the first look: 4 pixels from the left, 3 from the top.
    mean, variance = torch.full((9, 12), 0.5), torch.full((9, 12), 0.3**2 + 0.05**2)
    part = slice(3, 6), slice(4, 8)
    weight = variance[part] / (variance[part] + 0.1**2)
    mean[part] = mean[part] + weight * (first - mean[part])
    variance[part] = variance[part] * (1 - weight)
    spread = math.sqrt((1.0**2 + 2 * 0.1**2) * float(command @ command) + 0.5**2 + 1 / 12)
    outside = 0.5, 0.1**2 + 0.3**2
    shared = (4, 3), (0.0, 0.0), (spread, spread), outside
    kept = math.log(0.6) + lattice(second, mean, variance + 0.05**2 + 0.1**2, *shared)
    fresh, unknown = torch.full((9, 12), 0.5), torch.full((9, 12), 0.3**2 + 0.1**2)
    gone = math.log(0.4) + lattice(second, fresh, unknown, *shared)
    expected = float(torch.logaddexp(kept, gone))
    # Offsets are looked at as far as matters.
    assert float(two.log_evidence - one.log_evidence) == pytest.approx(expected, abs=0.05)
    assert int(two.values["lost"]) == int(gone > kept) == int(strange)


@pytest.mark.parametrize("given", [{"kidnapping": 0.0}, {"kidnapping": 1.0}, {"kidnapping": math.nan}, {"motors": 0}])
def test_bad_kidnappings(given):
    with pytest.raises(ValueOutOfRange):
        Kidnapped(**SMALL | given)
