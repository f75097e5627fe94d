import pickle

import cv2
import numpy as np
import pytest
from skimage.data import astronaut

from hardware import CascadeDetector, Detector, LBPDetector
from hardware.detectors import detect, group


@pytest.fixture(scope="module")
def grey():
    return cv2.cvtColor(cv2.resize(astronaut(), (256, 256), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)


@pytest.mark.parametrize("detector", [CascadeDetector(), CascadeDetector(scale_factor=1.3), LBPDetector()])
def test_finds_the_astronaut(detector: Detector, grey):
    boxes = detector(grey)
    assert boxes.dtype == float and boxes.ndim == 2 and boxes.shape[1] == 4
    assert (boxes[:, :2] >= 0).all() and (boxes[:, :2] + boxes[:, 2:] <= 256).all()
    centres = boxes[:, :2] + boxes[:, 2:] / 2
    assert (np.hypot(*(centres - [57, 112]).T) < 10).any()


def test_rows_come_first(grey):
    top_half_only = np.vstack([grey[:128], np.zeros((200, 256), np.uint8)])
    centres = group(CascadeDetector()(top_half_only), 3)[0]
    assert centres[0, 0] < centres[0, 1]  # the face is at row 33, column 88


def test_neighbours_and_sizes(grey):
    raw = CascadeDetector()(grey)
    assert len(raw) > 10 * len(CascadeDetector(min_neighbors=3)(grey)) > 0
    assert CascadeDetector(min_size=45)(grey)[:, 2].min() >= 45 > raw[:, 2].min()


@pytest.mark.parametrize("detector", [CascadeDetector(), LBPDetector()])
@pytest.mark.parametrize("shape", [(1, 1), (19, 19), (24, 24), (2, 300), (64, 64)])
def test_nothing_in_small_or_flat_images(detector, shape):
    assert detector(np.zeros(shape, np.uint8)).shape == (0, 4)


@pytest.mark.parametrize("detector", [CascadeDetector(scale_factor=1.2, min_size=24), LBPDetector(min_size=30)])
def test_pickles_whether_used_or_not(detector, grey):
    fresh = pickle.loads(pickle.dumps(detector))
    expected = detector(grey)
    used = pickle.loads(pickle.dumps(detector))
    assert fresh == used == detector
    for copy in (fresh, used):
        np.testing.assert_array_equal(copy(grey), expected)


def test_unknown_cascade_names_the_nearest():
    with pytest.raises(ValueError, match=r"no cascade 'haarcascade_frontface'.*haarcascade_frontalface_alt"):
        CascadeDetector("haarcascade_frontface")
    with pytest.raises(ValueError, match=r"no cascade '' *; the nearest are haarcascade_eye"):
        CascadeDetector("")


@pytest.mark.parametrize(
    "options",
    [{"scale_factor": 1.0}, {"scale_factor": float("nan")}, {"min_neighbors": -1}, {"min_size": 0}],
)
def test_numbers_out_of_range(options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))} must be"):
        CascadeDetector(**options)


def test_any_callable_is_a_detector_and_is_held_to_it(grey):
    assert detect(lambda image: [], grey).shape == (0, 4)
    assert detect(lambda image: [(1, 2, 3, 4)], grey).tolist() == [[1, 2, 3, 4]]
    for wrong in ([1, 2, 3, 4], [[1, 2, 3]], [[1, 2, 3, np.nan]], np.zeros((2, 2, 4))):
        with pytest.raises(ValueError, match="must answer with finite boxes"):
            detect(lambda image, wrong=wrong: wrong, grey)


def test_group_merges_counts_and_orders():
    one, two = np.array([10.0, 20, 50, 50]), np.array([200.0, 100, 30, 30])
    shift = np.array([1, 1, 0, 0])
    boxes = np.stack([one, two, one + 1, two + shift, one + 2 * shift, [300, 300, 9, 9]])
    merged, counts = group(boxes, 2)
    assert counts.tolist() == [3, 2]
    np.testing.assert_allclose(merged, [one + shift, two], atol=1)
    assert group(boxes, 1)[1].tolist() == [3, 2, 1]
    assert group(boxes, 4)[0].shape == (0, 4)
    assert group(np.zeros((0, 4)), 1)[0].shape == (0, 4)


def test_group_agrees_with_the_cascades_own_rule(grey):
    merged, counts = group(CascadeDetector()(grey), 4)
    theirs = CascadeDetector(min_neighbors=3)(grey)
    assert (np.diff(counts) <= 0).all() and len(merged) == len(theirs)
    np.testing.assert_allclose(merged[np.lexsort(merged.T)], theirs, atol=1)
