"""Watching movements frame by frame: simulation against the equations, and motors of known courses."""

import pytest
import torch

from apmodels import LearningToLook, MotorDynamics, ValueOutOfRange, window
from apmodels.simulation import seeded
from inference import RaoBlackwell

SMALL = {"view": (8, 10), "field": (26, 32), "gain": 8.0, "wear": 0.2, "slip": 1.0}
ACTUATION = torch.tensor([[10.0, 1.0], [-1.0, 8.0]])


def picture(rows=60, columns=80, seed=0):
    with seeded(seed):
        scene = torch.nn.functional.avg_pool2d(torch.rand(1, 1, rows + 2, columns + 2), 3, 1)[0, 0]
    return 0.5 + 0.25 * (scene - scene.mean()) / scene.std()


def view_of(scene, moved, size=(8, 10)):
    """What a camera sees in the middle of a scene that has moved by (right, down)."""
    row, column = (scene.shape[0] - size[0]) // 2 - int(moved[1]), (scene.shape[1] - size[1]) // 2 - int(moved[0])
    return scene[row : row + size[0], column : column + size[1]] + 0.05 * torch.randn(size)


@pytest.fixture(scope="module")
def record():
    model = MotorDynamics(frames=3, view=(4, 5), field=(12, 15), gain=3.0, wear=0.6, slip=0.5, change=0.3)
    begin = torch.tensor([0, 1, 0, 0, 0, 1, 0, 1, 1, 0])
    with seeded(0):
        command = torch.rand(10, 2) * 2 - 1
    return model, begin, command, model.simulate(10, {"begin": begin, "command": command}, batch=400, seed=1)


def test_frames_count_from_a_command_and_stay_at_the_last(record):
    _, _, _, found = record
    # Before the first command the last one has ended.
    assert (found["frame"] == torch.tensor([2, 0, 1, 2, 2, 0, 1, 0, 0, 1])).all()


def test_a_movement_begins_where_the_last_one_has_got_to(record):
    _, begin, _, found = record
    gaze = torch.nn.functional.pad(found["gaze"], (0, 0, 1, 0))[:, :-1]
    before = torch.zeros(400, 2)
    for t in range(10):
        before = torch.where(begin[t] == 1, gaze[:, t], before)
        torch.testing.assert_close(found["origin"][:, t], before)
    torch.testing.assert_close(found["gaze"], found["origin"] + found["motion"])


def test_each_frame_has_an_actuation_of_its_own(record):
    _, _, command, found = record
    at = found["actuation"].gather(2, found["frame"][..., None, None, None].expand(-1, -1, 1, 2, 2))[:, :, 0]
    strayed = found["motion"] - (at @ command[:, :, None])[..., 0]
    assert float(strayed.std()) == pytest.approx(0.5, rel=0.03) and abs(float(strayed.mean())) < 0.02
    assert float(found["first_actuation"].std()) == pytest.approx(3.0, rel=0.05)


def test_wear_and_change_come_frame_by_frame(record):
    _, _, _, found = record
    worn = torch.diff(found["actuation"], dim=1)
    changed = torch.diff(found["scene"], dim=1)
    assert float(worn.std()) == pytest.approx(0.6 / 3**0.5, rel=0.03)
    assert float(changed.std()) == pytest.approx(0.3 / 3**0.5, rel=0.03)


def test_an_image_is_a_window_that_goes_the_other_way(record):
    model, _, _, found = record
    for i in range(30):
        corner = torch.tensor([5.0, 4.0]) - found["gaze"][i, 9]
        away = (found["image"][i, 9] - window(found["scene"][i, 9], corner, (4, 5), 0.5))[
            model.inside(corner)  # of what is outside nothing is known
        ]
        assert not len(away) or float(away.abs().max()) < 5 * model.noise


