"""A room: where rays meet its walls, and what hangs on them."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import PanoramaHead, Room
from hardware.physics_head import Joint, PhysicsHead

GREYS = [20, 60, 100, 140, 180, 220]


def scenery(height=500):
    """A panorama that is as detailed as photographs are, coarse and fine."""
    random, image = np.random.default_rng(0), np.zeros((height, 2 * height), np.float32)
    for cells in (8, 20, 50):
        coarse = random.normal(size=(cells, 2 * cells)).astype(np.float32)
        image += cv2.resize(coarse, (2 * height, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(127 + 50 * image, 0, 255).astype(np.uint8)


def turning(scene, **settings):
    """A camera that turns in one place, in the middle of the room."""
    pytest.importorskip("pybullet")
    joints = [Joint("pan", "right", 1.0, limit=180), Joint("tilt", "up", 1.0, limit=90)]
    return PhysicsHead(joints, scene, **{"size": (120, 160), "slip": 0.0, "sensor": 0.0} | settings)


one = st.floats(-1, 1)


@settings(deadline=None, max_examples=60)
@given(
    # Small: to paint large walls takes long.
    size=st.tuples(*[st.floats(0.1, 1.5)] * 3),
    share=st.floats(0.05, 0.95),
    place=st.tuples(*[st.floats(-0.98, 0.98)] * 3),
    direction=st.tuples(*[st.one_of(st.just(0.0), one)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-3),
)
def test_a_ray_meets_the_first_wall_on_its_way(size, share, place, direction):
    room = Room([np.zeros((4, 4), np.uint8)], size=size, eyes=share * size[2])
    low = np.array([-size[0] / 2, -size[1] / 2, -share * size[2]])
    high = low + size
    origin, direction = (low + high) / 2 + np.array(place) * (high - low) / 2, np.array(direction)
    hit = room.hit(origin, direction)
    # On the ray, ahead;
    assert np.linalg.norm(np.cross(hit - origin, direction)) < 1e-9 * np.linalg.norm(size)
    assert (hit - origin) @ direction > 0
    # in the room, on a wall.
    assert (hit >= low - 1e-9).all() and (hit <= high + 1e-9).all()
    assert min(np.abs(hit - low).min(), np.abs(hit - high).min()) < 1e-9


def test_many_rays_are_met_as_one_by_one():
    room = Room([np.zeros((4, 4), np.uint8)])
    rays, origin = np.random.default_rng(0).normal(size=(3, 5, 3)), np.array([0.3, -0.2, 0.1])
    together = room.hit(origin, rays)
    assert all(np.allclose(together[i, j], room.hit(origin, rays[i, j])) for i in range(3) for j in range(5))


@pytest.mark.parametrize("size", [(6.0, 6.0, 3.0), (5.0, 8.0, 3.5)])
def test_in_a_panorama_it_looks_as_where_the_panorama_was_taken(size):
    picture = scenery()
    here = turning(Room(picture, size=size))
    there = PanoramaHead(picture, size=(120, 160), slip=0, sensor=0, limits=(180.0, 90.0))
    for angles in ((0, 0), (30, 10), (-75, -20), (135, 25), (180, 0), (20, -40), (0, 45)):
        one, other = (head.render(np.array(angles, dtype=float)) for head in (here, there))
        assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.98, angles
        assert np.abs(one - other).mean() < 0.025, angles


def test_photographs_hang_ahead_right_behind_left_below_and_above():
    head = turning([np.full((10, 20), grey, np.uint8) for grey in GREYS])
    looks = [(0, 0), (90, 0), (180, 0), (-90, 0), (0, -90), (0, 90)]
    seen = [head.render(np.array(look, dtype=float))[40:80, 60:100] for look in looks]
    for image, grey in zip(seen, GREYS, strict=True):
        assert np.abs(image * 255 - grey).max() <= 1


def test_few_photographs_are_hung_again():
    room = Room([np.full((10, 20), grey, np.uint8) for grey in GREYS[:2]])
    assert [int(surface.picture.mean()) for surface in room.surfaces] == [20, 60, 20, 60, 20, 60]


def test_a_picture_is_neither_mirrored_nor_upside_down():
    """Four quarters of a wall, each of its own grey."""
    quarters = np.kron(np.array([[40, 90], [150, 230]], np.uint8), np.ones((50, 50), np.uint8))
    head = turning(Room([quarters], size=(4.0, 4.0, 4.0), eyes=2.0), view=60.0)
    for turn in (0.0, 90.0, 180.0, -90.0):
        seen = head.render(np.array([turn, 0.0])) * 255
        corners = [seen[20, 30], seen[20, 130], seen[100, 30], seen[100, 130]]
        assert corners == pytest.approx([40, 90, 150, 230], abs=1)


def test_a_panorama_is_turned_to_the_left():
    """What was on the right-hand wall is ahead."""
    picture = scenery()
    plain, turned = Room(picture), Room(picture, turned=90.0)
    assert np.abs(turned.surfaces[0].picture.astype(float) - plain.surfaces[1].picture).max() <= 2
    assert np.abs(turned.surfaces[3].picture.astype(float) - plain.surfaces[0].picture).max() <= 2
    assert np.abs(turned.surfaces[0].picture.astype(float) - plain.surfaces[0].picture).mean() > 20


def test_colours_are_seen_as_greys(tmp_path):
    red = np.zeros((10, 20, 3), np.uint8)
    red[..., 0] = 255
    path = tmp_path / "red.png"
    cv2.imwrite(str(path), red[..., ::-1])
    for room in (Room([red]), Room([str(path)]), Room(red), Room(str(path))):
        assert all((surface.picture == 76).all() for surface in room.surfaces)


@pytest.mark.parametrize(
    ("scene", "given"),
    [
        ([], {}),
        ([np.zeros((4, 4), np.uint8)], {"size": (0.0, 6.0, 3.0)}),
        ([np.zeros((4, 4), np.uint8)], {"eyes": 3.0}),
        ([np.zeros((4, 4), np.uint8)], {"eyes": 0.0}),
        ([np.zeros((4, 4))[:0]], {}),
        ("nowhere.jpg", {}),
    ],
)
def test_bad_rooms(scene, given):
    with pytest.raises(ValueError, match=r"a room|photo|does not exist"):
        Room(scene, **given)
