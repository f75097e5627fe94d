"""The studies of learning to look, by the command."""

import json

import pytest

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
