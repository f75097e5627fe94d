"""The main job, from a configuration to what it leaves in its folder, on photographs of every kind."""

import io
import json

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
import xarray as xr
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console
from skimage.data import astronaut, chelsea, coffee, rocket

from apmodels import ValueOutOfRange
from experiments import data
from experiments.find_face import find_face
from experiments.study import Result
from hardware import PhotoError

PROMISED = {
    "found",
    "fixations",
    "row",
    "column",
    "belief",
    "milliseconds",
    "whole_image_milliseconds",
    "speedup",
    "distance_to_whole_image_cells",
}
# In the astronaut's 512 x 512 pixels the face's centre is about here, (row, column).
FACE = (114, 224)


class Run:
    """One run into a folder, and what it returned and left there; the picture, which takes a second, if asked for."""

    def __init__(self, folder, *overrides, photo=None, picture=False):
        with initialize_config_module("conf", version_base="1.3"):
            config = compose("config", ["experiment=find_face", *overrides])
        config.photo = photo
        said = io.StringIO()
        try:
            self.result = find_face(config, folder, Console(file=said))
            figures = self.result.figures if picture else {}
            self.paths = Result(self.result.summary, self.result.datasets, figures).write(folder)
        finally:
            plt.close("all")
        self.said = said.getvalue()
        self.summary = self.result.summary
        self.kept = json.loads((folder / "summary.json").read_text(), parse_constant=pytest.fail)
        self.fixations = self.result.datasets["find_face"]["fixation"].values[0].tolist()


