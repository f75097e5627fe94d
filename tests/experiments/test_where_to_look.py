"""The studies of where to look, by the command, and how they count."""

import json

import numpy as np
import pytest
import xarray as xr

from apmodels import Camera, Grid, VisualSearch
from controllers import Constant, MostProbable
from experiments.searching import engine_of, error_of, fixations_to, search
from tests.experiments.test_cli import apmodels, one_sentence


def run(folder, study, *words):
    words = f"experiment=where_to_look/{study}", "hydra.run.dir=run", "quick=true", *words
    code, said, complaint = apmodels(folder, *words)
    assert code == 0, complaint
    assert (folder / f"run/{study}.png").stat().st_size > 10_000
    data = xr.open_dataset(folder / f"run/{study}.nc", engine="h5netcdf")
    return json.loads((folder / "run/summary.json").read_text()), data, said


def test_fixations_are_counted_between_looks():
    correct = np.array([[0, 0, 1, 1], [0, 1, 1, 1]], dtype=float)
    # The share of right trials is 0, 0, 1/2, 1, 1 after 0 to 4 fixations.
    assert fixations_to(correct, 0.5) == 2 and fixations_to(correct, 0.75) == 2.5 and fixations_to(correct, 0.25) == 1.5
    assert np.isnan(fixations_to(np.zeros((3, 4)), 0.5))


def test_errors_are_those_of_trials_drawn_anew():
    random = np.random.default_rng(0)
    found = [(random.random((400, 12)) < np.linspace(0.05, 0.95, 12)).astype(float) for _ in range(200)]
    spread = np.std([fixations_to(np.maximum.accumulate(trials, 1), 0.7) for trials in found])
    assert error_of(np.maximum.accumulate(found[0], 1), 0.7) == pytest.approx(spread, rel=0.3)


def test_differences_are_of_the_same_trials():
    random = np.random.default_rng(0)
    one, other = (np.maximum.accumulate(random.random((400, 12)) < np.linspace(0.05, 0.95, 12), 1) for _ in range(2))
    assert error_of(one, 0.7, one) == 0
    assert error_of(one, 0.7, other) == pytest.approx(np.hypot(error_of(one, 0.7), error_of(other, 0.7)), rel=0.2)
    assert np.isnan(error_of(np.zeros((5, 4)), 0.7))


def test_a_search_is_right_as_often_as_it_believes():
    model = VisualSearch(grid=Grid(3, 3))
    engine = engine_of(model)
    data = search(model, engine, MostProbable(engine), 200, 6, seed=1)
    assert data.sizes == {"trial": 1800, "fixation": 6}
    # The mean of P(target) is the mean of the sum of squared beliefs; being right is no less likely than that.
    assert (np.diff(data.correct.mean("trial")) > -0.02).all()
    assert (data.correct.mean("trial") >= data.sure.mean("trial") - 0.02).all()
    again = search(model, engine, MostProbable(engine), 200, 6, seed=1)
    assert data.correct.equals(again.correct)


def test_who_never_moves_finds_less():
    model = VisualSearch(grid=Grid(5, 5), acuity=Camera(2.0, 1.0))
    engine = engine_of(model)
    found, blind = (
        float(search(model, engine, controller, 20, 12, seed=1).correct[:, -1].mean())
        for controller in (MostProbable(engine), Constant(engine, 12))
    )
    # The five cells that are seen may be found, and of twenty others one by chance.
    assert found > 0.8 and blind < 0.4


def test_table_5_1(tmp_path):
    words = "model.grid.rows=4", "model.grid.columns=4", "samples=8"
    found, data, said = run(tmp_path, "table_5_1", *words)
    for name in ("learned", "percent_correct", "entropy_limit", "most_probable", "random"):
        assert name in said and name in found and f"{name}.se" in found
    assert found["random.later"] == pytest.approx(found["random"] - found["learned"])
    assert found["thesis.learned"] == 7.86 and found["learning_seconds"] > 0
    assert data.sizes["trial"] == 64
    # What took long is not done again.
    began = (tmp_path / "run/parts/percent_correct.nc").stat().st_mtime
    again, _, _ = run(tmp_path, "table_5_1", *words)
    assert again["percent_correct"] == found["percent_correct"]
    assert (tmp_path / "run/parts/percent_correct.nc").stat().st_mtime == began


@pytest.mark.parametrize(
    "study, words, keys",
    [
        ("kernel", ["model.grid.rows=5", "model.grid.columns=5"], ["centre", "peak", "peak_at"]),
        (
            "large",
            ["model.grid.rows=5", "model.grid.columns=5"],
            ["information", "information.se", "fixated", "learning_seconds"],
        ),
        ("dynamics", ["model.grid.rows=3", "model.grid.columns=3"], ["still.peak_at", "moving.peak_at"]),
        (
            "acuities",
            ["model.grid.rows=5", "model.grid.columns=5"],
            ["calibrated.peak_at", "camera.peak_at", "human.centre"],
        ),
        (
            "weight_sharing",
            ["model.grid.rows=4", "model.grid.columns=4"],
            ["shared.weights", "free.weights", "trials_over_shared"],
        ),
    ],
)
def test_learning_studies(tmp_path, study, words, keys):
    found, _, _ = run(tmp_path, study, *words)
    assert not [key for key in keys if key not in found]
    if study == "weight_sharing":
        assert (found["shared.weights"], found["free.weights"]) == (10, 256)


def test_one_search(tmp_path):
    found, data, said = run(tmp_path, "search", "fixations=3", "seed=2")
    assert said.count("fixation ") == 3 and found["sure"] == pytest.approx(
        float(data.marginal[-1, int(found["target"])])
    )


@pytest.mark.parametrize("words", [["trials=0"], ["share=2"], ["fixations=3"], ["learning.features=[colour]"]])
def test_bad_tables(tmp_path, words):
    code, _, complaint = apmodels(tmp_path, "experiment=where_to_look/table_5_1", *words)
    assert code == 2 and one_sentence(complaint)


def test_looking_ahead(tmp_path):
    worlds = "~worlds.larger", "~worlds.wandering", "~worlds.contingency", "worlds.still.steps=2"
    code, said, complaint = apmodels(
        tmp_path, "experiment=where_to_look/looking_ahead", "hydra.run.dir=run", "quick=true", *worlds
    )
    assert code == 0, complaint
    found = json.loads((tmp_path / "run/summary.json").read_text())
    assert "blinding" in said and found["blinding.gain"] > 0 and found["still.ms"] > 0
    data = xr.open_dataset(tmp_path / "run/blinding.nc", engine="h5netcdf")
    assert data.sizes == {"controller": 2, "episode": 8, "time": 10}
    code, _, complaint = apmodels(tmp_path, "experiment=where_to_look/looking_ahead", "worlds.still.episodes=1")
    assert code == 2 and one_sentence(complaint)
