import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import apmodels
from apmodels import shift, window
from apmodels.transforms import recording_moves

sides = st.integers(1, 6)
pixels = st.integers(-8, 8)
fractions = st.sampled_from([-0.49, -0.2, 0.0, 0.3, 0.49])


def image_of(height, width):
    return torch.arange(1.0, 1.0 + height * width).reshape(height, width)


def at(image, row, column, fill):
    height, width = image.shape
    return float(image[row, column]) if 0 <= row < height and 0 <= column < width else fill


@settings(deadline=None)
@given(sides, sides, pixels, pixels, fractions, st.sampled_from([0.0, -3.0]))
def test_shift_moves_right_and_down(height, width, right, down, fraction, fill):
    image = image_of(height, width)
    expected = [[at(image, row - down, column - right, fill) for column in range(width)] for row in range(height)]
    moved = shift(image, torch.tensor([right + fraction, down - fraction]), fill)
    np.testing.assert_array_equal(moved, expected)


@settings(deadline=None)
@given(sides, sides, sides, sides, pixels, pixels, fractions, st.sampled_from([0.0, 7.0]))
def test_window_cuts_with_its_corner_at_the_upper_left(height, width, rows, columns, right, down, fraction, fill):
    image = image_of(height, width)
    expected = [[at(image, row + down, column + right, fill) for column in range(columns)] for row in range(rows)]
    cut = window(image, torch.tensor([right + fraction, down - fraction]), (rows, columns), fill)
    np.testing.assert_array_equal(cut, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_precision_of_the_image_is_kept(dtype):
    image = image_of(2, 3).to(dtype)
    assert shift(image, torch.tensor([1, 0])).dtype == window(image, torch.tensor([1, 0]), (1, 1)).dtype == dtype


@pytest.mark.parametrize("move", [lambda i, d: shift(i, d, 2.0), lambda i, d: window(i, d, (2, 3), 2.0)])
def test_moves_vectorise_over_images_and_displacements(move):
    images = torch.rand(4, 3, 5)
    places = torch.tensor([[0, 0], [1, -1], [-2, 2], [9, 9]])
    both = torch.func.vmap(move)(images, places)
    torch.testing.assert_close(both, torch.stack([move(i, d) for i, d in zip(images, places, strict=True)]))


def test_moves_are_noted_only_inside():
    image, right = image_of(2, 3), torch.tensor([1, 0])
    with recording_moves() as noted:
        moved = shift(image, right)
        with recording_moves() as inner:
            cut = window(moved, right, (1, 1))
    shift(image, right)
    assert [(a is image, b is moved) for a, b in noted] == [(True, True)]
    assert [(a is moved, b is cut) for a, b in inner] == [(True, True)]


def test_the_words_of_laws_are_torchs():
    assert (apmodels.where, apmodels.ones, apmodels.zeros) == (torch.where, torch.ones, torch.zeros)
