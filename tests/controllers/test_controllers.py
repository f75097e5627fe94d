"""Every controller, for one belief and for a batch of them."""

import pytest
import torch

from apmodels import Grid, ValueOutOfRange, VisualSearch, interest
from controllers import Constant, GreedyInfomax, MostProbable, Playback, Random
from inference import Exact, Refusal
from tests.inference.oracle import Oracle
from tests.models import Caller, Coin, Dial, Door, Lamp, Twins


@pytest.fixture(scope="module")
def search():
    return Exact(VisualSearch(grid=Grid(3, 3)), torch.float64)


def shapes(action):
    return {n: tuple(v.shape) for n, v in action.items()} if isinstance(action, dict) else action.shape


@pytest.mark.parametrize("batch", [None, 1, 4])
def test_actions_have_the_beliefs_batch_and_lie_in_their_space(batch, search):
    rows = () if batch is None else (batch,)
    belief = search.start(batch)
    record = torch.tensor([3, 1, 2])
    for controller in (
        Random(search),
        Constant(search, 3),
        Playback(search, record),
        MostProbable(search),
        MostProbable(search, first=4),
        GreedyInfomax(search, samples=4),
        GreedyInfomax(search, candidates=[2, 8], samples=4),
    ):
        action = controller.act(belief)
        assert action.shape == rows and action.dtype == torch.int64
        assert bool(((action >= 0) & (action < 9)).all())
        search.update(belief, action, torch.zeros(*rows, 9))


@pytest.mark.parametrize("batch", [None, 3])
def test_several_actions_and_none(batch):
    rows = () if batch is None else (batch,)
    twins, coin = Exact(Twins()), Exact(Coin())
    both = {"left": 1, "right": 2}
    for controller in (Random(twins), Constant(twins, both), Playback(twins, {"left": [1], "right": [2]})):
        assert shapes(controller.act(twins.start(batch))) == {"left": rows, "right": rows}
    assert Random(coin).act(coin.start(batch)) is None


@pytest.mark.parametrize("batch", [None, 3])
def test_random_numbers_of_a_box(batch):
    dial = Exact(Dial())
    rows = () if batch is None else (batch,)
    turns = Random(dial).act(dial.start(batch))
    assert turns.shape == rows and bool((turns.abs() <= 1).all())


def test_random_is_uniform(search):
    count = 20_000
    drawn = torch.bincount(Random(search, seed=3).act(search.start(count)), minlength=9)
    expected = count / 9
    assert ((drawn - expected) ** 2 / expected).sum() < 26.1  # the 99.9 % point of chi-squared with 8 degrees


def test_random_can_be_repeated_and_leaves_torch_alone(search):
    belief = search.start(50)
    state = torch.get_rng_state()
    controller = Random(search, seed=7)
    first, second = controller.act(belief), controller.act(belief)
    controller.reset(7)
    assert torch.equal(controller.act(belief), first) and not torch.equal(first, second)
    assert not torch.equal(Random(search, seed=8).act(belief), first)
    assert torch.equal(torch.get_rng_state(), state)


def test_constant_stays(search):
    belief = search.start(2)
    controller = Constant(search, 5)
    for _ in range(2):
        action = controller.act(belief)
        assert action.tolist() == [5, 5]
        belief = search.update(belief, action, torch.zeros(9))


@pytest.mark.parametrize("controller", [Constant, Playback])
@pytest.mark.parametrize("wrong", [[9], [-1], [float("nan")], {"fixatoin": [0]}])
def test_a_given_action_is_checked_at_once(controller, wrong, search):
    with pytest.raises(ValueOutOfRange):
        controller(search, wrong)


def test_playback_goes_by_the_beliefs_time_and_ends(search):
    record = torch.tensor([[3, 1], [4, 2]])
    batched, shared = Playback(search, record), Playback(search, record[0])
    belief = search.start(2)
    for t in range(2):
        assert torch.equal(batched.act(belief), record[:, t])
        assert shared.act(belief).tolist() == [record[0, t]] * 2
        belief = search.update(belief, 0, torch.zeros(9))
    for controller in (batched, shared):
        with pytest.raises(ValueOutOfRange, match="2 steps; this is step 3"):
            controller.act(belief)


def test_most_probable_looks_where_it_probably_is(search):
    glimpses = 3.0 * torch.eye(9)[[2, 7]]
    belief = search.update(search.start(2), torch.tensor([2, 7]), glimpses)
    assert MostProbable(search).act(belief).tolist() == [2, 7]
    assert torch.equal(MostProbable(search).act(belief), belief.most_probable())


