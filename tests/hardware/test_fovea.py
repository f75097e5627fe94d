import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import Fovea
from hardware.fovea import PUBLISHED_WINDOWS, Box, halvings, shrink

sides = st.integers(1, 8)
spans = st.lists(st.integers(1, 12), min_size=1, max_size=4).map(tuple)


@st.composite
def foveas(draw, most=200, rules=("fixed", "published")):
    rows, columns = draw(sides), draw(sides)
    shape = draw(st.integers(rows, most)), draw(st.integers(columns, most))
    return Fovea(shape, (rows, columns), draw(spans), draw(st.sampled_from(rules)), draw(st.integers(1, 20_000)))


@settings(deadline=None)
@given(foveas())
def test_windows_lie_inside_around_the_fixation_and_in_each_other(fovea):
    for fixation in range(fovea.cells):
        boxes = fovea.boxes(fixation)
        row, column = fovea.cell_box(fixation)[:2] + fovea.cell_box(fixation)[2:] / 2
        for box in boxes:
            assert 0 <= box.row < box.row + box.height <= fovea.shape[0]
            assert 0 <= box.column < box.column + box.width <= fovea.shape[1]
            assert box.row - 1 <= row <= box.row + box.height + 1  # pixels are whole, cells are not
            assert box.column - 1 <= column <= box.column + box.width + 1
        for outer, inner in itertools.pairwise(boxes):
            if np.diff(fovea.windows).tolist() == sorted(np.diff(fovea.windows)):
                assert outer.height * outer.width >= inner.height * inner.width
        assert len(set(boxes)) <= len(boxes) == len(fovea.spans)


@given(foveas())
def test_cell_mapping_is_inverse_and_every_cell_is_hit(fovea):
    boxes = np.array([fovea.cell_box(cell) for cell in range(fovea.cells)])
    np.testing.assert_array_equal(fovea.cells_of(boxes), np.arange(fovea.cells))
    pixels = np.array([(i, j, 1, 1) for i in range(fovea.shape[0]) for j in range(fovea.shape[1])])
    assert set(fovea.cells_of(pixels)) == set(range(fovea.cells))


def test_cells_by_brute_force():
    fovea = Fovea((50, 37), (7, 5))
    rng = np.random.default_rng(0)
    boxes = np.concatenate([rng.uniform(-5, 40, (200, 2)), rng.uniform(0, 30, (200, 2))], axis=1)
    for (row, column, height, width), cell in zip(boxes, fovea.cells_of(boxes), strict=True):
        i = sum(row + height / 2 >= 50 * k / 7 for k in range(1, 7))
        j = sum(column + width / 2 >= 37 * k / 5 for k in range(1, 5))
        assert cell == i * 5 + j
    assert fovea.cells_of(np.zeros((0, 4))).shape == (0,)


@pytest.mark.parametrize("windows", [(21, 9, 3), PUBLISHED_WINDOWS])
def test_windows_by_brute_force(windows):
    fovea = Fovea((420, 630), windows=windows)  # cells of 20 by 30 pixels
    for fixation in range(441):
        for n, box in zip(windows, fovea.boxes(fixation), strict=True):
            held = [(i, j) for i in range(22 - n) for j in range(22 - n)]
            centre = (n - 1) / 2
            i, j = min(
                held,
                key=lambda at: abs(at[0] + centre - fixation // 21) + abs(at[1] + centre - fixation % 21),
            )
            assert box == (20 * i, 30 * j, 20 * n, 30 * n)


def test_around():
    fovea = Fovea((100, 100), (4, 5))
    assert fovea.around(0).tolist() == [0, 1, 5, 6]
    assert fovea.around(12).tolist() == [6, 7, 8, 11, 12, 13, 16, 17, 18]
    assert fovea.around(14).tolist() == [8, 9, 13, 14, 18, 19]
    assert Fovea((9, 9), (1, 1)).around(0).tolist() == [0]


@given(foveas(most=3000, rules=("fixed",)))
def test_fixed_patches(fovea):
    for box in fovea.boxes(0):
        high, wide = fovea.patch_shape(box)
        assert 1 <= high <= max(1, 2 * box.height) and 1 <= wide <= max(1, 2 * box.width)
        if min(high, wide) > 20:
            assert high * wide < 1.06 * fovea.patch_pixels
            assert abs(high / wide / (box.height / box.width) - 1) < 0.06
            if high < 1.9 * box.height:
                assert high * wide > 0.94 * fovea.patch_pixels


def test_fixed_patches_cost_the_same_whatever_the_image():
    areas = [
        np.prod(fovea.patch_shape(box))
        for shape in [(480, 640), (1024, 1024), (3000, 5000), (10_000, 10_000)]
        for fovea in [Fovea(shape)]
        for box in fovea.boxes(220)
    ]
    assert max(areas) / min(areas) < 1.02


@pytest.mark.parametrize(
    ("shape", "windows", "patch"),
    [
        ((1050, 2100), (21, 15, 9, 3), (150, 300)),  # 3 / 21 of each side
        ((315, 420), (21, 15, 9, 3), (45, 60)),  # just large enough
        ((314, 420), (21, 15, 9), (134, 180)),  # the smallest is not used; the next gives the size
        ((190, 180), (21, 15, 9), (81, 77)),
    ],
)
def test_published_patches(shape, windows, patch):
    fovea = Fovea(shape, windows=PUBLISHED_WINDOWS, patch_rule="published")
    assert fovea.spans == [(n, n) for n in windows]
    assert {fovea.patch_shape(box) for box in fovea.boxes(220)} == {patch}


def test_windows_larger_than_the_grid_are_one():
    assert Fovea((90, 90), (5, 30), (40, 21, 9, 3)).spans == [(5, 30), (5, 21), (5, 9), (3, 3)]
    assert Fovea((90, 90), (3, 3)).spans == [(3, 3)]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"shape": (20, 100)}, "100x20 pixels are fewer than the 21x21 cells"),
        ({"shape": (100, 20)}, "20x100 pixels"),
        ({"grid": (0, 4)}, "nothing to look at"),
        ({"windows": ()}, "nothing to look at"),
        ({"windows": (3, 0)}, "nothing to look at"),
        ({"patch_rule": "other"}, "no patch rule 'other'"),
        ({"patch_pixels": 0}, "patch_pixels must be"),
    ],
)
def test_impossible_foveas(options, reason):
    with pytest.raises(ValueError, match=reason):
        Fovea(**{"shape": (100, 100), **options})


