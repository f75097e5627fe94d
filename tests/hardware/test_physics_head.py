"""A head of hinges and servos: its servos against formulas, its geometry against what images tell."""

import math

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")

from hardware import Joint, Person, PhysicsHead, Room, stage
from hardware.stage import TICK

GREY = [np.full((8, 8), 120, np.uint8)]


def scenery(height=500, seed=0):
    """A panorama that is as detailed as photographs are, coarse and fine."""
    random, image = np.random.default_rng(seed), np.zeros((height, 2 * height), np.float32)
    for cells in (8, 20, 50):
        coarse = random.normal(size=(cells, 2 * cells)).astype(np.float32)
        image += cv2.resize(coarse, (2 * height, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(127 + 50 * image, 0, 255).astype(np.uint8)


PANORAMA, ELSEWHERE = scenery(), Room(scenery(seed=1))


def head(*joints, scene=GREY, **settings):
    return PhysicsHead(joints, scene, **{"size": (24, 32), "slip": 0.0, "sensor": 0.0} | settings)


def neck(**settings):
    """Pan and tilt, a little below and behind the camera."""
    joints = Joint("pan", "right", 30.0, quickness=60.0), Joint("tilt", "up", 20.0, quickness=60.0)
    return head(*joints, **{"scene": PANORAMA, "size": (120, 160), "camera": (0.0, 0.06, 0.05)} | settings)


# Servos.


def test_a_servo_goes_as_a_sprung_and_damped_hinge_does():
    for damping, quickness in ((1.0, 12.0), (0.4, 15.0), (2.0, 20.0)):
        servo = head(Joint("pan", "right", 10.0, quickness=quickness, damping=damping))
        servo.send([1.0])
        times, seen = np.arange(1, 241) * TICK, []
        for _ in times:
            servo.wait(TICK)
            seen.append(servo.angles[0])
        # Of x'' = q² (10 - x) - 2 d q x', by its two roots.
        one, other = np.roots([1, 2 * damping * quickness, quickness**2]).astype(complex) + np.array([1e-6, 0])
        shape = 1 - (other * np.exp(one * times) - one * np.exp(other * times)) / (other - one)
        # Physics goes by ticks.
        assert np.abs(np.array(seen) - 10 * shape.real).max() < 0.6
        over = math.exp(-math.pi * damping / math.sqrt(1 - damping**2)) if damping < 1 else 0.0
        assert max(max(seen) / 10 - 1, 0) == pytest.approx(over, abs=0.03 if over else 1e-3)
        servo.wait(2.0)
        assert servo.angles == pytest.approx([10.0], abs=0.01)


def test_nothing_moves_before_a_command_has_come():
    servo = head(Joint("pan", "right", 10.0, latency=0.1), Joint("tilt", "up", 10.0, latency=0.2))
    servo.send([1.0, 1.0])
    servo.wait(0.1)
    assert servo.angles.tolist() == [0, 0]
    servo.wait(2 * TICK)
    assert servo.angles[0] > 0.001 and servo.angles[1] == 0
    servo.wait(0.1)
    assert (servo.angles > 0.001).all()


def test_commands_that_are_under_way_add_up():
    servo = head(Joint("pan", "right", 10.0, latency=0.1))
    for command in (1.0, 0.5, -0.2):
        servo.send([command])
        servo.wait(0.05)
    servo.wait(1.0)
    assert servo.angles == pytest.approx([13.0], abs=0.01)


def test_a_joint_stops_at_its_limit_either_way_and_comes_back_from_there():
    servo = head(Joint("pan", "right", 10.0, limit=15.0, quickness=60.0))
    for command, end in ((4.0, 15.0), (-0.5, 10.0), (-9.0, -15.0), (0.5, -10.0)):
        servo.turn([command])
        assert servo.angles == pytest.approx([end], abs=0.01)


def test_slip_is_in_pixels_whatever_the_command():
    servo = head(*(Joint(name, name, 10.0, quickness=100.0) for name in ("right", "up")), slip=3.0, period=0.2)
    for command in ([0.1, 0.0], [1.0, -1.0]):
        ends = []
        for seed in range(200):
            servo.reset(seed)
            servo.turn(command)
            ends.append(servo.angles)
        ends = np.radians(np.array(ends)) * servo.lens.focal
        assert np.std(ends, 0) == pytest.approx([3.0, 3.0], rel=0.15)
        assert abs(np.corrcoef(ends.T)[0, 1]) < 0.25
        mean = np.radians(10.0 * np.array(command)) * servo.lens.focal
        assert np.abs(ends.mean(0) - mean).max() < 4 * 3.0 / 200**0.5


def test_only_the_joints_nearest_to_the_camera_slip_and_nothing_does_without_a_command():
    joints = [Joint(str(i), turns, 10.0, quickness=30.0) for i, turns in enumerate(("right", "right", "up"))]
    servo = head(*joints, slip=3.0, chain=(1, 2, 0))
    servo.turn([0.0, 1.0, 0.0])
    moved = np.abs(servo.angles - [0.0, 10.0, 0.0]) > 0.05
    assert moved.tolist() == [True, False, True]
    rest = servo.angles
    servo.turn([0.0, 0.0, 0.0])
    assert np.allclose(servo.angles, rest, atol=1e-3)


def test_a_joints_noise_is_a_share_of_its_way():
    for unsteady in (1.0, 0.5):
        servo = head(Joint("pan", "right", 10.0, quickness=100.0, noise=0.2), period=0.2, unsteady=unsteady)
        for command in (0.5, 3.0):
            ends = []
            for seed in range(300):
                servo.reset(seed)
                servo.turn([command])
                ends.append(servo.angles[0])
            assert np.std(ends) == pytest.approx(unsteady * 0.2 * 10 * command, rel=0.15)
            assert np.mean(ends) == pytest.approx(10 * command, abs=command)


def test_the_same_seed_gives_the_same_bit_for_bit():
    def run(body, seed):
        body.reset(seed)
        images = [body.step(command) for command in ([0.3, -0.2], [-0.5, 0.6])]
        return torch.stack(images), body.angles

    one = neck(slip=3.0, sensor=0.02)
    first, again = run(one, 3), run(one, 3)
    other, new = run(one, 4), run(neck(slip=3.0, sensor=0.02), 3)
    for images, angles in (again, new):
        assert torch.equal(images, first[0]) and np.array_equal(angles, first[1])
    assert not torch.equal(other[0], first[0]) and not np.array_equal(other[1], first[1])
    assert first[0].shape == (2, 120, 160) and first[0].dtype == torch.float32


def test_without_noise_for_a_while():
    servo = head(Joint("pan", "right", 10.0, quickness=100.0, noise=0.3), slip=3.0)
    with servo.noiseless():
        servo.turn([1.5])
        assert servo.angles == pytest.approx([15.0], abs=1e-3)
    servo.turn([1.0])
    assert servo.slip == 3.0 and abs(servo.angles[0] - 25.0) > 0.1


def test_noise_of_pixels():
    body = neck(sensor=0.05)
    body.reset(0)
    away = body.look().numpy() - body.render(body.angles)
    assert away.std() == pytest.approx(0.05, rel=0.05) and abs(away.mean()) < 0.005


# What is seen.


@pytest.mark.parametrize("given", [{}, {"roll": 20.0}, {"distortion": 0.1}, {"roll": -8.0, "distortion": 0.15}])
@pytest.mark.parametrize("turn", [(4.0, 0.0), (0.0, -5.0), (3.0, 3.0)])
def test_what_is_seen_moves_as_is_said(given, turn):
    body, start = neck(**given), np.array([-10.0, 4.0])
    before, after = body.render(start), body.render(start + turn)
    window = cv2.createHanningWindow((160, 120), cv2.CV_64F)
    found, _ = cv2.phaseCorrelate(before.astype(float), after.astype(float), window)
    assert np.abs(np.array(found) - body.flow(start, start + turn)).max() < 1.5


@pytest.mark.parametrize("given", [{}, {"roll": 5.0, "distortion": 0.05}])
def test_what_is_followed_is_where_it_is_seen(given):
    body, before, after = neck(**given), np.array([2.0, -1.0]), np.array([6.0, 2.0])
    first, second = body.render(before), body.render(after)
    for row, column in ((50, 90), (60, 70), (40, 100)):
        score = cv2.matchTemplate(second, first[row : row + 21, column : column + 21], cv2.TM_CCOEFF_NORMED)
        down, right = np.unravel_index(score.argmax(), score.shape)
        centre = np.array([column + 10, row + 10]) - [79.5, 59.5]
        found = np.array([right + 10, down + 10]) - [79.5, 59.5]
        assert np.abs(body.follow(centre, before, after) - found).max() < 1.5


def test_a_place_in_the_room_is_seen_where_followed_pixels_go():
    body, angles = neck(roll=5.0), np.array([8.0, -3.0])
    camera, turn = body.pose(angles)
    # 2 m along the ray of a pixel.
    pixel = np.array([20.5, -11.5])
    place = camera + 2 * turn @ body.lens.ray(pixel)[[0, 2, 1]].astype(float)
    assert body.spot(place, angles) == pytest.approx(pixel, abs=1e-3)


def test_frames_are_what_is_seen_on_the_way():
    body = neck(slip=2.0, sensor=0.02)
    body.reset(5)
    seen = body.frames([0.5, 0.3], 6)
    body.reset(5)
    body.send([0.5, 0.3])
    again = []
    for _ in range(6):
        body.wait(1 / 30)
        again.append(body.look())
    assert torch.equal(seen, torch.stack(again)) and seen.shape == (6, 120, 160)
    assert (seen[-1] - seen[0]).abs().mean() > 0.05


@pytest.mark.parametrize("rate", [25.0, 30.0, 50.0, 100.0])
def test_so_many_frames_take_a_second(rate):
    servo = head(Joint("pan", "right", 10.0))
    servo.frames([0.0], int(rate), rate)
    assert servo.time == pytest.approx(1.0, abs=TICK)


def test_another_room_looks_different_and_back_it_is_as_before():
    body = neck()
    home, room = body.look(), body.room
    body.enter(ELSEWHERE)
    assert body.room is ELSEWHERE and (body.look() - home).abs().mean() > 0.1
    body.enter(room)
    assert torch.equal(body.look(), home)


@pytest.mark.parametrize("given", [{}, {"roll": 5.0, "distortion": 0.05}])
@pytest.mark.parametrize("bearing", [-12.0, 5.0])
def test_somebody_is_seen_where_they_are_and_goes_again(bearing, given):
    body, angles = neck(scene=GREY, **given), np.array([3.0, -4.0])
    nobody = body.render(angles)
    person = Person(np.full((30, 20), 255, np.uint8), distance=2.0, bearing=bearing, height=0.3, up=-0.1)
    body.gather([person])
    there = np.abs(body.render(angles) - nobody) > 0.1
    rows, columns = np.nonzero(there)
    assert body.spot(person.place(0)[0], angles) == pytest.approx([columns.mean() - 79.5, rows.mean() - 59.5], abs=1.0)
    # 0.2 by 0.3 m, nearly two metres away.
    assert there.sum() == pytest.approx(0.06 * (body.lens.focal / 1.95) ** 2, rel=0.15)
    body.gather([])
    assert np.array_equal(body.render(angles), nobody)


@pytest.mark.parametrize("bearing", [-50.0, 40.0])
def test_whoever_stands_aside_is_turned_to_the_head(bearing):
    body = neck(scene=GREY, camera=(0.0, 0.0, 0.0))
    body.gather([Person(np.full((20, 20), 255, np.uint8), distance=2.0, bearing=bearing, height=0.5, up=0.0)])
    there = body.render(np.array([bearing, 0.0])) > 0.8
    edge = 0.5 / 2.0 * body.lens.focal
    assert there.any(0).sum() == pytest.approx(edge, abs=1.5) and there.any(1).sum() == pytest.approx(edge, abs=1.5)


def test_who_walks_by_is_seen_to_move():
    body = neck(scene=GREY)
    person = Person(np.full((30, 20), 255, np.uint8), distance=1.5, bearing=-15.0, height=0.4, pace=10.0, up=0.0)
    body.gather([person])
    middles = []
    for _ in range(4):
        there = body.look().numpy() > 0.8
        columns = np.nonzero(there.any(0))[0]
        middles.append(columns.mean() - 79.5)
        body.wait(0.5)
    # From -15 to 0 degrees.
    assert np.diff(middles).min() > 10 and middles[-1] == pytest.approx(0, abs=1.5)


def test_who_stands_in_front_hides_the_room_and_is_no_part_of_its_flow():
    body = neck()
    flow = body.flow(np.zeros(2), np.array([3.0, 0.0]))
    body.gather([Person(np.full((9, 9), 200, np.uint8), distance=0.5, height=2.0)])
    assert np.abs(body.look().numpy() * 255 - 200).max() < 2
    assert np.array_equal(body.flow(np.zeros(2), np.array([3.0, 0.0])), flow)


# What may go wrong.


def test_to_close_twice_is_fine():
    body = neck()
    body.close()
    body.close()


def test_heads_have_worlds_of_their_own():
    one, other = neck(), neck(scene=GREY)
    one.turn([0.5, 0.5])
    assert other.angles.tolist() == [0, 0]
    one.close()
    assert np.abs(other.look().numpy() * 255 - 120).max() < 1


def test_without_pybullet_the_extra_is_named(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(stage, "import_module", missing)
    with pytest.raises(ImportError, match=r"^Heads in physics need the extra 'physics': pip install [^\n]*\.$"):
        neck()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"turns": "left"}, "right or up"),
        ({"limit": 0}, "above 0"),
        ({"mass": 0}, "above 0"),
        ({"quickness": 0}, "above 0"),
        ({"quickness": 200}, "not above 120"),
        ({"gain": math.nan}, "right or up"),
        ({"latency": -0.1}, "not below 0"),
        ({"damping": -0.1}, "not below 0"),
        ({"noise": -0.1}, "not below 0"),
    ],
)
def test_bad_joints(given, words):
    with pytest.raises(ValueError, match=words):
        Joint(**{"name": "pan", "turns": "right", "gain": 1.0} | given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"slip": -1.0}, "a head has joints"),
        ({"sensor": -1.0}, "a head has joints"),
        ({"unsteady": -1.0}, "a head has joints"),
        ({"period": 0.0}, "a head has joints"),
        ({"chain": (0,)}, "names each"),
        ({"chain": (0, 0)}, "names each"),
        ({"view": 170.0}, "a view"),
        ({"scene": []}, "a room needs"),
    ],
)
def test_bad_heads(given, words):
    with pytest.raises(ValueError, match=words):
        neck(**given)


def test_a_head_has_joints():
    with pytest.raises(ValueError, match="a head has joints"):
        head()


@pytest.mark.parametrize("command", [[1.0], [1.0, math.nan], [1.0, 2.0, 3.0]])
def test_bad_commands(command):
    with pytest.raises(ValueError, match="2 numbers"):
        neck().step(command)