def test_most_probable_breaks_ties_at_random(search):
    belief = search.start(9000)
    controller = MostProbable(search, seed=1)
    drawn = controller.act(belief)
    assert (torch.bincount(drawn, minlength=9) - 1000).abs().max() < 5 * 1000**0.5
    controller.reset(1)
    assert torch.equal(controller.act(belief), drawn)
    assert not torch.equal(MostProbable(search, seed=2).act(belief), drawn)


def test_ties_are_only_among_the_best():
    lamp = Exact(Lamp(cells=3), torch.float64)
    probs = torch.tensor([[0.4, 0.4, 0.2], [0.2, 0.5, 0.3], [0.3, 0.35, 0.35]], dtype=torch.float64)
    belief = lamp.start(3)
    object.__setattr__(belief, "log_probs", probs.log())
    drawn = torch.stack([MostProbable(lamp, seed=s).act(belief) for s in range(40)], 1)
    assert [set(row.tolist()) for row in drawn] == [{0, 1}, {1}, {1, 2}]


def test_the_first_action_is_given_only_once(search):
    controller = MostProbable(search, first=4)
    belief = search.start(2)
    assert controller.act(belief).tolist() == [4, 4]
    belief = search.update(belief, 4, 3.0 * torch.eye(9)[[2, 7]])
    assert controller.act(belief).tolist() == [2, 7]
    with pytest.raises(ValueOutOfRange):
        MostProbable(search, first=9)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (Caller(), None),
        (Twins(), "chooses one action"),
        (Coin(), "chooses one action"),
        (Dial(), "values of the interest"),
        (VisualSearch(grid=Grid(2, 2)), None),
        (Lamp(cells=3), None),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, str) else "",
)
def test_most_probable_refuses_what_it_cannot_serve(model, words):
    engine = Exact(model)
    if words is None:
        MostProbable(engine)
        return
    with pytest.raises(Refusal, match=words):
        MostProbable(engine)


class Half(Lamp):
    """The interest is a function of the only variable that has the action's values."""

    @interest
    def interest(self, lit):
        return lit // 2


def test_most_probable_does_not_take_a_function_for_its_argument():
    with pytest.raises(Refusal, match="values of the interest"):
        MostProbable(Exact(Half()))


def test_infomax_needs_one_action_and_candidates():
    with pytest.raises(Refusal, match="chooses one action"):
        GreedyInfomax(Exact(Twins()))
    with pytest.raises(Refusal, match="turn is a continuum"):
        GreedyInfomax(Exact(Dial()))
    with pytest.raises(ValueOutOfRange):
        GreedyInfomax(Exact(Lamp()), candidates=[4])


@pytest.mark.parametrize("model", [Lamp(), Door(), Caller()], ids=lambda m: type(m).__name__)
def test_infomax_takes_the_action_that_tells_the_most(model):
    engine, oracle = Exact(model, torch.float64), Oracle(model)
    name, observed = model.action_names[0], model.observation_names[0]
    names = list(model.structure.interest)
    controller = GreedyInfomax(engine)
    for seed in range(3):
        record = model.simulate(3, seed=seed)
        actions = [{name: a} for a in record[name]]
        seen = [{observed: y} for y in record[observed]]
        belief = engine.filter(record[name], record[observed])[-1]
        gains = [oracle.gain(names, actions, seen, {name: k}) for k in range(model.space(name).size)]
        assert gains[int(controller.act(belief))] == pytest.approx(max(gains), abs=1e-9)


def test_infomax_takes_each_belief_of_a_batch_for_itself():
    engine = Exact(Lamp(), torch.float64)
    belief = engine.update(engine.start(3), torch.tensor([0, 3, 1]), torch.tensor([1.0, 0.0, 0.0]))
    singles = [engine.update(engine.start(), a, y) for a, y in ((0, 1.0), (3, 0.0), (1, 0.0))]
    controller = GreedyInfomax(engine)
    assert controller.act(belief).tolist() == [int(controller.act(single)) for single in singles]
    assert GreedyInfomax(engine, candidates=[2, 1]).act(belief).tolist()[0] in (1, 2)


def test_infomax_on_a_continuum_turns_as_far_as_it_may():
    engine = Exact(Dial(), torch.float64)
    assert float(GreedyInfomax(engine, [0.0, 0.2, 1.0, 0.5]).act(engine.start())) == 1.0


def test_infomax_can_be_repeated(search):
    belief = search.update(search.start(20), 4, torch.zeros(9))
    first = [GreedyInfomax(search, samples=2, seed=3).act(belief) for _ in range(2)]
    assert torch.equal(*first)