def test_halvings_are_means():
    image = np.random.default_rng(0).integers(0, 256, (13, 22), dtype=np.uint8)
    levels = halvings(image)
    assert [level.shape for level in levels] == [(13, 22), (6, 11), (3, 5), (1, 2)]
    means = image[:12].reshape(6, 2, 11, 2).mean((1, 3))
    np.testing.assert_allclose(levels[1], means, atol=0.76)  # rounded


@settings(deadline=None)
@given(st.data())
def test_shrink_shows_its_region(data):
    height, width = data.draw(st.integers(1, 300)), data.draw(st.integers(1, 300))
    rows, columns = np.mgrid[:height, :width] + 0.5  # a ramp: each pixel holds where its centre is
    image = np.dstack([rows, columns, columns]).astype(np.float32)
    top, left = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
    box = Box(top, left, data.draw(st.integers(1, height - top)), data.draw(st.integers(1, width - left)))
    shape = data.draw(st.integers(1, 60)), data.draw(st.integers(1, 60))
    patch = shrink(halvings(image), box, shape)
    region = patch.region
    assert patch.pixels.shape[:2] == shape
    assert region.row >= 0 and region.row + region.height <= height
    assert region.column >= 0 and region.column + region.width <= width
    step = max(box.height / shape[0], box.width / shape[1], 1)
    assert np.abs(np.subtract(region, box)).max() <= 1.5 * step  # all that whole pixels of a level can cost
    # Where a pixel of the patch is mapped to is where it came from, but at the edge, which is stretched.
    grid = np.indices(shape).reshape(2, -1).T
    mapped = patch.to_image(np.concatenate([grid, np.ones_like(grid)], axis=1))
    centres = (mapped[:, :2] + mapped[:, 2:] / 2).reshape(*shape, 2)
    scale = np.array([region.height, region.width]) / shape
    np.testing.assert_array_less(abs(patch.pixels[..., :2] - centres).max((0, 1)), 0.5 * scale + step + 1e-2)
    inner = (slice(shape[0] // 4 + 1, -shape[0] // 4 - 1), slice(shape[1] // 4 + 1, -shape[1] // 4 - 1))
    if min(shape) > 8 and min(region[2:]) >= 2 * max(shape):
        np.testing.assert_allclose(patch.pixels[inner][..., :2], centres[inner], atol=1e-2)


def test_boxes_in_a_patch_map_back():
    image = np.zeros((600, 900), np.uint8)
    image[300:340, 450:520] = 255
    fovea = Fovea(image.shape)
    for box in fovea.boxes(int(fovea.cells_of(np.array([[300, 450, 40, 70]]))[0])):
        patch = fovea.patch(halvings(image), box)
        rows, columns = np.nonzero(patch.pixels > 127)
        found = [[rows.min(), columns.min(), np.ptp(rows) + 1, np.ptp(columns) + 1]]
        np.testing.assert_allclose(patch.to_image(np.array(found))[0], [300, 450, 40, 70], atol=box.height / 100)


@pytest.mark.parametrize("rule", ["fixed", "published"])
@pytest.mark.parametrize("colours", [(), (3,)])
def test_reconstruction_is_fine_at_the_fixation_and_coarse_far_away(rule, colours):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (504, 630, *colours), dtype=np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 1.5)
    fovea = Fovea(image.shape[:2], patch_rule=rule)
    fixation = 5 * 21 + 5
    rebuilt = fovea.reconstruct(image, fixation)
    assert rebuilt.shape == image.shape and rebuilt.dtype == np.uint8
    errors = [
        np.abs(rebuilt[box.row : box.row + box.height, box.column : box.column + box.width].astype(int)
               - image[box.row : box.row + box.height, box.column : box.column + box.width]).mean()
        for box in fovea.boxes(fixation)
    ]  # fmt: skip
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1


def test_reconstruction_without_a_wide_window_is_black_outside():
    rebuilt = Fovea((210, 210), windows=(3,)).reconstruct(np.full((210, 210), 9, np.uint8), 220)
    assert (rebuilt[90:120, 90:120] == 9).all() and rebuilt.sum() == 9 * 900
