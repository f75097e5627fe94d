import pickle

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from skimage.data import astronaut, chelsea, coffee, rocket

from hardware import CascadeDetector, LBPDetector, PhotoError, PhotoEye, whole_image
from hardware.detectors import group


class Blobs:
    """A fake detector: a box around every white spot; it remembers what it was shown."""

    def __init__(self):
        self.shown = []

    def __call__(self, image):
        self.shown.append(image.shape)
        _, _, spots, _ = cv2.connectedComponentsWithStats((image > 60).astype(np.uint8))
        return [(y, x, h, w) for x, y, w, h, _ in spots[1:]]


def spots(*cells, shape=(420, 630), grid=(21, 21)):
    """A black picture with a white spot in the middle of each of these cells."""
    image = np.zeros(shape, np.uint8)
    for cell in cells:
        row, column = ((divmod(cell, grid[1]) + np.array(0.5)) * np.array(shape) / grid).astype(int)
        image[row - 7 : row + 7, column - 7 : column + 7] = 255
    return image


@pytest.fixture(scope="module")
def large_astronaut():
    return cv2.resize(astronaut(), (1024, 1024), interpolation=cv2.INTER_CUBIC)


def test_observation_counts_boxes_of_all_windows():
    eye = PhotoEye(spots(220, 222, 0), Blobs())
    observation = eye.step(220)
    assert observation.shape == (441,) and observation.dtype == torch.float32
    expected = torch.zeros(441)
    expected[220], expected[222], expected[0] = 3, 2, 1  # in all three windows, in two, in the widest
    torch.testing.assert_close(observation, expected)
    torch.testing.assert_close(eye.step(torch.tensor(0)), torch.tensor([3.0]).new_zeros(441).index_put(
        (torch.tensor([0, 220, 222]),), torch.tensor([3.0, 1, 1])))  # fmt: skip
    assert eye.fixations == [220, 0] and len(eye.milliseconds) == 2
    assert len(eye.boxes) == 3 + 2 + 1 + 2 and eye.box_fixations.tolist() == [220] * 6 + [0] * 2
    np.testing.assert_array_equal(np.unique(eye.fovea.cells_of(eye.boxes)), [0, 220, 222])


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 440), st.integers(0, 440))
def test_a_fixated_spot_is_seen_in_every_window(cell, other):
    counts = PhotoEye(spots(cell), Blobs()).step(cell)
    assert counts[cell] == counts.sum() == 3
    assert PhotoEye(spots(cell), Blobs()).step(other)[cell] >= 1


def test_counts_are_clipped():
    eye = PhotoEye(np.zeros((50, 50)), lambda image: [(0, 0, 2, 2)] * 7)
    assert eye.step(0)[0] == 9
    assert PhotoEye(np.zeros((50, 50)), lambda image: [(0, 0, 2, 2)] * 7, max_count=4).step(0)[0] == 4


def test_each_window_is_searched_once_until_reset():
    detector = Blobs()
    eye = PhotoEye(spots(220), detector)
    first = eye.step(220)
    assert len(detector.shown) == 3
    eye.step(221)
    assert len(detector.shown) == 5  # the widest window is the same from everywhere
    torch.testing.assert_close(eye.step(220), first)
    assert len(detector.shown) == 5
    eye.reset(seed=1)
    assert eye.fixations == [] and eye.boxes.shape == (0, 4) and eye.box_fixations.shape == (0,)
    torch.testing.assert_close(eye.step(220), first)
    assert len(detector.shown) == 8
    eye.close()


def test_other_grids_and_the_published_rule():
    eye = PhotoEye(spots(7, shape=(300, 500), grid=(3, 5)), Blobs(), grid=(3, 5), windows=(5, 1))
    assert eye.step(7).shape == (15,) and eye.step(7)[7] == 2
    detector = Blobs()
    PhotoEye(np.zeros((630, 840)), detector, windows=(21, 15, 9, 3), patch_rule="published").step(0)
    assert detector.shown == [(90, 120)] * 4
    detector.shown.clear()
    PhotoEye(np.zeros((630, 840)), detector, patch_pixels=1000).step(0)
    assert all(900 < height * width < 1100 for height, width in detector.shown)


@pytest.mark.parametrize(
    "action",
    [
        -1,
        441,
        float("nan"),
        float("inf"),
        1.5,
        None,
        "4",
        torch.tensor(float("nan")),
        torch.tensor([1, 2]),
        [3],
    ],
)
def test_actions_outside_the_grid(action):
    eye = PhotoEye(np.zeros((50, 50)), Blobs())
    for verb in (eye.step, eye.confirm, eye.reconstruct):
        with pytest.raises(ValueError, match=r"^An action is one cell, 0 to 440, and this is .*\.$"):
            verb(action)
    assert eye.fixations == []


