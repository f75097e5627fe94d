"""Photographs as people see them: upright, eight bits, red, green and blue, whatever the file says.

A file says more than pixels: which way the camera was held (EXIF), that part of it is see-through, that a
pixel has sixteen bits or is an entry of a palette.  A detector of upright faces must not care, so all of it
is settled here, once.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

__all__ = ["PhotoError", "as_photo", "read_photo"]

MOST_PIXELS = 1_000_000_000


class PhotoError(ValueError):
    """A photograph that cannot be used; the message is one sentence that names it and says what to do."""


def as_photo(photo: str | os.PathLike[str] | np.ndarray) -> np.ndarray:
    """Return `photo`, a path or an array, as a uint8 RGB array (height, width, 3).

    An array may be (height, width) or (height, width, 3), either uint8 or floating point in [0, 1].

    Raises:
        PhotoError: the file cannot be read (see `read_photo`), or the array is none of these.
    """
    if not isinstance(photo, np.ndarray):
        return read_photo(photo)
    if photo.ndim not in (2, 3) or photo.shape[2:] not in ((), (3,)) or 0 in photo.shape:
        raise PhotoError(
            f"A photo's array must be (height, width) or (height, width, 3), and this one is {photo.shape}."
        )
    if np.issubdtype(photo.dtype, np.floating):
        if not (photo.min() >= 0 and photo.max() <= 1):  # false for NaN too
            raise PhotoError("A photo's floating-point array must hold numbers in [0, 1] only; scale it first.")
        photo = (photo * 255 + 0.5).astype(np.uint8)
    if photo.dtype != np.uint8:
        raise PhotoError(f"A photo's array must be uint8 or floating point, and this one is {photo.dtype}.")
    return np.ascontiguousarray(photo if photo.ndim == 3 else np.repeat(photo[..., None], 3, axis=2))


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """Read the photograph in the file `path`, any format that Pillow knows; of several frames, the first.

    Returns:
        uint8 RGB array (height, width, 3): upright (EXIF orientation applied), 16 bits scaled to 8, grey,
        palette and CMYK converted, transparency composited on white.

    Raises:
        PhotoError: there is no such file, it is a folder, empty, no image, cut short, or has more than a
            billion pixels.
    """
    path = Path(path).expanduser()
    _check_is_file(path)
    try:
        # Pillow warns about files that are merely large or untidy; both are fine here.
        with warnings.catch_warnings(), _any_size():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise PhotoError(
                        f"'{path}' is {image.width}x{image.height} pixels, over a billion; shrink it first."
                    )
                return np.array(_eight_bit_rgb(_upright(image)))
    except PhotoError:
        raise
    except UnidentifiedImageError:
        raise PhotoError(
            f"'{path}' is not an image that Pillow can read, whatever its name says; save it as JPEG or PNG."
        ) from None
    except PermissionError:
        raise PhotoError(f"'{path}' may not be read by this user; change its permissions.") from None
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error, EOFError and others
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise PhotoError(f"'{path}' is damaged or cut short ({reason}); copy or download it again.") from error


def _check_is_file(path: Path) -> None:
    """Say what is wrong with a path that cannot be a photograph, before Pillow meets it."""
    if path.is_dir():
        raise PhotoError(f"'{path}' is a folder; give the path of one photograph.")
    if not path.exists():
        raise PhotoError(f"'{path}' does not exist; give the path of a photograph.")
    if not path.is_file():  # a pipe or a device, which might never end
        raise PhotoError(f"'{path}' is not a regular file; give the path of a photograph.")
    if path.stat().st_size == 0:
        raise PhotoError(f"'{path}' is an empty file; copy or download the photograph again.")


@contextlib.contextmanager
def _any_size() -> Iterator[None]:
    """Lift Pillow's guard against decompression bombs, which stops at 179 megapixels; ours stops later."""
    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _upright(image: Image.Image) -> Image.Image:
    """Turn the image the way the camera was held; broken EXIF does not make a photo unreadable."""
    image.load()  # a file cut short fails here, outside of the leniency below
    with contextlib.suppress(Exception):
        return ImageOps.exif_transpose(image)
    return image


def _eight_bit_rgb(image: Image.Image) -> Image.Image:
    """Convert any of Pillow's modes to RGB: wide pixels scaled, see-through ones on white paper."""
    if image.mode == "F" or image.mode.startswith("I"):
        return Image.fromarray(_narrow(np.asarray(image), image.mode)).convert("RGB")
    if image.has_transparency_data:
        coloured = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", coloured.size, "white"), coloured).convert("RGB")
    return image.convert("RGB")


def _narrow(wide: np.ndarray, mode: str) -> np.ndarray:
    """Scale a grey image of 16 or 32 bits, or of floating point, to uint8.

    Only the 16-bit modes (I;16...) say what white is.  In the others white is the least usual maximum
    (1 if floating point, 255, 65535) that no pixel exceeds, or else the brightest pixel.
    """
    wide = np.nan_to_num(wide.astype(np.float32))
    usual = [65535.0] if mode.startswith("I;16") else ([1.0] if mode == "F" else []) + [255.0, 65535.0]
    brightest = float(wide.max())
    white = next((most for most in usual if brightest <= most), brightest)
    return (np.clip(wide / white, 0, 1) * 255 + 0.5).astype(np.uint8)
