"""By how much an image has been moved: against sums over pixels, brute force, and other ways to declare the same."""

import warnings
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.distributions import Normal

from apmodels import Box, LearningToLook, Model, action, observation, shift, state, static, window
from apmodels.simulation import seeded
from apmodels.transforms import ones, zeros
from inference import RaoBlackwell
from inference.worlds.offsets import offset_scores

SMALL = LearningToLook(view=(6, 8), field=(18, 24), gain=6.0, wear=0.2, slip=1.5)


def direct(seen, mean, variance):
    """One sum over pixels for each offset."""
    rows, columns = (large - small + 1 for large, small in zip(mean.shape, seen.shape, strict=True))
    found = torch.empty(rows, columns, dtype=torch.float64)
    for r in range(rows):
        for c in range(columns):
            part = slice(r, r + seen.shape[0]), slice(c, c + seen.shape[1])
            score = Normal(mean[part].double(), variance[part].double().sqrt()).log_prob(seen.double().nan_to_num())
            found[r, c] = torch.where(torch.isnan(seen), 0.0, score).sum()
    return found


@settings(deadline=None, max_examples=30)
@given(
    h=st.integers(1, 7), w=st.integers(1, 7), down=st.integers(0, 6), across=st.integers(0, 6), seed=st.integers(0, 99)
)
def test_all_offsets_are_scored_as_one_by_one(h, w, down, across, seed):
    with seeded(seed):
        mean = torch.rand(h + down, w + across)
        variance = torch.rand(h + down, w + across) + 0.01
        seen = torch.rand(h, w)
        seen[torch.rand(h, w) < 0.2] = torch.nan
    torch.testing.assert_close(
        offset_scores(seen, mean, variance).double(), direct(seen, mean, variance), atol=2e-4, rtol=1e-5
    )


def test_whole_images_lose_nothing_that_matters():
    """At full resolution a nat is a part in a hundred thousand."""
    with seeded(0):
        mean = torch.rand(150, 190)
        variance = torch.where(torch.rand(150, 190) < 0.3, 0.26, 0.012)
        seen = (mean[20:140, 15:175] + 0.1 * torch.randn(120, 160)).clone()
    found = offset_scores(seen, mean, variance)
    for r, c in [(0, 0), (20, 15), (30, 30), (7, 21)]:
        one = direct(seen, mean[r : r + 120, c : c + 160], variance[r : r + 120, c : c + 160])
        assert float(found[r, c]) == pytest.approx(float(one), rel=1e-4)
    assert divmod(int(found.argmax()), found.shape[1]) == (20, 15)


class Retinal(LearningToLook):
    """The thesis's own way to say it: the scene moves under the eye."""

    @state
    def scene(self, motion, prev_scene=LearningToLook.first_scene):
        inside = shift(ones(*self.field), motion)
        spread = (self.change**2 + self.contrast**2 * (1 - inside)).sqrt()
        return Normal(shift(prev_scene, motion, self.brightness), spread).to_event(2)

    @observation
    def image(self, scene):
        return Normal(window(scene, self.middle(), self.view, self.brightness), self.noise).to_event(2)


def looked(model, steps=6, seed=0):
    """A scene, commands, and what is seen; the true displacements."""
    with seeded(seed):
        scene = torch.rand(60, 80)
        scene = torch.nn.functional.avg_pool2d(scene[None, None], 3, 1)[0, 0]
        scene = 0.5 + 0.4 * (scene - scene.mean()) / scene.std()
        actuation = torch.tensor([[5.0, 1.0], [-1.0, 4.0]])
        commands = torch.rand(steps, 2) * 1.6 - 0.8
        commands[0] = 0
        moves = (commands @ actuation.T + 0.5 * torch.randn(steps, 2)).round()
        moves[0] = 0
        images, at = [], torch.tensor([30, 20])
        for move in moves:
            at = at - move.long()
            column, row = at.tolist()
            view = scene[row : row + model.view[0], column : column + model.view[1]]
            images.append(view + 0.1 * torch.randn(model.view))
    return commands, torch.stack(images), moves


@pytest.mark.parametrize("kind", [LearningToLook, Retinal])
def test_a_head_finds_its_motions_and_its_motors(kind):
    model = kind(view=(9, 12), field=(45, 60), gain=6.0, wear=0.2, slip=1.5)
    commands, images, moves = looked(model, 14)
    engine = RaoBlackwell(model, particles=1)
    assert engine.offsets
    belief = engine.start()
    for command, image, move in zip(commands, images, moves, strict=True):
        belief = engine.update(belief, command, image)
        assert belief.values["motion"][0, 0].tolist() == move.tolist()
    found = belief.marginal("actuation").mean
    torch.testing.assert_close(found, torch.tensor([[5.0, 1.0], [-1.0, 4.0]]), atol=0.8, rtol=0)


def test_both_ways_to_say_it_give_the_same_belief():
    beliefs = []
    for kind in (LearningToLook, Retinal):
        model = kind(view=(6, 8), field=(60, 80), gain=6.0, wear=0.2, slip=1.5)
        commands, images, _ = looked(model)
        engine = RaoBlackwell(model, particles=1)
        beliefs.append(engine.filter(commands, images)[-1])
    one, other = beliefs
    torch.testing.assert_close(one.marginal("actuation").mean, other.marginal("actuation").mean)
    torch.testing.assert_close(one.log_evidence, other.log_evidence, atol=1e-2, rtol=0)


