"""The agreement study, by the command: what it writes, that it goes on where it stopped, and that it can disagree."""

import json

import pytest
import xarray as xr

from experiments import agreement
from experiments.agreement_models import models
from tests.experiments.test_cli import apmodels, one_sentence


def test_the_command_writes_a_table_a_map_and_the_keys(tmp_path):
    words = ("experiment=agreement", "quick=true", "models=[tiger,line]", "worlds=1000", "hydra.run.dir=run")
    code, said, _ = apmodels(tmp_path, *words)
    assert code == 0 and "tiger" in said and "enumeration of worlds" in said
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    for key in ("tiger.Exact", "tiger.Particles", "line.Kalman", "line.Variational"):
        assert f"{key}.error" in summary and f"{key}.evidence_error" in summary
    assert "line.Exact.error" not in summary
    assert summary["tiger.Exact.error"] < 1e-9 and summary["line.Kalman.evidence_error"] < 1e-9
    assert 0 < summary["tiger.Particles.error"] < 0.1
    data = xr.open_dataset(tmp_path / "run/agreement.nc", engine="h5netcdf")
    assert float(data.error.sel(model="line", engine="Kalman")) == summary["line.Kalman.error"]
    assert (tmp_path / "run/agreement.png").stat().st_size > 10_000 and not (
        tmp_path / f"run/{agreement.KEPT}"
    ).exists()


@pytest.mark.parametrize(
    ("word", "says"), [("models=[tigre]", "tiger"), ("records=0", "1 record"), ("steps=0", "1 step")]
)
def test_a_wrong_choice_is_told_in_one_sentence(tmp_path, word, says):
    code, _, complaint = apmodels(tmp_path, "experiment=agreement", "quick=true", word)
    assert code == 2 and one_sentence(complaint) and says in complaint


class Config:
    models = ["tiger"]
    steps, records, worlds, seed, quick = 2, 1, 1000, 0, True


def test_what_a_stopped_run_has_done_is_not_done_again(tmp_path, monkeypatch):
    kept = {"method": "memory", "reference_error": 0.0, "engines": {"Exact": [0.5, 0.25]}, "allowed": {"Exact": False}}
    setting = {"seed": 0, "steps": 2, "records": 1, "worlds": 1000, "quick": True}
    (tmp_path / agreement.KEPT).write_text(json.dumps({"setting": setting, "figures": {"tiger": kept}}))
    assert agreement._figures(Config, tmp_path, {"tiger": models()["tiger"]}) == {"tiger": kept}
    other = setting | {"seed": 1}
    (tmp_path / agreement.KEPT).write_text(json.dumps({"setting": other, "figures": {"tiger": kept}}))
    assert (
        agreement._figures(Config, tmp_path, {"tiger": models()["tiger"]})["tiger"]["method"] == "enumeration of worlds"
    )


def test_every_structure_is_among_the_models():
    plans = {node.plan for model in models().values() for node in model.structure.hidden}
    assert plans == {"enumerated", "counted", "integrated", "sampled"}