@pytest.mark.parametrize("action", [3, np.int64(3), torch.tensor(3), torch.tensor(3.0), np.float32(3)])
def test_actions_of_any_kind(action):
    eye = PhotoEye(np.zeros((50, 50)), Blobs())
    eye.step(action)
    assert eye.fixations == [3] and isinstance(eye.fixations[0], int)


@pytest.mark.parametrize("shape", [(20, 20), (1, 1), (20, 300), (300, 20)])
def test_photos_smaller_than_the_grid(tmp_path, shape):
    path = tmp_path / "small.png"
    Image.fromarray(np.zeros(shape, np.uint8)).save(path)
    size = f"{shape[1]}x{shape[0]}"
    with pytest.raises(PhotoError, match=rf"small\.png' is {size} pixels, smaller than the 21x21 grid"):
        PhotoEye(path)
    with pytest.raises(PhotoError, match=rf"^The photo is {size} pixels, smaller than"):
        PhotoEye(np.zeros(shape, np.uint8))


def test_the_smallest_photo_and_bad_settings():
    for detector in (CascadeDetector(), LBPDetector()):
        eye = PhotoEye(np.zeros((21, 21)), detector)
        assert eye.step(0).sum() == 0 and eye.confirm(0) is None
    for options in ({"max_count": 0}, {"support": 0}):
        with pytest.raises(ValueError, match="must be 1 or more"):
            PhotoEye(np.zeros((50, 50)), **options)
    with pytest.raises(PhotoError, match="does not exist"):
        PhotoEye("nowhere.jpg")
    with pytest.raises(ValueError, match=r"must answer with finite boxes"):
        PhotoEye(np.zeros((50, 50)), lambda image: [1, 2]).step(0)


def test_confirm_needs_support_and_looks_at_the_right_place():
    eye = PhotoEye(spots(220, 50), Blobs(), support=1)
    assert eye.confirm(220) is None  # nothing has been seen yet
    eye.step(220)
    box = eye.confirm(241)  # a neighbouring cell
    np.testing.assert_allclose(box, [203, 308, 14, 14], atol=3)
    assert eye.confirm(400) is None
    eye.support = 2
    assert eye.confirm(220) is None


@pytest.mark.parametrize("box", [(-50, -50, 10, 10), (500, 700, 20, 20), (5, 5, 0, 0), (0, 0, 9999, 9999)])
def test_confirm_survives_odd_boxes(box):
    eye = PhotoEye(np.zeros((420, 630)), lambda image: [box], support=1)
    eye.step(0)
    for cell in range(441):
        eye.confirm(cell)


def test_reconstruct():
    eye = PhotoEye(astronaut())
    rebuilt = eye.reconstruct(93)
    assert rebuilt.shape == eye.image.shape and rebuilt.dtype == np.uint8
    error = np.abs(rebuilt.astype(int) - eye.image).mean(2)
    assert error[80:120, 200:240].mean() < 2 < 6 < error[300:, 300:].mean()


@pytest.mark.parametrize("detector", [CascadeDetector(scale_factor=1.3), LBPDetector()])
def test_any_detector_finds_the_astronaut(detector, large_astronaut):
    eye = PhotoEye(large_astronaut, detector, support=1)
    counts = eye.step(220) + eye.step(93) + eye.step(94)
    assert counts[eye.fovea.around(93)].sum() >= 3
    row, column = eye.confirm(93)[:2] + eye.confirm(93)[2:] / 2
    assert abs(row - 228) < 1024 / 21 and abs(column - 448) < 1024 / 21
    pickle.loads(pickle.dumps(eye)).step(0)


def test_as_right_as_the_whole_image(large_astronaut):
    box, _ = whole_image(large_astronaut)
    assert box is not None
    eye = PhotoEye(large_astronaut)
    face = int(eye.fovea.cells_of(box[None])[0])
    counts = eye.step(220) + eye.step(face) + eye.step(face + 1)
    assert counts.argmax() in eye.fovea.around(face)
    for found in (eye.confirm(face), group(eye.boxes, 2)[0][0]):
        assert found is not None
        assert (abs(found[:2] + found[2:] / 2 - box[:2] - box[2:] / 2) < 1024 / 21).all()


@pytest.mark.parametrize("photo", [coffee, chelsea, rocket])
def test_nothing_confirms_without_a_face(photo):
    eye = PhotoEye(photo())
    for cell in range(0, 441, 20):
        eye.step(cell)
    assert all(eye.confirm(cell) is None for cell in range(441))


def test_whole_image_of_nothing():
    box, milliseconds = whole_image(np.zeros((60, 60)))
    assert box is None and milliseconds > 0
    box, _ = whole_image(spots(220), Blobs(), support=1)
    np.testing.assert_allclose(box, [203, 308, 14, 14])
