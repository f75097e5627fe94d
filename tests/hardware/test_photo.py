import cv2
import numpy as np
import pytest
from PIL import Image

from hardware import PhotoError, read_photo
from hardware import photo as photo_module
from hardware.photo import as_photo

COLOURS = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[10, 20, 30], [0, 0, 0], [255, 255, 255]]], np.uint8)


def save(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


def test_rgb_as_it_is(tmp_path):
    read = read_photo(save(tmp_path / "a.png", COLOURS))
    assert read.dtype == np.uint8 and read.flags.writeable
    np.testing.assert_array_equal(read, COLOURS)
    np.testing.assert_array_equal(read_photo(str(tmp_path / "a.png")), COLOURS)


@pytest.mark.parametrize("shape", [(1, 1), (20, 20), (1, 7)])
def test_small_and_grey(tmp_path, shape):
    grey = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    np.testing.assert_array_equal(read_photo(save(tmp_path / "a.png", grey)), grey[..., None].repeat(3, 2))


@pytest.mark.parametrize("name", ["a.png", "a.tiff", "a.pgm"])
def test_16_bit_grey(tmp_path, name):
    grey = np.array([[0, 257, 32768], [65535, 300, 1000]], np.uint16)
    assert cv2.imwrite(str(tmp_path / name), grey)
    np.testing.assert_array_equal(read_photo(tmp_path / name)[..., 1], (grey / 257 + 0.5).astype(np.uint8))


def test_16_bit_grey_that_is_dark_stays_dark(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.full((3, 3), 200, np.uint16))
    assert read_photo(tmp_path / "a.png").max() <= 1


@pytest.mark.parametrize("name", ["a.png", "a.tiff"])
def test_16_bit_rgb(tmp_path, name):
    assert cv2.imwrite(str(tmp_path / name), COLOURS[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_photo(tmp_path / name), COLOURS)


@pytest.mark.parametrize("white", [1.0, 255.0, 65535.0, 1e6])
def test_floating_point_tiff(tmp_path, white):
    grey = np.linspace(0, white, 12, dtype=np.float32).reshape(3, 4)
    read = read_photo(save(tmp_path / "a.tiff", grey))
    np.testing.assert_allclose(read[..., 0], grey / white * 255, atol=0.51)


def test_32_bit_integers(tmp_path):
    grey = np.array([[0, 65535], [32768, 1]], np.int32)
    np.testing.assert_array_equal(read_photo(save(tmp_path / "a.tiff", grey))[..., 0], [[0, 255], [128, 0]])


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_goes_on_white(tmp_path, mode):
    image = Image.fromarray(COLOURS).convert(mode)
    image.putalpha(Image.fromarray(np.array([[0, 255, 0], [0, 128, 255]], np.uint8)))
    image.save(tmp_path / "a.png")
    read = read_photo(tmp_path / "a.png")
    assert (read[0, 0] == 255).all() and (read[1, 0] == 255).all()
    assert 126 <= read[1, 1, 0] <= 128
    if mode == "RGBA":
        np.testing.assert_array_equal(read[0, 1], [0, 255, 0])


def test_palette_with_and_without_transparency(tmp_path):
    image = Image.fromarray(COLOURS).quantize(8)
    image.save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as saved:
        assert saved.mode == "P"
    np.testing.assert_allclose(read_photo(tmp_path / "a.png"), COLOURS, atol=8)
    image.save(tmp_path / "b.png", transparency=image.getpixel((0, 0)))
    assert (read_photo(tmp_path / "b.png")[0, 0] == 255).all()


def test_cmyk_and_one_bit(tmp_path):
    Image.new("CMYK", (9, 5), (0, 255, 255, 0)).save(tmp_path / "a.jpg")
    np.testing.assert_allclose(read_photo(tmp_path / "a.jpg"), np.full((5, 9, 3), [255, 0, 0]), atol=8)
    Image.new("1", (9, 5), 1).save(tmp_path / "b.png")
    assert (read_photo(tmp_path / "b.png") == 255).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path, orientation):
    upright = np.zeros((40, 60), np.uint8)
    upright[:10, :20] = 255  # the upper left corner is white
    stored = {
        1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1],
        5: upright.T, 6: np.rot90(upright), 7: upright[::-1, ::-1].T, 8: np.rot90(upright, -1),
    }[orientation]  # fmt: skip
    exif = Image.Exif()
    exif[0x0112] = orientation
    read = read_photo(save(tmp_path / "a.png", np.ascontiguousarray(stored), exif=exif))
    np.testing.assert_array_equal(read[..., 0], upright)