def test_a_head_finds_out_how_each_motor_goes_on():
    course = torch.tensor([0.0, 1.2, 1.0])
    engine = RaoBlackwell(MotorDynamics(frames=3, **SMALL), particles=1)
    assert engine.offsets
    scene, place = picture(), torch.zeros(2)
    with seeded(3):
        belief = engine.update(engine.start(), {"command": torch.zeros(2), "begin": 0}, view_of(scene, place))
        at = torch.zeros(2)
        for _ in range(12):
            goal = torch.rand(2) - 0.5
            command, at = goal - at, goal
            for frame, share in enumerate(course):
                moved = (share * ACTUATION @ command).round()
                given = {"command": command, "begin": int(frame == 0)}
                belief = engine.update(belief, given, view_of(scene, place + moved))
                assert belief.values["motion"][0, 0].tolist() == moved.tolist()
            place = place + moved
    law = belief.marginal("actuation")
    torch.testing.assert_close(law.mean, course[:, None, None] * ACTUATION, atol=0.8, rtol=0)
    assert (law.mean - course[:, None, None] * ACTUATION).abs().div(law.variance.sqrt()).max() < 4


def test_with_one_frame_it_is_learning_to_look():
    engines = [RaoBlackwell(LearningToLook(**SMALL), 1), RaoBlackwell(MotorDynamics(frames=1, **SMALL), 1)]
    beliefs, scene, place = [engine.start() for engine in engines], picture(), torch.zeros(2)
    with seeded(4):
        for step in range(8):
            command = torch.rand(2) - 0.5 if step else torch.zeros(2)
            place = place + (ACTUATION @ command).round()
            image = view_of(scene, place)
            given = command, {"command": command, "begin": 1}
            beliefs = [e.update(b, g, image) for e, b, g in zip(engines, beliefs, given, strict=True)]
    one, other = beliefs
    torch.testing.assert_close(other.marginal("actuation").mean[0], one.marginal("actuation").mean)
    torch.testing.assert_close(other.marginal("actuation").variance[0], one.marginal("actuation").variance)
    torch.testing.assert_close(other.marginal("scene").mean, one.marginal("scene").mean)
    torch.testing.assert_close(other.log_evidence, one.log_evidence)


def test_a_movement_that_is_the_same_whatever_the_command():
    """Of a bias, and of features of one's own."""

    class Squared(MotorDynamics):
        @property
        def causes(self):
            return 2 * self.motors

        def features(self, command):
            return torch.cat([command, command**2])

    biased = MotorDynamics(frames=2, bias=True, **SMALL)
    assert biased.features(torch.tensor([0.5, -0.5])).tolist() == [0.5, -0.5, 1.0]
    for model, causes in ((biased, 3), (Squared(frames=2, **SMALL), 4)):
        assert model.causes == causes
        engine = RaoBlackwell(model, particles=1)
        belief = engine.update(engine.start(), {"command": torch.ones(2), "begin": 1}, torch.rand(8, 10))
        assert belief.marginal("actuation").mean.shape == (2, 2, causes)


def test_a_bias_is_told_from_the_motors():
    engine = RaoBlackwell(LearningToLook(bias=True, **SMALL | {"field": (32, 40)}), particles=1)
    belief, scene, place, pull = engine.start(), picture(), torch.zeros(2), torch.tensor([2.0, -1.0])
    with seeded(5):
        belief = engine.update(belief, torch.zeros(2), view_of(scene, place))
        for _ in range(20):
            # Back to the middle, more or less: it drifts.
            command = (torch.linalg.solve(ACTUATION, -place - pull) + torch.rand(2) - 0.5).clamp(-1, 1)
            place = place + (ACTUATION @ command + pull).round()
            belief = engine.update(belief, command, view_of(scene, place))
    found = belief.marginal("actuation").mean
    torch.testing.assert_close(found[:, :2], ACTUATION, atol=0.8, rtol=0)
    torch.testing.assert_close(found[:, 2], pull, atol=0.8, rtol=0)


@pytest.mark.parametrize("given", [{"frames": 0}, {"frames": -3}, {"motors": 0}, {"view": (40, 16)}])
def test_bad_dynamics(given):
    with pytest.raises(ValueOutOfRange):
        MotorDynamics(**SMALL | given)
