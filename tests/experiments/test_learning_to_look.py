"""The studies of learning to look, by the command."""

import json
import resource
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.utils import get_method
from rich.console import Console

from apmodels import LearningToLook, ValueOutOfRange
from experiments import cli, data
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
    assert first_within(np.array([1.0, 0.03]), 0.02) == np.inf


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("two_motors", "seeds=0"),
        ("einstein", "reach=0.6"),
        ("phantom_limbs", "heads.nobody.phantoms=0"),
        ("kidnapped", "kidnapped_after=1"),
        ("crowd", "distances=[2,1]"),
        ("dynamics", "movements=1"),
        ("track", "moves=0"),
        ("noise", "slip=0"),
    ],
)
def test_bad_words_are_told_in_one_sentence(tmp_path, monkeypatch, capfd, name, word):
    """In this process, which is quicker."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["apmodels", f"experiment=learning_to_look/{name}", word])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 2 and one_sentence(capfd.readouterr().err)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("two_motors", "movements=1"),
        ("two_motors", "reach=0"),
        ("two_motors", "scenes=[]"),
        ("two_motors", "scenes=[0,5]"),
        ("einstein", "seeds=0"),
        ("phantom_limbs", "movements=1"),
        ("kidnapped", "kidnapped_after=148"),
        ("kidnapped", "photographs=0"),
        ("crowd", "distances=[]"),
        ("crowd", "distances=[0,1]"),
        ("crowd", "people.count=0"),
        ("dynamics", "seeds=0"),
        ("track", "rest=0.1"),
        ("track", "look_every=0"),
        ("noise", "movements=1"),
    ],
)
def test_nothing_is_begun_that_cannot_be_ended(tmp_path, name, word):
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("config", [f"experiment=learning_to_look/{name}", word])
    with pytest.raises(ValueOutOfRange):
        get_method(config.study)(config, tmp_path, Console(quiet=True))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "word"), [("crowd", "people.count=100000"), ("track", "face=100000")])
def test_there_are_only_so_many_portraits(tmp_path, name, word):
    fetched("tabler")
    test_nothing_is_begun_that_cannot_be_ended(tmp_path, name, word)


def fetched(*names):
    if missing := set(names) - set(data.available()):
        pytest.skip(f"{', '.join(missing)} has not been fetched: run `make data`")


def looked(folder, name, *words):
    """A study end to end, as quick as can be; its summary."""
    pytest.importorskip("pybullet")
    fetched("panorama")
    words = f"experiment=learning_to_look/{name}", "quick=true", "hydra.run.dir=run", *words
    code, said, complaint = apmodels(folder, *words)
    assert code == 0, complaint
    assert "wrote run/summary.json" in said and (folder / f"run/{name}.png").stat().st_size > 10_000
    return json.loads((folder / "run/summary.json").read_text())


@pytest.mark.slow
def test_two_motors(tmp_path):
    found = looked(tmp_path, "two_motors")
    assert 1 <= found["nobody.movements"] <= found["nobody.movements_worst"] <= 25
    assert found["diego.movements"] <= 25 and found["fixation_error"] < 0.05


@pytest.mark.slow
def test_einstein(tmp_path):
    found = looked(tmp_path, "einstein")
    # Not known within 2 % after 25 movements is null.
    assert found["movements"] is None or 5 <= found["movements"] <= 25
    assert found["last_error_median"] < 0.2


@pytest.mark.slow
def test_phantom_limbs(tmp_path):
    assert looked(tmp_path, "phantom_limbs")["phantom_gain"] < 0.1


@pytest.mark.slow
def test_kidnapped(tmp_path):
    if len(data.scenes()) < 6:
        pytest.skip("no scenes have been fetched: run `make data`")
    found = looked(tmp_path, "kidnapped")
    assert found["worst_gain_error"] < 0.15 and 1 <= found["movements_to_match"] <= 6
    assert found["thesis.worst_gain_error"] > found["worst_gain_error"]


@pytest.mark.slow
def test_crowd(tmp_path):
    fetched("tabler")
    found = looked(tmp_path, "crowd", "distances=[1.0,2.8]")
    assert 0 < found["2.8m.covered"] < found["1m.covered"] < 1
    assert found["2.8m.last_error"] < 0.1


@pytest.mark.slow
def test_dynamics(tmp_path):
    found = looked(tmp_path, "dynamics")
    assert found["latency_error_ms"] < 60
    assert all(150 <= found[f"motor_{k}.true_latency_ms"] <= 205 for k in range(1, 6))


@pytest.mark.slow
def test_track(tmp_path):
    fetched("tabler")
    found = looked(tmp_path, "track")
    assert 0 <= found["overshoot.with"] < found["overshoot.without"]
    assert found["seen.with"] > 0.5


@pytest.mark.slow
def test_noise(tmp_path):
    found = looked(tmp_path, "noise")
    assert found["noise_error.fitted"] < 2 and found["noise_error.kalman"] < 2
    assert found["thesis.table_6_2.horizontal.motor_2"] == pytest.approx(0.968)
    for direction in ("horizontal", "vertical"):
        assert sum(found[f"true.{direction}.motor_{k}"] for k in range(1, 6)) == pytest.approx(1)


@pytest.mark.slow
def test_an_hour_of_looking():
    """A movement a second: memory does not grow, beliefs stay sound, and motors stay known."""
    head = PanoramaHead(scenery(), size=(60, 80), slip=1.0)
    engine = RaoBlackwell(LearningToLook(view=(60, 80), field=(180, 240), slip=5.0), particles=1)
    random, belief, place = np.random.default_rng(0), engine.start(), np.zeros(2)
    page, used = resource.getpagesize(), {}
    head.reset(0)
    for movement in range(3601):
        goal = random.uniform(-0.4, 0.4, 2) if movement else place
        command, place = goal - place, goal
        belief = engine.update(belief, torch.as_tensor(command, dtype=torch.float32), head.step(command))
        if movement % 600 == 0:
            used[movement] = page * int(Path("/proc/self/statm").read_text().split()[1])
            for block in belief.gaussian:
                assert (torch.linalg.eigvalsh(block.covariance) > 0).all()
            for images in belief.fields:
                assert all(bool((variance > 0).all() and mean.isfinite().all()) for mean, variance in images.values())
    assert abs(used[3600] - used[600]) < 30e6
    # In the middle of the image, where a unit turns the camera by 60 and 40 degrees: least squares of a small turn.
    true = np.stack([head.flow(np.zeros(2), 2 * step) / 2 for step in np.eye(2)], 1) * [60, 40]
    found = belief.marginal("actuation").mean.numpy()
    assert np.linalg.norm(found - true) / np.linalg.norm(true) < 0.05