def test_broken_exif_is_forgiven(tmp_path):
    path = save(tmp_path / "a.jpg", COLOURS, exif=b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\xff\xff nothing of use")
    assert read_photo(path).shape == COLOURS.shape


def test_size_guard_of_pillow_is_lifted_and_put_back(tmp_path, monkeypatch):
    path = save(tmp_path / "a.png", np.zeros((50, 50), np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert read_photo(path).shape == (50, 50, 3)
    assert Image.MAX_IMAGE_PIXELS == 1000
    monkeypatch.setattr(photo_module, "MOST_PIXELS", 1000)
    with pytest.raises(PhotoError, match=r"a\.png' is 50x50 pixels, over a billion"):
        read_photo(path)


@pytest.mark.slow
def test_a_hundred_megapixels(tmp_path):
    path = save(tmp_path / "a.png", np.full((10_000, 10_000), 7, np.uint8), compress_level=1)
    read = read_photo(path)
    assert read.shape == (10_000, 10_000, 3) and (read == 7).all()


def bad_files(folder):
    (folder / "text.jpg").write_text("this is no photograph\n")
    (folder / "empty.jpg").touch()
    (folder / "folder.jpg").mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    whole = save(folder / "whole.jpg", noise).read_bytes()
    (folder / "truncated.jpg").write_bytes(whole[: len(whole) // 2])
    whole = save(folder / "whole.png", noise).read_bytes()
    (folder / "truncated.png").write_bytes(whole[: len(whole) // 2])
    (folder / "header.png").write_bytes(whole[:20])
    (folder / "flipped.png").write_bytes(whole[:300] + bytes(200) + whole[500:])


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing.jpg", "does not exist"),
        ("folder.jpg", "is a folder"),
        ("empty.jpg", "is an empty file"),
        ("text.jpg", "is not an image"),
        ("truncated.jpg", "is damaged or cut short"),
        ("truncated.png", "is damaged or cut short"),
        ("flipped.png", "is damaged or cut short"),
        ("header.png", "is (damaged|not an image)"),
        ("text.jpg/inside.jpg", "does not exist"),
    ],
)
def test_unreadable_files_are_named_in_one_sentence(tmp_path, name, reason):
    bad_files(tmp_path)
    with pytest.raises(PhotoError, match=reason) as caught:
        read_photo(tmp_path / name)
    message = str(caught.value)
    assert f"'{tmp_path / name}'" in message and "\n" not in message
    assert message.endswith(".") and ". " not in message and len(message) < 100 + 2 * len(str(tmp_path))
    assert isinstance(caught.value, ValueError)


def test_a_device_is_not_read():
    with pytest.raises(PhotoError, match="is not a regular file"):
        read_photo("/dev/zero")


def test_arrays():
    np.testing.assert_array_equal(as_photo(COLOURS), COLOURS)
    np.testing.assert_array_equal(as_photo(COLOURS[::-1, ::-1] / 255), COLOURS[::-1, ::-1])
    assert as_photo(COLOURS[..., 0]).shape == COLOURS.shape
    assert as_photo(COLOURS[::2, ::-1]).flags.c_contiguous


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(5, np.uint8),
        np.zeros((5, 5, 4), np.uint8),
        np.zeros((0, 5), np.uint8),
        np.zeros((5, 5), np.int64),
        np.full((5, 5), np.nan),
        np.full((5, 5), 2.0),
        np.full((5, 5), -0.1, np.float32),
    ],
)
def test_arrays_that_are_no_photos(array):
    with pytest.raises(PhotoError, match=r"^A photo's (floating-point )?array must"):
        as_photo(array)
