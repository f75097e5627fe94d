import pytest
import torch

from apmodels import Grid, ValueOutOfRange, VisualSearch
from hardware import Body, Simulated
from tests.models import Coin, Coupled, Dial, Door, Lamp, Twins


def play(body, actions):
    return torch.stack([body.step(action) for action in actions])


def test_it_is_a_body():
    body = Simulated(Door())
    assert isinstance(body, Body)
    body.close()


@pytest.mark.parametrize("batch", [None, 1, 4])
def test_observations_have_the_batch(batch):
    rows = () if batch is None else (batch,)
    search = Simulated(VisualSearch(grid=Grid(2, 3)), batch)
    assert search.step(0).shape == (*rows, 6)
    assert search.step(torch.zeros(rows, dtype=torch.int64)).shape == (*rows, 6)
    assert search.truth["target"].shape == rows
    assert Simulated(Dial(), batch).step(0.5).shape == rows
    twins = Simulated(Twins(), batch).step({"left": 0, "right": torch.full(rows, 2)})
    assert {name: value.shape for name, value in twins.items()} == {"here": rows, "there": rows}
    assert set(Simulated(Coin(), batch).step()) == {"toss", "reading"}


def test_a_seed_draws_the_same_worlds_whatever_else_draws_in_between():
    first, second = Simulated(Coupled(), 50), Simulated(Coupled(), 50)
    first.reset(3)
    second.reset(3)
    actions = [0, 2, 1]
    seen = play(first, actions)
    torch.rand(5)
    other = []
    for action in actions:
        torch.rand(1)
        Simulated(Coupled(), 2).step(1)
        other.append(second.step(action))
    assert torch.equal(seen, torch.stack(other))
    second.reset(4)
    assert not torch.equal(play(second, actions), seen)
    first.reset(3)
    assert torch.equal(play(first, actions), seen)


def test_without_a_seed_worlds_differ():
    body = Simulated(Lamp(), 200)
    first = body.truth["lit"]
    body.reset()
    assert not torch.equal(body.truth["lit"], first)


def test_torchs_own_generator_is_left_alone():
    torch.manual_seed(0)
    state = torch.get_rng_state()
    body = Simulated(Coupled(), 3)
    body.reset(1)
    body.step(0)
    body.reset()
    body.step(0)
    assert torch.equal(torch.get_rng_state(), state)


def test_statics_stay_and_may_be_given():
    body = Simulated(Coupled(), 30, given={"kind": torch.ones(30)})
    assert bool((body.truth["kind"] == 1).all())
    mixed = Simulated(Coupled(), 30)
    before = mixed.truth["kind"]
    for _ in range(3):
        mixed.step(1)
        assert torch.equal(mixed.truth["kind"], before)
    assert set(mixed.truth) == {"kind", "near", "far"}
    body.reset(5)
    assert bool((body.truth["kind"] == 1).all())


def test_worlds_are_drawn_from_the_model():
    body = Simulated(Door(), 20_000)
    body.reset(0)
    light = body.step(1)
    is_open = body.truth["is_open"]
    assert float(is_open.mean()) == pytest.approx(0.9, abs=0.015)
    assert float(light[is_open == 1].mean()) == pytest.approx(0.9, abs=0.015)
    assert float(light[is_open == 0].mean()) == pytest.approx(0.2, abs=0.05)
    body.step(0)
    assert float(body.truth["is_open"][is_open == 1].mean()) == pytest.approx(0.8, abs=0.015)
    assert float(body.truth["is_open"][is_open == 0].mean()) == pytest.approx(0.1, abs=0.04)


@pytest.mark.parametrize("wrong", [2, -1, float("nan"), [0, 1, 0], None, {"psh": 1}])
@pytest.mark.parametrize("batch", [None, 2])
def test_a_bad_action_is_out_of_range_and_changes_nothing(wrong, batch):
    body, twin = Simulated(Door(), batch), Simulated(Door(), batch)
    body.reset(1)
    twin.reset(1)
    with pytest.raises(ValueOutOfRange, match=r"push|action"):
        body.step(wrong)
    assert torch.equal(body.step(1), twin.step(1))


@pytest.mark.parametrize("batch", [0, -1])
def test_an_empty_batch_is_refused(batch):
    with pytest.raises(ValueOutOfRange, match="empty"):
        Simulated(Door(), batch)
