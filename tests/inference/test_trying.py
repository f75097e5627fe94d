"""Where one world is kept, every value of finite states is tried: against sums by hand, and said in another order."""

import math
import warnings
from dataclasses import replace

import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal

from apmodels import Box, Kidnapped, LearningToLook, Model, action, observation, shift, state, static, window
from apmodels.simulation import seeded
from apmodels.transforms import ones, where, zeros
from inference import RaoBlackwell
from inference.worlds.trying import combinations
from tests.apmodels.test_kidnapped import lattice

TINY = {"view": (3, 4), "field": (9, 12), "gain": 1.0, "wear": 0.1, "slip": 0.5, "contrast": 0.3, "change": 0.05}
MODEL = Kidnapped(kidnapping=0.3, **TINY)


class Jerky(Kidnapped):
    """Some movements are jerky, and then go astray."""

    jerks: tuple[float, ...] = (0.5, 0.3, 0.2)

    @state
    def jerk(self):
        return Categorical(torch.tensor(self.jerks))

    @state
    def motion(self, actuation, jerk, command):
        return Normal(actuation @ command, self.slip * (1 + 2 * jerk)).to_event(1)


JERKY = Jerky(kidnapping=0.3, **TINY)


def images(count=2, seed=0):
    with seeded(seed):
        first = 0.5 + 0.3 * torch.randn(3, 4)
        return [first, *(first + 0.1 * torch.randn(3, 4) for _ in range(count - 1))]


def test_worlds_are_all_combinations_of_values():
    structure = JERKY.structure
    found = combinations(structure, ("jerk", "lost", "motion"), 6)
    assert list(found) == ["jerk", "lost"]
    pairs = list(zip(found["jerk"].tolist(), found["lost"].tolist(), strict=True))
    assert sorted(pairs) == [(j, k) for j in range(3) for k in range(2)]
    assert combinations(structure, ("jerk", "lost"), 5) == {}
    assert combinations(structure, ("motion",), 100) == {}
    assert found["jerk"].shape == (6,) and combinations(structure, ("lost",), 2)["lost"].tolist() == [0, 1]


def test_only_one_world_tries_all_and_only_if_they_are_not_too_many():
    one, few, many = RaoBlackwell(MODEL, 1), RaoBlackwell(MODEL, 1, candidates=1), RaoBlackwell(MODEL, 50)
    assert set(one.every) == {"lost"} and one.candidates == 2
    assert few.every == {} and few.candidates == 1 and many.every == {} and many.candidates == 50
    assert set(RaoBlackwell(JERKY, 1).every) == {"lost", "jerk"}
    assert RaoBlackwell(LearningToLook(**TINY), 1).every == {}


@pytest.mark.parametrize("moved", [0, 1])
def test_the_evidence_of_two_finite_states_is_the_sum_over_both(moved):
    first, second = images()
    second = torch.roll(second, moved, 1)
    engine = RaoBlackwell(JERKY, particles=1)
    one = engine.update(engine.start(), torch.zeros(2), first)
    assert one.values["motion"].flatten().tolist() == [0, 0]
    command = torch.tensor([0.5, -0.25])
    two = engine.update(one, command, second)
    # In the middle of what is remembered is what was seen.
    mean, variance = torch.full((9, 12), 0.5), torch.full((9, 12), 0.3**2 + 0.05**2)
    part = slice(3, 6), slice(4, 8)
    weight = variance[part] / (variance[part] + 0.1**2)
    mean[part], variance[part] = mean[part] + weight * (first - mean[part]), variance[part] * (1 - weight)
    scenes = [
        (0.7, mean, variance + 0.05**2 + 0.1**2),
        (0.3, torch.full((9, 12), 0.5), torch.full((9, 12), 0.3**2 + 0.1**2)),
    ]
    terms = []
    for jerk, often in enumerate(JERKY.jerks):
        # A pixel is as wide as 1/12; what has moved so far taught little of what is not commanded.
        spread = math.sqrt((1 + 2 * 0.1**2) * float(command @ command) + (0.5 * (1 + 2 * jerk)) ** 2 + 1 / 12)
        for chance, m, v in scenes:
            terms.append(math.log(often * chance) + lattice(second, m, v, (4, 3), (0, 0), (spread,) * 2, (0.5, 0.1)))
    terms = torch.stack(terms)
    assert float(two.log_evidence - one.log_evidence) == pytest.approx(float(terms.logsumexp(0)), abs=0.05)
    best = int(terms.argmax())
    assert (int(two.values["jerk"]), int(two.values["lost"])) == divmod(best, 2)


