"""The studies of chapter 4, by the command."""

import json

import numpy as np
import pytest
import xarray as xr

from tests.experiments.test_cli import apmodels, one_sentence


def run(folder, study, *words):
    code, said, complaint = apmodels(folder, f"experiment=contingency/{study}", "hydra.run.dir=run", *words)
    assert code == 0, complaint
    assert (folder / f"run/{study}.png").stat().st_size > 10_000
    data = xr.open_dataset(folder / f"run/{study}.nc", engine="h5netcdf")
    return json.loads((folder / "run/summary.json").read_text()), data, said


def test_a_longer_horizon_knows_more(tmp_path):
    found, data, said = run(tmp_path, "horizons", "quick=true", "horizons=[1,4,8,16]", "timed=[8,40]")
    known = data.final_information.values
    assert (np.diff(known) > 0).all() and (data.mean_information.values <= known + 1e-12).all()
    assert "a plan over 40 steps" in said
    for key in ("seconds.40", "seconds.100", "seconds.200", "peak_gb.200", "seconds.300", "exponent"):
        assert key in found
    # What was not measured is told, and not made up.
    assert found["seconds.200"] is None and found["seconds.40"] > 0


def test_the_best_policy_is_not_quite_a_rule_of_thumb(tmp_path):
    found, data, _ = run(tmp_path, "optimal", "quick=true")
    for reward in ("summed", "terminal"):
        assert 0 < found[f"{reward}.calls"] < 0.5
        share = found[f"{reward}.calls"]
        parts = found[f"{reward}.agreement_on_calls"], found[f"{reward}.agreement_on_silences"]
        assert found[f"{reward}.agreement"] == pytest.approx(share * parts[0] + (1 - share) * parts[1])
        best = data[reward].sel(score=["calls", "silences"]).mean("score").max()
        assert float(best) == pytest.approx(np.mean(parts))


def test_one_step_ahead_nobody_calls(tmp_path):
    found, _, _ = run(tmp_path, "greedy_never_calls", "quick=true", "steps=20")
    assert found["greedy.calls"] == 0 and abs(found["greedy.information"]) < 1e-9
    assert found["planned.calls"] > 1


def test_baby_9_finds_out(tmp_path):
    found, data, said = run(tmp_path, "baby9", "horizon=12")
    assert found["calls"] == found["whole.calls"] == float(data.call.sel(reading="whole").sum())
    assert found["responsive"] > 0.99 > found["first.responsive"]
    # Nobody calls again while an answer may come.
    assert (np.diff(data.time.values[data.call.sel(reading="whole").values == 1]) > 3 * 0.8).all()
    assert "Baby" not in said and "calls" in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("experiment=contingency/horizons", "horizons=[0]"), "1 step"),
        (("experiment=contingency/optimal", "between=[30,50]"), "between must lie within"),
        (("experiment=contingency/greedy_never_calls", "episodes=0"), "1 episode"),
        (("experiment=contingency/baby9", "model.window=[3,1]"), "echo must end before"),
        (("experiment=contingency/learning", "memory=[0]"), "step remembered"),
        (
            ("experiment=contingency/learning", "session.steps=5", "quick=true", "horizons=[6]", "calls=100"),
            "a session",
        ),
    ],
)
def test_what_makes_no_sense_is_one_sentence(tmp_path, words, says):
    code, _, complaint = apmodels(tmp_path, *words)
    assert code == 2 and one_sentence(complaint) and says in complaint


def test_it_can_be_learned(tmp_path):
    words = ("quick=true", "horizons=[6,8]", "calls=20000")
    found, data, said = run(tmp_path, "learning", *words)
    assert found["td6.calls"] < found["td8.calls"] < found["td12.calls"]
    assert found["td12.calls"] < found["optimism_1.td12.calls"]
    for name in ("", "memory_8."):
        assert 0.9 < found[f"{name}receding.fraction"] <= found[f"{name}receding.limit"] + 0.005 < 1
        assert found[f"{name}receding.fraction"] < found[f"{name}receding.reward_fraction"] < 1
        assert found[f"{name}receding.calls"] <= 20000 + 100 and found[f"{name}receding.calls.se"] is None
    assert found["best.fraction"] == pytest.approx(1, abs=1e-9)
    # Nobody is sure so soon; a guess is never better than that of the best plan, and silence tells nothing.
    assert all(found[f"accuracy.steps.{name}"] is None for name in ("infomax", "best", "random", "silent"))
    right = {name: data[f"{name}_accuracy"].values for name in ("infomax", "best", "random", "silent")}
    assert (right["silent"] == pytest.approx(0.5)) and right["random"][-1] < right["infomax"][-1] <= 0.8
    assert np.allclose(data.spent.sum("doing"), np.arange(1, 21))
    assert data.calls.sizes == {"optimism": 2, "horizon": 3, "run": 1} and "are learned in" in said.replace("\n", " ")


def test_somebody_is_identified(tmp_path):
    words = ("quick=true", "horizons=[6]", "calls=2000", "memory=[4]", "accuracy.share=0.65", "optimism=[0.2]")
    found, data, said = run(tmp_path, "learning", *words)
    steps = {name: found[f"accuracy.steps.{name}"] for name in ("infomax", "best", "random", "silent")}
    assert steps["silent"] is None and steps["random"] is None and steps["best"] <= 20
    right = data.infomax_accuracy.values
    reached = int(steps["infomax"])
    assert right[reached - 1] >= 0.65 > right[reached - 2]
    spent = [found[f"accuracy.{name}"] for name in ("acting", "exploring", "listening")]
    assert sum(spent) == pytest.approx(reached) and min(spent) > 0 and "of guesses are right" in said.replace("\n", " ")