def test_particles_agree_with_blind_ones():
    """Draws that look first, and very many that do not, come to the same evidence and belief."""
    model = LearningToLook(view=(2, 3), field=(10, 12), gain=1.0, wear=0.1, slip=1.0, noise=0.4)
    commands, images, _ = looked(model, 3)
    looking = [RaoBlackwell(model, particles=200, seed=s).filter(commands, images)[-1] for s in range(8)]
    blind = []
    for seed in range(8):
        engine = RaoBlackwell(model, particles=4000, seed=seed)
        engine.offsets, engine.candidates = {}, engine.tried
        blind.append(engine.filter(commands, images)[-1])
    for ask in (lambda b: b.log_evidence, lambda b: b.marginal("actuation").mean.flatten()[:2]):
        ours, theirs = (torch.stack([ask(b) for b in some]) for some in (looking, blind))
        error = ((ours.var(0) + theirs.var(0)) / 8).sqrt()
        assert ((ours.mean(0) - theirs.mean(0)).abs() < 4 * error + 1e-3).all()
    assert torch.stack([b.log_evidence for b in looking]).std() < 0.2


def test_what_is_not_a_translation_is_not_taken_for_one():
    class Zoomed(Model):
        """The motion is halved on its way to the window: every second pixel of it moves what is seen."""

        push = action(Box(-1.0, 1.0, (2,)))
        scene = static(lambda self: Normal(0.5 * ones(10, 10), 0.5).to_event(2))

        @static
        def gain(self):
            return Normal(2.0, 1.0)

        @state
        def motion(self, gain, push):
            return Normal(gain * push, 1.0).to_event(1)

        @observation
        def image(self, scene, motion):
            return Normal(window(scene, 3 + motion / 2, (3, 3)), 0.1).to_event(2)

    engine = RaoBlackwell(Zoomed(), particles=50)
    assert engine.offsets
    engine.update(engine.start(), zeros(2), torch.rand(3, 3))
    assert not engine.offsets


def test_missing_pixels_and_batches():
    commands, images, _ = looked(SMALL, 4)
    images[2, :3] = torch.nan
    engine = RaoBlackwell(SMALL, particles=1)
    single = engine.start()
    batch = engine.start(2)
    for command, image in zip(commands, images, strict=True):
        single = engine.update(single, command, image)
        batch = engine.update(batch, command.expand(2, 2), image.expand(2, 6, 8))
    torch.testing.assert_close(batch.marginal("actuation").mean[1], single.marginal("actuation").mean)


@pytest.mark.parametrize("particles", [1, 20])
def test_who_looks_past_all_there_is_goes_on(particles):
    """With nothing to compare, a motion is what it was expected to be, and the next is looked for again."""
    engine = RaoBlackwell(SMALL, particles=particles)
    belief = engine.update(engine.start(), zeros(2), torch.rand(6, 8))
    belief = replace(belief, values=belief.values | {"gaze": belief.values["gaze"] + 100.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        belief = engine.update(belief, zeros(2), torch.rand(6, 8))
    assert engine.offsets and torch.isfinite(belief.marginal("actuation").mean).all()
    assert particles > 1 or belief.values["motion"].flatten().tolist() == [0, 0]


def test_a_motion_of_which_nothing_is_integrated_is_tried_as_before():
    class Pushed(Model):
        """The motors are known, and slip."""

        push = action(Box(-3.0, 3.0, (2,)))
        scene = static(lambda self: Normal(0.5 * ones(12, 12), 0.5).to_event(2))

        @state
        def motion(self, push):
            return Normal(push, 1.0).to_event(1)

        @observation
        def image(self, scene, motion):
            return Normal(window(scene, 4 + motion, (4, 4)), 0.1).to_event(2)

    engine = RaoBlackwell(Pushed(), particles=1)
    assert not engine.offsets and engine.candidates > 100
    with seeded(0):
        scene = torch.rand(12, 12)
    belief, moved = engine.start(), []
    for column, row in ((4, 4), (5, 3), (4, 5)):
        belief = engine.update(belief, zeros(2), scene[row : row + 4, column : column + 4])
        moved.append(belief.values["motion"].round().flatten())
    # The first look may be anywhere: nothing has been seen before.
    assert [(m - moved[0]).tolist() for m in moved] == [[0, 0], [1, -1], [0, 1]]


@pytest.mark.filterwarnings("ignore::inference.rao_blackwell.DepletionWarning")
@pytest.mark.parametrize("particles", [1, 4])
def test_an_update_leaves_the_belief_it_begins_from_as_it_was(particles):
    engine = RaoBlackwell(SMALL, particles=particles)
    belief = engine.start()
    with seeded(0):
        looks = torch.rand(3, 6, 8)
    for look in looks:
        kept = [(mean.clone(), variance.clone()) for images in belief.fields for mean, variance in images.values()]
        after, again = (engine.update(belief, torch.tensor([0.1, 0.0]), look) for _ in range(2))
        now = [pair for images in belief.fields for pair in images.values()]
        assert all(torch.equal(a, b) for old, new in zip(kept, now, strict=True) for a, b in zip(old, new, strict=True))
        assert torch.equal(after.log_evidence, again.log_evidence)
        belief = after
