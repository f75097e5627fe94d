"""The studies of learning to look, by the command."""

import json

import cv2
import numpy as np
import pytest

from apmodels import LearningToLook
from experiments.looking import first_within, learn, off
from hardware import PanoramaHead
from inference import RaoBlackwell
from tests.experiments.test_cli import apmodels, one_sentence


def test_human_data(tmp_path):
    code, said, complaint = apmodels(tmp_path, "experiment=learning_to_look/human_data", "hydra.run.dir=run")
    assert code == 0, complaint
    found = json.loads((tmp_path / "run/summary.json").read_text())
    for head in (0.145, 0.25, 0.5, 0.75, 1.0, 1.25):
        # Eq. 6.13 for one direction and two motors.
        eyes, other = 0.145**-2, head**-2
        assert found[f"eye.{head:g}"] == pytest.approx(eyes / (1 + eyes + other), abs=1e-9)
        assert found[f"undershoot.{head:g}"] == pytest.approx(1 / (1 + eyes + other), abs=1e-9)
    assert found["head.inf"] == 0 and found["restrained.1"] == pytest.approx(0.04, abs=1e-3)
    assert "49.48 (49.48)" in said and (tmp_path / "run/human_data.png").stat().st_size > 10_000
    code, _, complaint = apmodels(tmp_path, "experiment=learning_to_look/human_data", "heads=[0]")
    assert code == 2 and one_sentence(complaint)


def scenery(height=500):
    """A panorama that is as detailed as photographs are, coarse and fine."""
    random = np.random.default_rng(0)
    image = np.zeros((height, 2 * height), np.float32)
    for cells in (8, 20, 50):
        coarse = random.normal(size=(cells, 2 * cells)).astype(np.float32)
        image += cv2.resize(coarse, (2 * height, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(127 + 60 * image, 0, 255).astype(np.uint8)


def test_a_head_learns_what_its_motors_do():
    head = PanoramaHead(scenery(), size=(60, 80), slip=1.0, gains=((60, 5), (-4, 40)), roll=2.0)
    engine = RaoBlackwell(LearningToLook(view=(60, 80), field=(180, 240), slip=5.0), particles=1)
    learned = learn(head, engine, movements=16, reach=0.4, seed=3)
    assert learned.sizes == {"movement": 17, "motor": 2, "direction": 2, "fixation": 50}
    assert learned.missed.median() < 0.05
    # What is found is what really was, to a pixel or two.
    astray = np.abs(learned.moved - learned.truth).max("direction").values[1:]
    assert np.nanmean(astray < 3) > 0.9
    wrong = off(learned).values
    assert wrong[0] == 1 and wrong[-1] < 0.05
    again = learn(head, engine, movements=3, reach=0.4, seed=3)
    assert again.actuation.equals(learned.actuation.isel(movement=slice(4)))


def test_when_an_error_is_small_for_the_first_time():
    assert first_within(np.array([1.0, 0.03, 0.02, 0.05]), 0.02) == 2
    assert np.isnan(first_within(np.array([1.0, 0.03]), 0.02))


@pytest.mark.parametrize("words", [["seeds=0"], ["reach=0.6"], ["movements=1"]])
def test_bad_two_motors(tmp_path, words):
    code, _, complaint = apmodels(tmp_path, "experiment=learning_to_look/two_motors", *words)
    assert code == 2 and one_sentence(complaint)