def save(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    return save(tmp_path_factory.mktemp("photos") / "astronaut.png", astronaut())


def test_the_race_may_be_left_out(tmp_path, photo):
    run = Run(tmp_path, "whole_image=false", photo=str(photo), picture=True)
    assert run.kept["found"] == 1 and "whole-image" not in run.said
    missing = {name for name, value in run.kept.items() if value is None}
    assert missing == {name for name in run.kept if "whole_image" in name or name == "speedup"}


def test_the_astronaut(tmp_path):
    run = Run(tmp_path, picture=True)
    assert set(run.kept) >= PROMISED and list(run.kept) == list(run.summary)
    assert run.kept["found"] == 1 and 1 <= run.kept["fixations"] <= 30
    assert run.kept["distance_to_whole_image_cells"] <= 1 and 0.125 <= run.kept["belief"] <= 1
    assert np.hypot(run.kept["row"] + 0.5 - FACE[0] / 512 * 21, run.kept["column"] + 0.5 - FACE[1] / 512 * 21) <= 1
    assert all(value is not None for value in run.kept.values())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["find_face.nc", "find_face.png", "summary.json"]
    assert sorted(run.paths) == sorted(tmp_path.iterdir())
    assert run.said.count("fixation ") == run.kept["fixations"] and "a face at row" in run.said


def test_what_is_kept_opens_again(tmp_path, photo):
    run = Run(tmp_path, photo=photo, picture=True)
    with xr.open_dataset(tmp_path / "find_face.nc", engine="h5netcdf") as kept:
        assert kept.sizes["time"] == run.summary["fixations"] and kept.sizes["episode"] == 1
        last = kept["marginal"].values[0, -1]
        assert last.sum() == pytest.approx(1, abs=1e-5) and last.max() == pytest.approx(run.summary["belief"])
        assert divmod(int(last.argmax()), 21) == (run.summary["row"], run.summary["column"])
    with Image.open(tmp_path / "find_face.png") as figure:
        assert figure.format == "PNG" and 1200 < figure.width < 3000 and 300 < figure.height < 1500
        assert len(np.unique(np.asarray(figure.convert("L")))) > 100


def test_the_same_seed_is_the_same_search(tmp_path, photo):
    first, again, other = (Run(tmp_path, "controller=random", f"seed={seed}", photo=photo) for seed in (3, 3, 4))
    assert first.fixations == again.fixations != other.fixations
    for name in ("found", "fixations", "row", "column", "belief"):
        np.testing.assert_equal(first.summary[name], again.summary[name])


@pytest.mark.parametrize(
    "overrides",
    [
        ["controller=random", "seed=1"],
        ["controller=greedy_infomax", "controller.samples=2"],
        ["controller=constant", "controller.action=93"],
        ["controller=playback", "controller.actions=[220,93,94,95]"],
        ["engine=exact"],
        ["body=photo_eye_published"],
        ["body=photo_eye_lbp"],
        ["model.grid.rows=15", "model.grid.columns=15"],
    ],
    ids=" ".join,
)
def test_other_parts(tmp_path, photo, overrides):
    run = Run(tmp_path, *overrides, photo=photo)
    assert run.summary["found"] == 1 and run.summary["distance_to_whole_image_cells"] <= 1
    if "constant" in overrides[0]:
        assert set(run.fixations) == {93}
    if "playback" in overrides[0]:
        assert run.fixations == [220, 93, 94, 95][: len(run.fixations)]


def test_a_search_ends(tmp_path, photo):
    one = Run(tmp_path, "fixations=1", photo=photo)
    assert one.summary["fixations"] == 1 == len(one.fixations)
    # Nothing is believed so much at the first look, and the second repeats it: that is the end of the search.
    again = Run(tmp_path, "controller=constant", "controller.action=0", "threshold=1", photo=photo)
    assert again.fixations == [0, 0]


@pytest.mark.parametrize(
    "override",
    ["threshold=0", "threshold=1.1", "threshold=.nan", "threshold=much", "threshold=null", "fixations=0",
     "fixations=2.5", "seed=one", "seed=1.5"],
)  # fmt: skip
def test_numbers_out_of_range(tmp_path, override):
    name, value = override.split("=")
    with pytest.raises(ValueOutOfRange, match=rf"{name}.*not .*{value.replace('null', 'None').strip('.')}"):
        Run(tmp_path, override)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.jpg", "does not exist"),
        ("folder", "is a folder"),
        ("text.jpg", "not an image"),
        ("empty.jpg", "is an empty file"),
        ("cut.jpg", "damaged or cut short"),
        ("one.png", "1x1 pixels, smaller than the 21x21 grid"),
        ("twenty.png", "20x20 pixels, smaller than the 21x21 grid"),
    ],
)
def test_photos_that_cannot_be_used(tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.jpg").write_text("This is a letter.")
    (tmp_path / "empty.jpg").touch()
    whole = save(tmp_path / "whole.jpg", astronaut()).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    save(tmp_path / "one.png", astronaut()[:1, :1])
    save(tmp_path / "twenty.png", astronaut()[:20, :20])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(PhotoError, match=message):
        Run(tmp_path, photo=tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before


def test_a_photo_named_like_a_number(tmp_path, monkeypatch):
    save(tmp_path / "7", astronaut()[:5, :5], format="PNG")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PhotoError, match="5x5 pixels"):
        Run(tmp_path, photo=7)


def _turned(path, orientation, degrees):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(astronaut()).rotate(degrees, expand=True).save(path, exif=exif, quality=95)


def _wide(path, pixels):
    assert cv2.imwrite(str(path), pixels.astype(np.uint16) * 257)


# File name -> how to write the astronaut into it.
KINDS = {
    "grey-16.png": lambda path: _wide(path, cv2.cvtColor(astronaut(), cv2.COLOR_RGB2GRAY)),
    "rgb-16.png": lambda path: _wide(path, astronaut()[..., ::-1]),
    "grey.png": lambda path: Image.fromarray(astronaut()).convert("L").save(path),
    "alpha.png": lambda path: Image.fromarray(astronaut()).convert("RGBA").save(path),
    "palette.png": lambda path: Image.fromarray(astronaut()).quantize(64).save(path),
    "cmyk.jpg": lambda path: Image.fromarray(astronaut()).convert("CMYK").save(path),
    "upside-down.jpg": lambda path: _turned(path, 3, 180),
    "turned-right.jpg": lambda path: _turned(path, 6, 90),
    "turned-left.jpg": lambda path: _turned(path, 8, 270),
    "photo": lambda path: save(path, astronaut(), format="PNG"),
}
RARE = ("cmyk.jpg", "upside-down.jpg", "turned-left.jpg", "photo")


@pytest.mark.parametrize("name", [pytest.param(k, marks=pytest.mark.slow) if k in RARE else k for k in KINDS])
def test_photos_of_every_kind(tmp_path, name):
    KINDS[name](tmp_path / name)
    run = Run(tmp_path, photo=tmp_path / name)
    assert run.summary["found"] == 1 and run.summary["distance_to_whole_image_cells"] <= 1
    seen = (run.summary["row"] + 0.5) / 21 * 512, (run.summary["column"] + 0.5) / 21 * 512
    assert np.hypot(seen[0] - FACE[0], seen[1] - FACE[1]) < 1.5 * 512 / 21


@pytest.mark.parametrize("top", [0, 888])
def test_a_portrait_shaped_photo(tmp_path, top):
    tall = np.zeros((1400, 512, 3), np.uint8)
    tall[top : top + 512] = astronaut()
    run = Run(tmp_path, photo=save(tmp_path / "tall.png", tall))
    assert run.summary["found"] == 1 and run.summary["distance_to_whole_image_cells"] <= 1
    assert abs((run.summary["row"] + 0.5) / 21 * 1400 - top - FACE[0]) < 1.5 * 1400 / 21


@pytest.mark.parametrize("scene", [coffee, rocket, chelsea, lambda: np.full((21, 21), 128, np.uint8)])
def test_no_face(tmp_path, scene):
    run = Run(tmp_path, photo=save(tmp_path / "scene.png", scene()))
    assert run.kept["found"] == 0 and run.kept["fixations"] == len(run.fixations)
    assert [run.kept[name] for name in ("row", "column", "distance_to_whole_image_cells")] == [None] * 3
    assert "no face found" in run.said


def test_the_eye_and_the_whole_image_may_disagree(tmp_path, photo):
    run = Run(tmp_path, "fixations=1", "controller=constant", "controller.action=440", photo=photo)
    assert run.kept["found"] == 0 and run.kept["whole_image_found"] == 1
    assert run.kept["distance_to_whole_image_cells"] is None and run.kept["row"] is None


@pytest.mark.slow
def test_scenes_without_people(tmp_path):
    scenes = data.scenes()[::6]
    if not scenes:
        pytest.skip("no scenes have been fetched: python -m experiments.data")
    runs = [Run(tmp_path, photo=scene) for scene in scenes]
    # A few of them have a face on a book's cover, or something that both searches take for one.
    assert sum(run.kept["found"] for run in runs) <= len(runs) / 10
    assert all((run.kept["row"] is None) == (run.kept["found"] == 0) for run in runs)


@pytest.mark.slow
def test_a_hundred_megapixels(tmp_path):
    large = np.full((10_000, 10_000, 3), 128, np.uint8)
    large[2000:3024, 3000:4024] = cv2.resize(astronaut(), (1024, 1024))
    run = Run(tmp_path, photo=save(tmp_path / "large.jpg", large), picture=True)
    assert run.summary["found"] == 1 and run.summary["distance_to_whole_image_cells"] <= 1
    with Image.open(tmp_path / "find_face.png") as figure:
        assert figure.width < 3000


def test_a_result_is_written_whole(tmp_path):
    summary = {"nan": float("nan"), "inf": np.float32("-inf"), "number": np.float32(0.5), "whole": np.int64(3),
               "tensor": torch.tensor(2), "truth": np.bool_(True), "word": "yes", "nothing": None}  # fmt: skip
    figure = Figure(figsize=(2, 1))
    numbers = xr.Dataset({"x": ("time", np.arange(3.0))})
    folder = tmp_path / "a" / "b"
    paths = Result(summary, {"numbers": numbers}, {"picture": figure}).write(folder)
    assert [path.name for path in paths] == ["numbers.nc", "picture.png", "summary.json"]
    assert sorted(folder.iterdir()) == sorted(paths)
    assert json.loads((folder / "summary.json").read_text(), parse_constant=pytest.fail) == {
        "nan": None, "inf": None, "number": 0.5, "whole": 3, "tensor": 2, "truth": True, "word": "yes", "nothing": None
    }  # fmt: skip
    with xr.open_dataset(folder / "numbers.nc", engine="h5netcdf") as kept:
        xr.testing.assert_identical(kept.load(), numbers)


class Torn:
    """A figure that fails with half of it written."""

    def savefig(self, path, **_):
        path.write_bytes(b"half")
        raise OSError("the disk is full")


def test_a_figure_that_fails_leaves_no_half_file(tmp_path):
    whole = tmp_path / "picture.png"
    whole.write_bytes(b"as it was")
    numbers = xr.Dataset({"x": ("time", np.arange(3.0))})
    with pytest.raises(OSError, match="disk is full"):
        Result({"found": 1}, {"numbers": numbers}, {"picture": Torn()}).write(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["numbers.nc", "picture.png"]
    assert whole.read_bytes() == b"as it was"


def test_a_result_is_replaced(tmp_path):
    Result({"found": 0, "old": 1}).write(tmp_path)
    (path,) = Result({"found": 1}).write(tmp_path)
    assert json.loads(path.read_text()) == {"found": 1}
