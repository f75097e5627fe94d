import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from apmodels import Binary, Box, Finite, Grid, Space, ValueOutOfRange
from apmodels.simulation import seeded

FINITE = [Finite(3), Finite(3, ("left", "right", "cross")), Binary(), Grid(2, 3), Grid(1, 1)]
BOXES = [Box(-1.0, 2.0), Box(0.0, 1.0, (2,)), Box(-1.0, 1.0, (2, 3))]
every_space = pytest.mark.parametrize("space", FINITE + BOXES, ids=repr)
grids = st.builds(Grid, st.integers(1, 9), st.integers(1, 9))


@pytest.mark.parametrize(("space", "size"), list(zip(FINITE, [3, 3, 2, 6, 1], strict=True)), ids=repr)
def test_finite_spaces_list_draw_and_check_their_values(space, size):
    assert space.size == size and space.shape == () and isinstance(space, Space)
    assert space.values().tolist() == list(range(size)) and space.values().dtype == torch.int64
    with seeded(0):
        drawn = space.sample((100, 2))
    assert drawn.shape == (100, 2) and drawn.unique().tolist() == list(range(size))
    for good in (drawn, drawn.float(), drawn.to(torch.int32), drawn.numpy(), drawn.tolist(), drawn[:0]):
        assert torch.equal(space.check(good), drawn[: len(good)]) and space.check(good).dtype == torch.int64
    for bad, words in [
        (size, f"up is {size}, outside"),
        (-1, "up is -1, outside"),
        ([0, size], f"up is {size}"),
        ([[0], [-2]], "up is -2"),
        (0.5, "up has a fraction"),
        ([0.0, float("nan")], "up is NaN"),
        (float("inf"), "up"),
    ]:
        with pytest.raises(ValueOutOfRange, match=words):
            space.check(bad, "up")


@pytest.mark.parametrize("one", [0, 0.0, np.int64(0), torch.tensor(0), torch.tensor(0.0)])
def test_one_value_is_checked(one):
    checked = Finite(3).check(one)
    assert checked.shape == () and checked.dtype == torch.int64 and int(checked) == 0


@pytest.mark.parametrize("one", [True, torch.tensor(1, dtype=torch.uint8), torch.tensor(1, dtype=torch.int32)])
def test_one_value_is_int64_whatever_it_was(one):
    assert Binary().check(one).dtype == torch.int64


@pytest.mark.parametrize("space", BOXES, ids=repr)
def test_boxes_draw_and_check_their_values(space):
    assert space.size is None and space.shape == space.dims
    with seeded(0):
        drawn = space.sample((1000,))
    assert drawn.shape == (1000, *space.dims)
    width = space.high - space.low
    assert space.low <= drawn.min() < space.low + 0.05 * width and space.high - 0.05 * width < drawn.max() <= space.high
    for good in (drawn, drawn.double(), drawn.numpy(), drawn[0], drawn[:0]):
        checked = space.check(good)
        assert checked.dtype == torch.float32 and torch.equal(checked, torch.as_tensor(good, dtype=torch.float32))
    assert torch.equal(space.check(torch.full(space.dims, space.high)), torch.full(space.dims, space.high))
    for bad, words in [(space.high + 0.1, "outside Box"), (space.low - 0.1, "outside Box"), (float("nan"), "NaN")]:
        spoiled = drawn.clone()
        spoiled[(3, *[0] * len(space.dims))] = bad
        with pytest.raises(ValueOutOfRange, match=f"up .*{words}"):
            space.check(spoiled, "up")
    with pytest.raises(ValueOutOfRange, match="no list of values"):
        space.values()


@every_space
def test_one_value_is_drawn(space):
    assert space.sample().shape == space.shape


@pytest.mark.parametrize("shape", [(), (3,), (2, 2, 3), (3, 2)])
def test_a_box_wants_its_shape(shape):
    if shape[-2:] == (2, 3):
        assert Box(0.0, 1.0, (2, 3)).check(torch.zeros(shape)).shape == shape
    else:
        with pytest.raises(ValueOutOfRange, match=r"up has shape.*2, 3"):
            Box(0.0, 1.0, (2, 3)).check(torch.zeros(shape), "up")


def test_sequences_of_dims_are_tuples():
    assert Box(0.0, 1.0, [2]) == Box(0.0, 1.0, (2,)) and hash(Box(0.0, 1.0, [2]))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Finite(0), "at least one value, not 0"),
        (lambda: Finite(2, ("a",)), "2 values have 1 names"),
        (lambda: Grid(0, 3), "0x3"),
        (lambda: Grid(3, -1), "3x-1"),
        (lambda: Box(1.0, 1.0), "low < high"),
        (lambda: Box(float("nan"), 1.0), "low < high"),
    ],
)
def test_spaces_that_cannot_be(make, words):
    with pytest.raises(ValueOutOfRange, match=words):
        make()


def test_binary_is_zero_or_one():
    with pytest.raises((TypeError, ValueOutOfRange)):
        Binary(3)


@every_space
def test_spaces_are_values(space):
    assert pickle.loads(pickle.dumps(space)) == space and hash(pickle.loads(pickle.dumps(space))) == hash(space)
    assert eval(repr(space)) == space
    assert sum(space == other for other in FINITE + BOXES) == 1


@settings(deadline=None, max_examples=30)
@given(grids)
def test_grids_number_their_cells_row_by_row(grid):
    numbers = np.arange(grid.size).reshape(grid.rows, grid.columns)
    rows, columns = np.indices(numbers.shape)
    positions = np.stack([rows, columns], -1).reshape(-1, 2)
    cells = grid.values()
    np.testing.assert_array_equal(grid.position(cells), positions)
    np.testing.assert_array_equal(grid.cell(torch.as_tensor(rows), torch.as_tensor(columns)), numbers)
    np.testing.assert_array_equal(grid.one_hot(cells), np.eye(grid.size))
    offsets = positions[:, None] - positions[None]
    np.testing.assert_array_equal(grid.offset(cells[:, None], cells[None]), offsets)
    np.testing.assert_allclose(grid.distance(cells[:, None], cells[None]), np.sqrt((offsets**2).sum(-1)), rtol=1e-6)
    law = grid.uniform()
    np.testing.assert_allclose(law.log_prob(cells), -np.log(grid.size), rtol=1e-5, atol=1e-6)


def test_positions_of_single_cells():
    assert Grid(3, 4).position(7).tolist() == [1, 3]
    assert int(Grid(3, 4).cell(1, 3)) == 7
