"""A head in a panorama: its geometry against closed forms and against what images tell."""

import math

import cv2
import numpy as np
import pytest
import torch

from hardware import PanoramaHead


def scenery(height=720, seed=0):
    random = np.random.default_rng(seed)
    coarse = random.uniform(0, 255, (height // 12, height // 6)).astype(np.float32)
    return cv2.resize(coarse, (2 * height, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def head(**settings):
    return PanoramaHead(scenery(), **{"size": (120, 160), "slip": 0.0, "sensor": 0.0} | settings)


def test_a_mark_is_seen_where_it_is():
    image = np.zeros((900, 1800), np.uint8)
    image[900 // 2 - int(10 / 180 * 900), 1800 // 2 + int(15 / 360 * 1800)] = 255
    image = cv2.GaussianBlur(image, (0, 0), 3)
    seen = PanoramaHead(image * (255.0 / image.max()) / 255, size=(240, 320), slip=0, sensor=0).render(np.zeros(2))
    row, column = np.unravel_index(seen.argmax(), seen.shape)
    focal = 160 / math.tan(math.radians(25))
    assert column - 159.5 == pytest.approx(focal * math.tan(math.radians(15)), abs=2)
    assert 119.5 - row == pytest.approx(focal * math.tan(math.radians(10)) / math.cos(math.radians(15)), abs=2)


@pytest.mark.parametrize("settings", [{}, {"roll": 20.0}, {"distortion": 0.1}, {"roll": -8.0, "distortion": 0.15}])
@pytest.mark.parametrize("turn", [(4.0, 0.0), (0.0, -5.0), (3.0, 3.0)])
def test_what_is_seen_moves_as_is_said(settings, turn):
    eye = head(**settings)
    before, after = eye.render(np.zeros(2)), eye.render(np.array(turn))
    expected = eye.flow(np.zeros(2), np.array(turn))
    window = cv2.createHanningWindow((160, 120), cv2.CV_64F)
    found, _ = cv2.phaseCorrelate(before.astype(float), after.astype(float), window)
    assert np.abs(np.array(found) - expected).max() < 1.5


def test_what_is_followed_is_where_it_is_seen():
    eye = head(roll=5.0, distortion=0.05)
    before, after = np.array([2.0, -1.0]), np.array([6.0, 2.0])
    first, second = eye.render(before), eye.render(after)
    patch = first[50:70, 90:110]
    score = cv2.matchTemplate(second, patch, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(score.argmax(), score.shape)
    found = np.array([column, row]) + 9.5 - np.array([79.5, 59.5])
    expected = eye.follow(np.array([99.5 - 79.5, 59.5 - 59.5]), before, after)
    assert np.abs(found - expected).max() < 1.5


def test_motors_add_up_and_stop_at_their_limits():
    eye = head(gains=((10.0, 5.0, 0.0), (0.0, 2.0, -20.0)), limits=(12.0, 30.0))
    eye.step(torch.tensor([0.5, 1.0, 0.25]))
    assert eye.angles.tolist() == pytest.approx([10.0, -3.0]) and eye.motors == 3
    eye.step([1.0, 0.0, 0.0])
    assert eye.angles.tolist() == pytest.approx([12.0, -3.0])


def test_slip_is_in_pixels_and_seeds_reproduce():
    eye = head(slip=5.0, limits=(170.0, 80.0))
    ends = []
    for seed in range(300):
        eye.reset(seed)
        eye.turn([0.1, 0.0])
        ends.append(eye.angles.copy())
    spread = np.radians(np.std(ends, 0)) * eye.focal
    assert spread == pytest.approx([5.0, 5.0], rel=0.15)
    eye.reset(7)
    one = eye.step([0.1, 0.1])
    eye.reset(7)
    assert torch.equal(one, eye.step([0.1, 0.1])) and one.shape == (120, 160) and one.dtype == torch.float32


@pytest.mark.parametrize("given", [{"gains": ((1.0,),)}, {"view": 180.0}, {"slip": -1.0}, {"distortion": 0.7}])
def test_bad_heads(given):
    with pytest.raises(ValueError, match=r"gains|view|noise"):
        head(**given)


@pytest.mark.parametrize("command", [[1.0], [1.0, math.nan], [1.0, 2.0, 3.0]])
def test_bad_commands(command):
    with pytest.raises(ValueError, match="2 numbers"):
        head().step(command)