class Said(Model):
    """Kidnapped, in another order: whether it is lost is told first."""

    command = action(lambda self: Box(-1.0, 1.0, (2,)))
    first_actuation = static(lambda self: Normal(zeros(2, 2), 1.0).to_event(2))
    first_scene = static(lambda self: Normal(0.5 * ones(9, 12), 0.3).to_event(2))

    @state
    def lost(self):
        return Bernoulli(0.3)

    @state
    def scene(self, lost, prev_scene=first_scene):
        away = lost * 24.0 * ones(2)
        return Normal(shift(prev_scene, away, 0.5), where(lost == 1, 0.3, 0.05)).to_event(2)

    @state
    def actuation(self, prev_actuation=first_actuation):
        return Normal(prev_actuation, 0.1).to_event(2)

    @state
    def motion(self, actuation, command):
        return Normal(actuation @ command, 0.5).to_event(1)

    @state
    def gaze(self, motion, prev_gaze=lambda self: zeros(2)):
        return prev_gaze + motion

    @observation
    def image(self, scene, gaze):
        corner = torch.tensor([4.0, 3.0]) - gaze
        spread = where(MODEL.inside(corner), 0.1, 0.1**0.5)
        return Normal(window(scene, corner, (3, 4), 0.5), spread).to_event(2)

    interest = actuation


def test_the_order_of_declaration_does_not_matter():
    """In ``Kidnapped`` a finite state is declared after the displacement, of which it must not know."""
    names = [v.name for v in MODEL.declaration.of_role("state")]
    others = [v.name for v in Said().declaration.of_role("state")]
    assert names.index("lost") > names.index("motion") and others.index("lost") < others.index("motion")
    engines = [RaoBlackwell(MODEL, 1), RaoBlackwell(Said(), 1)]
    one, other = [engine.start() for engine in engines]
    with seeded(1):
        commands = torch.rand(4, 2) * 2 - 1
    pictures = [*images(3), 1 - images(1)[0]]
    for command, picture in zip(commands, pictures, strict=True):
        one, other = (e.update(b, command, picture) for e, b in zip(engines, (one, other), strict=True))
        for name in ("lost", "motion"):
            assert torch.equal(one.values[name], other.values[name])
    torch.testing.assert_close(one.log_evidence, other.log_evidence)
    torch.testing.assert_close(one.marginal("actuation").mean, other.marginal("actuation").mean)
    torch.testing.assert_close(one.marginal("scene").mean, other.marginal("scene").mean)


def test_rows_of_a_batch_are_lost_each_by_itself():
    first, second = images()
    elsewhere, still = 1.5 - 2 * first, torch.zeros(2)
    engine = RaoBlackwell(MODEL, particles=1)
    start = engine.update(engine.start(), still, first)
    single = [engine.update(start, still, image) for image in (second, elsewhere)]
    batch = engine.update(engine.start(2), still.expand(2, 2), first.expand(2, 3, 4))
    batch = engine.update(batch, still.expand(2, 2), torch.stack([second, elsewhere]))
    assert batch.values["lost"].flatten().tolist() == [0, 1]
    for row, belief in enumerate(single):
        assert int(belief.values["lost"]) == row
        torch.testing.assert_close(batch.log_evidence[row], belief.log_evidence)
        torch.testing.assert_close(batch.marginal("scene").mean[row], belief.marginal("scene").mean)


@pytest.mark.parametrize("particles", [1, 20])
def test_who_sees_nothing_of_the_scene_in_any_world_goes_on(particles):
    engine = RaoBlackwell(MODEL, particles=particles)
    belief = engine.update(engine.start(), zeros(2), images()[0])
    belief = replace(belief, values=belief.values | {"gaze": belief.values["gaze"] + 100.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        belief = engine.update(belief, zeros(2), images()[1])
    assert engine.offsets and math.isfinite(float(belief.log_evidence))
    assert torch.isfinite(belief.marginal("actuation").mean).all()


def test_particles_find_out_too():
    """Drawn ones, of which some happen to be lost: where all else would be a surprise, those are left."""
    first, _ = images()
    engine = RaoBlackwell(MODEL, particles=400, seed=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        belief = engine.update(engine.start(), zeros(2), first)
        belief = engine.update(belief, zeros(2), 1.5 - 2 * first)
    lost = (belief.log_weights.exp() * belief.values["lost"]).sum()
    assert float(lost) > 0.95


def test_what_is_not_a_translation_is_tried_as_any_other_value():
    class Halved(Kidnapped):
        @observation
        def image(self, scene, gaze):
            return Normal(window(scene, self.middle() - gaze / 2, self.view, self.brightness), self.noise).to_event(2)

    engine = RaoBlackwell(Halved(**TINY), particles=1, candidates=20)
    assert engine.offsets and engine.every
    belief = engine.update(engine.start(), zeros(2), images()[0])
    assert not engine.offsets and not engine.every and engine.candidates == 20
    belief = engine.update(belief, zeros(2), images()[1])
    assert math.isfinite(float(belief.log_evidence))
