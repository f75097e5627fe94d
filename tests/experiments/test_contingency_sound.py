"""Chapter 4 with sounds: rooms of real voices, recordings, and a session at the terminal."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile
import xarray as xr

from experiments import cli, data
from experiments.contingency_listen import steps
from experiments.contingency_room import Hall, _area
from experiments.contingency_session import verdict
from experiments.sounds import RATE, conversation, utterances
from hardware.sound import chirp, decibels
from tests.experiments.test_cli import apmodels, one_sentence, start
from tests.experiments.test_contingency_studies import run

VOICES = pytest.mark.skipif(
    not {"pyannote-sample", "asterisk-en"} <= set(data.available()), reason="no voices: run `make data`"
)


@VOICES
def test_halves_of_the_voices_share_nothing():
    fit, test = (conversation(half) for half in ("fit", "test"))
    assert len(fit) / RATE == pytest.approx(11.65, abs=0.1) and abs(len(fit) - len(test)) <= 1
    assert min(decibels(fit), decibels(test)) > -40
    ones, others = ({sound.tobytes() for sound in utterances(1.5, 2.5, half)} for half in ("fit", "test"))
    assert len(ones) > 30 and len(others) > 30 and not ones & others
    assert all(1.5 <= len(sound) / RATE <= 2.5 for sound in utterances(1.5, 2.5))


@VOICES
def test_rooms(tmp_path):
    fewer = "quick=true", "glance=10", "~rooms.far", "~rooms.near", "~rooms.short_babble", "~rooms.unreliable_babble"
    found, kept, said = run(tmp_path, "room", *fewer)
    for room in ("quiet", "babble", "zero_db", "short", "unreliable"):
        assert f"{room} " in said
        for key in ("within_4", "within_8", "calls_over_limit", "false_alarms", "area", "listen_0.calls"):
            assert np.isfinite(found[f"{room}.{key}"])
    assert found["quiet.within_4"] >= 0.8 and found["quiet.false_alarms"] <= 0.1
    # A quiet room takes no more calls than a loud one, and the two kinds of sessions are told apart.
    assert found["quiet.calls"] <= found["zero_db.calls"]
    assert found["quiet.area"] > 0.9
    # What the summary says is in the data.
    yes = kept.sel(room="babble", answered=True).isel(listen=-1)
    assert found["babble.calls"] == pytest.approx(float(yes.planned_calls.mean()))
    sure = (yes.planned_probability >= 0.975).any("time")
    assert bool((sure == (yes.planned_known == 1)).all())
    assert found["babble.rate.answer"] > found["babble.rate.background"]
    others = [room for room in kept.room.values.tolist() if room != "babble"]
    again, _, _ = run(tmp_path, "room", *fewer, *(f"~rooms.{room}" for room in others))
    assert again["babble.calls"] == found["babble.calls"]


def test_calls_count_until_it_is_certain():
    made: Any = SimpleNamespace(
        config=SimpleNamespace(certain=0.9), count=2, steps=4, model=SimpleNamespace(period=0.5)
    )
    chance = np.array([[0.1, 0.9, 0.2, 0.1], [0.1, 0.2, 0.3, 0.8], [0.95, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.99]])
    calls = np.array([[1, 0, 1, 1], [0, 1, 0, 1], [1, 1, 1, 1], [0, 0, 0, 1]])
    found = Hall._decided(made, "planned", chance, calls)
    assert found.planned_known.values.tolist() == [[True, False], [True, True]]
    assert found.planned_calls.values.tolist() == [[1, 2], [1, 1]]
    assert found.planned_seconds.values.tolist() == [[1.0, 2.0], [0.5, 2.0]]
    np.testing.assert_array_equal(found.planned_probability.sel(answered=False, time=4), [0.1, 0.99])


def test_the_area_is_how_often_the_answered_session_wins():
    assert _area(np.array([0.5, 0.9]), np.array([0.5, 0.1])) == pytest.approx((1 + 1 + 1 + 0.5) / 4)


@VOICES
@pytest.mark.parametrize(
    "words",
    [
        ["sessions=0"],
        ["certain=1.2"],
        ["steps=50", "listen=[60]"],
        ["listen=5"],
        ["certain=much"],
        ["glance=0", "listen=[0]"],
        ["rooms.quiet.lasting=[1]", "quick=true"],
        ["+rooms.mine={conversation: -5}", "quick=true"],
        ["rooms.quiet.conversation=loud", "quick=true"],
        ["half=other"],
        ["rooms.quiet.lasting=[500,600]", "quick=true"],
        ["rooms.quiet.chance=2", "quick=true"],
        ["exponent=-1", "quick=true"],
        ["judge._target_=apmodels.Nothing", "quick=true"],
    ],
)
def test_bad_rooms(tmp_path, words):
    code, _, complaint = apmodels(tmp_path, "experiment=contingency/room", *words)
    assert code == 2 and one_sentence(complaint)


@VOICES
def test_what_is_shown_has_lines_of_its_own(tmp_path):
    words = "experiment=contingency/live", "quick=true", "room=quiet", "hydra.run.dir=run"
    code, said, complaint = apmodels(tmp_path, *words)
    assert code == 0, complaint
    lines = said.splitlines()
    assert any(line.startswith("level ") and "dB, threshold " in line for line in lines)
    assert any(line.startswith("P(somebody answers) = ") for line in lines)


@pytest.mark.parametrize("words", [["certain=much"], ["listen=many"]])
def test_bad_sessions(tmp_path, words):
    code, _, complaint = apmodels(tmp_path, "experiment=contingency/live", "quick=true", *words)
    assert code == 2 and one_sentence(complaint)


@VOICES
def test_a_session_in_a_virtual_room(tmp_path):
    found, kept, said = run(tmp_path, "live", "quick=true", "room=quiet", "stop=false")
    assert ": somebody answers" in said and found["probability"] > 0.975 and found["steps"] == 40
    assert 1 <= found["calls_to_certain"] <= 6 and found["idle"] > 0.9
    rows = list(csv.DictReader((tmp_path / "run/session.csv").read_text().splitlines()))
    assert len(rows) == 40
    np.testing.assert_allclose([float(row["probability"]) for row in rows], kept.probability, atol=1e-6)
    alone, _, said = run(tmp_path, "live", "quick=true", "room=quiet", "answered=false")
    assert alone["probability"] < 0.5 and "nobody seems to answer" in said


def test_a_session_without_devices_is_one_sentence(tmp_path):
    words = "-c", "import sys; sys.modules['sounddevice'] = None; from experiments.cli import main; main()"
    command = [sys.executable, *words, "experiment=contingency/live", "quick=true"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and one_sentence(done.stderr) and "apmodels[hardware]" in done.stderr


# A machine whose microphone goes away after some seconds of sound.
DYING = """
import sys, threading, types, numpy as np
from tests.hardware.test_sound_card import library
sys.modules['sounddevice'] = library(seconds={seconds}, pace=20)
from experiments.cli import main
main()
"""


def test_what_was_heard_before_the_microphone_went_away_is_kept(tmp_path):
    command = [sys.executable, "-c", DYING.format(seconds=40), "experiment=contingency/live", "quick=true"]
    command += ["hydra.run.dir=run", "rate=8000"]
    root = Path(__file__).parents[2]
    env = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=180, env=env)
    assert done.returncode == 2 and one_sentence(done.stderr)
    assert "is it still there" in done.stderr and "is kept in" in done.stderr
    found = json.loads((tmp_path / "run/summary.json").read_text())
    # 40 s are 50 periods, of which 24 were the check; what came before it is forgotten.
    assert 5 <= found["steps"] <= 26
    assert xr.open_dataset(tmp_path / "run/live.nc", engine="h5netcdf").sizes["time"] == found["steps"]


# Recordings.


def recording(folder, answered, rate=8000, seconds=60.0, subtype="PCM_16", channels=1, name="a.wav"):
    """Calls every 4.8 s from the tenth second on, and, if there is one, an answer half a second after each."""
    rng = np.random.default_rng(1)
    sound = rng.normal(0, 0.002, round(rate * seconds))
    calls = np.arange(10, seconds - 5, 4.8)
    for call in calls:
        for begin, part in ((call, chirp(rate)), (call + 0.9, rng.normal(0, 0.1, 2 * rate))):
            if begin == call or answered:
                at = round(begin * rate)
                sound[at : at + len(part)] += part
    soundfile.write(folder / name, np.stack([sound] * channels, 1), rate, subtype=subtype)
    (folder / "calls.csv").write_text("seconds\n" + "\n".join(f"{call:.3f}" for call in calls) + "\n")
    return len(calls)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rate": 96000, "subtype": "PCM_24", "seconds": 30.0},
        {"rate": 11025, "channels": 2},
        {"subtype": "PCM_U8"},
    ],
    ids=str,
)
@pytest.mark.parametrize("answered", [True, False])
def test_a_recording_is_judged(tmp_path, answered, options):
    calls = recording(tmp_path, answered, **options)
    code, said, complaint = apmodels(
        tmp_path, "contingency", "listen=a.wav", "calls=calls.csv", "folder=out", "model.presence=0.1"
    )
    assert code == 0, complaint
    found = json.loads((tmp_path / "out/summary.json").read_text())
    assert found["calls"] == calls and found["clipped"] == 0
    assert (found["probability"] > 0.975) if answered else (found["probability"] < 0.1)
    # The first call is at 10 s.
    assert (10 < found["seconds_to_certain"] < 30) if answered else found["seconds_to_certain"] is None
    assert ("somebody answers" if answered else "nobody seems to answer") in said
    kept = xr.open_dataset(tmp_path / "out/contingency.nc", engine="h5netcdf")
    assert int(kept.call.sum()) == calls and (kept.sound.values[kept.call.values == 1] == 1).all()
    assert (tmp_path / "out/contingency.png").stat().st_size > 10_000


def test_steps_begin_with_calls():
    starts, calls = steps(np.array([2.0, 3.9, 4.7]), 6.5, 0.8)
    np.testing.assert_allclose(starts, [0.4, 1.2, 2.0, 2.8, 3.9, 4.7, 5.5])
    assert calls.tolist() == [False, False, True, False, True, True, False]
    # In floating point 0.3 is a little less than 3 times 0.1.
    assert len(steps(np.array([0.3]), 0.6, 0.1)[0]) == 6


def test_what_is_odd_about_a_recording_is_said(tmp_path):
    recording(tmp_path, True)
    sound, rate = soundfile.read(tmp_path / "a.wav")
    soundfile.write(tmp_path / "loud.wav", np.clip(12 * sound, -1, 1), rate)
    with (tmp_path / "calls.csv").open("a") as file:
        file.write("10.1\n")
    _, said, _ = apmodels(tmp_path, "contingency", "listen=loud.wav", "calls=calls.csv")
    assert "clipped" in said and "1 calls came within a step of another" in said and "somebody answers" in said
    hum = np.random.default_rng(0).normal(0, 0.01, 30 * rate)
    soundfile.write(tmp_path / "hum.wav", hum, rate)
    (tmp_path / "two.csv").write_text("5\n12.5\n")
    _, said, _ = apmodels(tmp_path, "contingency", "listen=hum.wav", "calls=two.csv")
    assert "nothing stands out" in said


def test_the_column_of_seconds_is_found(tmp_path):
    calls = recording(tmp_path, True, seconds=30.0)
    times = (tmp_path / "calls.csv").read_text().split()[1:]
    (tmp_path / "more.csv").write_text("name, Seconds\n" + "".join(f"{i},{time}\n" for i, time in enumerate(times)))
    (tmp_path / "less.csv").write_bytes("\ufeffseconds,\r\n".encode() + "".join(f"{t},\r\n" for t in times).encode())
    (tmp_path / "plain.csv").write_bytes("\ufeff".encode() + "\n".join(times[::-1]).encode())
    for name in ("more.csv", "less.csv", "plain.csv"):
        _, said, _ = apmodels(tmp_path, "contingency", "listen=a.wav", f"calls={name}")
        assert f"{calls} calls" in said and "somebody answers" in said and "came within" not in said


def test_the_last_step_may_be_a_sample_short(tmp_path):
    """A period of 6401.5 samples, and a call as late as there is room for."""
    rate, period, n = 8000, 6401.5 / 8000, 80001
    soundfile.write(tmp_path / "a.wav", np.random.default_rng(0).normal(0, 0.1, n), rate)
    (tmp_path / "calls.csv").write_text(f"{(n - 6401.5) / rate:.10f}\n")
    code, said, complaint = apmodels(
        tmp_path, "contingency", "listen=a.wav", "calls=calls.csv", f"model.period={period}"
    )
    assert code == 0 and "P(somebody answers)" in said, complaint


@pytest.mark.parametrize(
    "words, why",
    [
        (["listen=a.wav"], "give a recording"),
        (["listen=a.wav", "calls=no.csv"], "not there"),
        (["listen=no.wav", "calls=calls.csv"], "not there"),
        (["listen=silent.wav", "calls=calls.csv"], "silent"),
        (["listen=calls.csv", "calls=calls.csv"], "cannot be read"),
        (["listen=a.wav", "calls=a.wav"], "no text"),
        (["listen=a.wav", "calls=late.csv"], "within the recording"),
        (["listen=a.wav", "calls=last.csv"], "within the recording"),
        (["listen=a.wav", "calls=words.csv"], "no time in seconds"),
        (["listen=a.wav", "calls=nothing.csv"], "names 0 calls"),
        (["listen=a.wav", "calls=calls.csv", "certain=2"], "between 0 and 1"),
        (["listen=a.wav", "calls=calls.csv", "model.presence=2"], "outside [0, 1]"),
        (["listen=a.wav", "calls=calls.csv", "colour=red"], "no key"),
        (["listen=a.wav", "calls=calls.csv", "model=tiger"], "no model tiger"),
        (["listen=a.wav", "calls=calls.csv", "exponent=-2"], "exponent"),
        (["listen=a.wav", "calls=calls.csv", "model.period=0"], "period"),
        (["listen=a.wav", "calls=calls.csv", "model.period=many"], "period"),
        (["listen=a.wav", "calls=calls.csv", "exponent=loud"], "exponent"),
        (["listen=a.wav", "calls=calls.csv", "exponent=true"], "exponent"),
        (["listen=a.wav", "calls=calls.csv", "certain=[1"], "certain"),
        (["listen=a.wav", "calls=calls.csv", "model.nothing=1"], "'model.nothing'"),
        (["listen=a.wav", "calls=calls.csv", "model.period=1e-5"], "shorter than a sample"),
        (["listen=a.wav", "calls=comma.csv"], "no time in seconds"),
        (["listen=a.wav", "calls=long.csv"], "no text"),
        (["listen=~nobody/a.wav", "calls=calls.csv"], "not there"),
        (["a.wav", "calls.csv"], "no key=value"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_recordings(tmp_path, monkeypatch, capsys, words, why):
    recording(tmp_path, False, seconds=20.0)
    soundfile.write(tmp_path / "silent.wav", np.zeros(8000), 8000)
    texts = {"late.csv": "3\n99\n", "words.csv": "seconds\n3\nsoon\n", "nothing.csv": "seconds\n"}
    texts |= {"last.csv": "3\n19.5\n", "comma.csv": "seconds\n3,5\n9,25\n", "long.csv": "x" * 200_000}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    # In this process: to start another takes much longer than to refuse.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["apmodels", "contingency", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    complaint = capsys.readouterr().err
    assert ended.value.code == 2 and one_sentence(complaint) and why in complaint


def test_help_of_the_tool(tmp_path):
    code, said, complaint = apmodels(tmp_path, "contingency", "--help")
    assert code == 0 and not complaint and "listen=FILE" in said and said.endswith("\n")


def test_verdicts():
    assert [verdict(p, 0.975, 0.1) for p in (0.99, 0.5, 0.05)] == [
        "somebody answers",
        "it is not certain yet",
        "nobody seems to answer",
    ]


@VOICES
def test_an_interrupted_session_is_kept(tmp_path):
    words = ["experiment=contingency/live", "room=quiet", "answered=false", "steps=60", "hydra.run.dir=run"]
    process = start(tmp_path, *words)
    path, patience = tmp_path / "run/session.csv", time.monotonic() + 120
    while time.monotonic() < patience and not (path.exists() and path.read_text().count("\n") > 5):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said, complaint = process.communicate(timeout=120)
    assert process.returncode == 0, complaint
    assert "P(somebody answers)" in said and (tmp_path / "run/live.nc").exists()
