"""The command as a user types it: most of it in a process of its own, from a folder of its own."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys

import pytest
from hydra import compose, initialize_config_module
from PIL import Image
from skimage.data import coffee

from experiments import cli

# A terminal's Ctrl-C reaches the command, whatever the tests were started by.
PROGRAM = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from experiments.cli import main
main()
"""


def start(folder, *words):
    command = [sys.executable, "-c", PROGRAM, *words]
    # One thread: on a busy machine two wait for each other much longer than they work.
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def apmodels(folder, *words):
    """Run the command; return its exit code, what it said, and what it complained of."""
    process = start(folder, *words)
    said, complaint = process.communicate(timeout=300)
    assert "Traceback" not in said + complaint
    return process.returncode, said, complaint


def one_sentence(complaint):
    return complaint.startswith("apmodels: ") and complaint.count("\n") == 1


def test_help_names_everything(tmp_path):
    code, said, complaint = apmodels(tmp_path, "--help")
    assert code == 0 and not complaint and apmodels(tmp_path) == apmodels(tmp_path, "-h") == (0, said, "")
    for word in ("experiments", "tools", "groups", "find_face", "data", *cli.GROUPS):
        assert re.search(rf"^ *{word}\b", said, re.M), word
    for word in ("most_probable", "photo_eye_published", "detector_search", "exact", "serial", "seed=N", "-m"):
        assert word in said
    assert max(map(len, said.splitlines())) <= 120
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("group", ["experiment", *cli.GROUPS])
def test_every_choice_says_what_it_is(group):
    choices = cli.choices(group)
    assert choices and all(about and about[0].isupper() and about.endswith(".") for about in choices.values())


def test_unknown_tool(tmp_path):
    for word in ("find_face", "dta", ""):
        code, said, complaint = apmodels(tmp_path, word)
        assert code == 2 and not said and one_sentence(complaint)
        assert f"no tool {word}" in complaint and "experiment=NAME" in complaint


def test_a_tool_takes_the_other_words(tmp_path):
    code, said, complaint = apmodels(tmp_path, "data", "--help")
    assert code == 0 and "--list" in said and not complaint


def test_a_tools_exit_code_and_words(monkeypatch):
    monkeypatch.setattr("sys.argv", ["apmodels", "data", "orl-faces", "--list"])
    monkeypatch.setattr("experiments.data.__main__.main", lambda: len(sys.argv))
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 3 and sys.argv == ["apmodels data", "orl-faces", "--list"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["experiment=fnd_face"], "find_face"),
        (["seed=1"], "find_face"),
        (["experiment=find_face", "controller=luck"], "most_probable"),
        (["experiment=find_face", "treshold=1"], "treshold"),
    ],
)
def test_unknown_names(tmp_path, words, message):
    code, said, complaint = apmodels(tmp_path, *words)
    assert code != 0 and not said and message in complaint
    assert not list(tmp_path.rglob("summary.json"))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("threshold=2", "threshold must lie in (0, 1] and fixations be 1 or more, not 2 and 30"),
        ("photo=not there.jpg", "'not there.jpg' does not exist"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, word, message):
    code, said, complaint = apmodels(tmp_path, "experiment=find_face", word)
    assert code == 2 and not said and one_sentence(complaint) and message in complaint
    assert not list(tmp_path.rglob("summary.json"))


def test_a_photo_of_any_name_and_no_face(tmp_path):
    name = "a b [1], c=d (2) {x} ~it's.png"
    Image.fromarray(coffee()).save(tmp_path / name)
    code, said, complaint = apmodels(tmp_path, "experiment=find_face", f"photo={name}", "hydra.run.dir=out")
    assert code == 0 and not complaint and "no face found" in said
    for kept in ("find_face.nc", "find_face.png", "summary.json"):
        assert f"wrote out/{kept}" in said and (tmp_path / "out" / kept).stat().st_size
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(), parse_constant=pytest.fail)
    assert summary["found"] == 0 and summary["row"] is None and summary["distance_to_whole_image_cells"] is None


@pytest.mark.slow
def test_a_sweep(tmp_path):
    words = ["-m", "experiment=find_face", "controller=most_probable,random", "seed=1,2"]
    code, _, complaint = apmodels(tmp_path, *words)
    assert code == 0 and not complaint
    kept = sorted(tmp_path.glob("multirun/find_face/*/*/summary.json"))
    assert [path.parent.name for path in kept] == [
        f"{i}_controller={controller},seed={seed}"
        for i, (controller, seed) in enumerate(itertools.product(("most_probable", "random"), (1, 2)))
    ]
    for path in kept:
        assert json.loads(path.read_text())["found"] in (0, 1)
        assert {"find_face.nc", "find_face.png"} < {beside.name for beside in path.parent.iterdir()}


@pytest.mark.slow
def test_interrupted(tmp_path):
    # Choosing by infomax takes long enough that the signal finds the search at work.
    words = ["controller=greedy_infomax", "threshold=1", "hydra.run.dir=out"]
    process = start(tmp_path, "experiment=find_face", *words)
    assert "fixation" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=300)
    assert process.returncode == 130 and complaint == "apmodels: interrupted\n"
    assert not list((tmp_path / "out").glob("*.json*"))


@pytest.mark.parametrize("name", ["plain.png", "a b.png", "a[1].png", "a,b=c.png", "a~", "it's", "back\\", "(ü)"])
def test_hydra_reads_a_quoted_path_as_it_was(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("config", ["experiment=find_face", cli._quoted(f"photo={name}")])
    assert config.photo == name


@pytest.mark.parametrize(
    "word",
    ["seed=1", "seed=1,2", "seed=", "-m", "controller.actions=[" + "220," * 200 + "0]", "photo='a b'", "x=~no/a"],
)
def test_what_is_no_path_is_left_alone(word):
    assert cli._quoted(word) == word


def test_a_photo_that_is_not_there_is_quoted_unless_several_are_swept():
    assert cli._quoted("photo=no[such](1).jpg") == "photo='no[such](1).jpg'"
    assert cli._quoted("photo=a.jpg,b(1).jpg", sweeping=True) == "photo=a.jpg,b(1).jpg"
