"""A lens: directions to pixels and back, against formulas, OpenCV, and drawn dots that are looked for."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.lens import Lens, mean_flow

LENSES = [{}, {"roll": 25.0}, {"distortion": 0.2}, {"distortion": -0.2}, {"roll": -8.0, "distortion": 0.45}]


def grid(size):
    """(right, down) of the middle, of all pixels."""
    rows, columns = size
    down, right = np.mgrid[:rows, :columns].astype(float)
    return np.stack([right - (columns - 1) / 2, down - (rows - 1) / 2], -1)


@settings(deadline=None, max_examples=60)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    view=st.floats(5, 140),
    roll=st.floats(-360, 360),
    distortion=st.floats(-0.49, 0.49),
)
def test_every_pixel_is_seen_where_it_looks(size, view, roll, distortion):
    lens = Lens(size, view, roll, distortion)
    assert np.abs(np.linalg.norm(lens.rays, axis=-1) - 1).max() < 1e-5
    assert np.abs(lens.pixels(lens.rays) - grid(size)).max() < 1e-3


def test_without_distortion_it_is_opencvs_pinhole():
    lens = Lens((60, 80), 70.0)
    camera = np.array([[lens.focal, 0, 0], [0, lens.focal, 0], [0, 0, 1]])
    directions = np.random.default_rng(0).normal(size=(50, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    # OpenCV's y is down.
    expected, _ = cv2.projectPoints(directions * [1, -1, 1], np.zeros(3), np.zeros(3), camera, np.zeros(4))
    np.testing.assert_allclose(lens.pixels(directions), expected[:, 0], atol=1e-9)
    # The view is that of the image's width: its edge is half a pixel beyond the last one's middle.
    edge = lens.pixels(np.array([math.tan(math.radians(35)), 0.0, 1.0]))
    assert edge == pytest.approx([40.0, 0.0])


def test_a_camera_that_is_turned_to_the_left_sees_what_is_up_on_the_right():
    lens = Lens((60, 80), 70.0, roll=90.0)
    assert lens.pixels(np.array([0.0, 0.1, 1.0])) == pytest.approx([0.1 * lens.focal, 0.0], abs=1e-9)


def test_a_barrel_loses_its_share_of_the_radius_at_the_corners():
    lens = Lens((60, 80), 70.0, distortion=0.1)
    # A corner is 50 pixels away: what a pinhole would show at 50 / 0.9 is seen there.
    flat = np.array([40, 30]) / 0.9
    assert lens.pixels(np.array([*flat / lens.focal, 1.0])) == pytest.approx([40.0, -30.0])


@pytest.mark.parametrize("given", LENSES)
def test_dots_of_a_pinhole_image_come_where_pixels_says(given):
    lens = Lens((90, 120), 60.0, **given)
    rows, columns = lens.pinhole()
    found = 0
    for x, y in [(0, 0), (20, 10), (-35, 25), (32, -22), (-10, -26)]:
        flat = np.zeros((rows, columns), np.float32)
        column, row = round((columns - 1) / 2 + x), round((rows - 1) / 2 - y)
        flat[row, column] = 1
        flat = cv2.GaussianBlur(flat, (0, 0), 2.0)
        seen = lens.bend(flat)
        assert seen.shape == (90, 120)
        right, up = column - (columns - 1) / 2, (rows - 1) / 2 - row
        expected = lens.pixels(np.array([right, up, lens.focal]))
        if (np.abs(expected) < [52, 37]).all():
            found += 1
            centre = (seen[..., None] * grid(lens.size)).sum((0, 1)) / seen.sum()
            assert np.abs(centre - expected).max() < 0.5
    assert found >= 4


@pytest.mark.parametrize("given", LENSES)
def test_a_pinhole_image_has_all_that_the_lens_shows_and_little_more(given):
    lens = Lens((30, 40), 60.0, **given)
    far = (np.abs(lens.rays[..., :2] / lens.rays[..., 2:]) * lens.focal).max((0, 1))
    middle = (np.array(lens.pinhole())[::-1] - 1) / 2
    assert (far <= middle + 0.01).all() and (far > middle - 1.01).all()


def test_a_plain_lens_leaves_an_image_as_it_is():
    lens, image = Lens((30, 40), 60.0), np.random.default_rng(0).random((30, 40))
    assert lens.pinhole() == (30, 40) and np.array_equal(lens.bend(image), image)


@settings(deadline=None, max_examples=40)
@given(row=st.integers(0, 29), column=st.integers(0, 39), roll=st.floats(-90, 90), distortion=st.floats(-0.4, 0.4))
def test_a_pixels_ray_is_seen_at_it(row, column, roll, distortion):
    lens = Lens((30, 40), 60.0, roll, distortion)
    pixel = np.array([column - 19.5, row - 14.5])
    ray = lens.ray(pixel)
    assert np.abs(lens.pixels(ray) - pixel).max() < 1e-3


def test_what_is_behind_or_beside_is_not_seen():
    lens = Lens((30, 40), 60.0)
    ahead = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 1], [-0.5, 0, 1], [0, 0.5, 1]], dtype=float)
    assert lens.seen(ahead).tolist() == [True, False, False, True, False]


@pytest.mark.parametrize("turn", [-30.0, -2.0, 0.0, 5.0, 20.0])
def test_the_mean_flow_of_a_line_is_by_formula(turn):
    """One row of pixels, turned about the vertical: each goes from f tan(a) to f tan(a + turn)."""
    lens = Lens((1, 101), 60.0)
    x = np.arange(101) - 50.0
    angle = np.arctan(x / lens.focal) + math.radians(turn)
    there = lens.focal * np.tan(angle)
    still = np.abs(there) <= 50 + 1e-6
    directions = np.stack([np.sin(angle), np.zeros(101), np.cos(angle)], -1)[None]
    assert mean_flow(lens, directions) == pytest.approx([(there - x)[still].mean(), 0.0], abs=1e-4)


def test_a_flow_of_which_nothing_is_left_is_not_known():
    lens = Lens((30, 40), 60.0)
    assert np.isnan(mean_flow(lens, -lens.rays)).all()


@pytest.mark.parametrize(
    "given",
    [
        {"view": 0.0},
        {"view": 150.0},
        {"view": math.nan},
        {"distortion": 0.5},
        {"distortion": -0.5},
        {"roll": math.inf},
        {"size": (0, 40)},
    ],
)
def test_bad_lenses(given):
    with pytest.raises(ValueError, match="a view is above 0"):
        Lens(**{"size": (30, 40)} | given)


@pytest.mark.parametrize("pixel", [(20.6, 0.0), (0.0, -15.6)])
def test_there_is_no_ray_outside_of_the_image(pixel):
    with pytest.raises(ValueError, match="there is no pixel"):
        Lens((30, 40)).ray(np.array(pixel))
