"""Tree search against exhaustive search, and against looking one step ahead."""

import numpy as np
import pytest
import torch

from apmodels import BlindingSearch, Calibrated, Contingency, Grid, ValueOutOfRange, VisualSearch
from controllers import GreedyInfomax, TreeSearch, rollout
from hardware import Simulated
from inference import Exact, Refusal, Variational
from inference.rows import rows, stacked, taken
from tests.models import Caller, Coupled, Dial, Door, Lamp, Twins


def exhaustive(engine, belief, counted, worth):
    """The most weighted reward that can be added, by trying every action and outcome; and that of every action."""
    best = []
    for action in range(engine.model.space(engine.model.action_names[0]).size):
        total = 0.0
        for outcome in (0.0, 1.0):
            try:
                after = engine.update(belief, action, torch.tensor(outcome))
            except ValueOutOfRange:
                continue
            chance = float((after.log_evidence - belief.log_evidence).exp())
            value = counted[0] * (worth(after) - worth(belief))
            if len(counted) > 1:
                value += max(exhaustive(engine, after, counted[1:], worth))
            total += chance * value
        best.append(total)
    return best


def certainty(belief):
    """A reward of one's own: how probable the best guess is, of every belief."""
    logs = belief.engine.projections.marginal(belief.log_probs, belief.engine.structure.interest)[1]
    found = logs.amax(1).exp()
    return found[0] if belief.batch is None else found


@pytest.mark.parametrize("model", [Caller(), Door(), Lamp(cells=3), Contingency(presence=0.4)], ids=lambda m: repr(m))
@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_where_outcomes_are_few_it_becomes_exhaustive_search(model, horizon):
    engine = Exact(model, torch.float64)
    belief = engine.update(engine.start(), 1, torch.tensor(1.0))
    expected = exhaustive(engine, belief, list(range(horizon, 0, -1)), lambda b: -float(b.entropy()))
    found = TreeSearch(engine, horizon=horizon, simulations=200).values(belief)
    assert found.numpy() == pytest.approx(expected, abs=1e-6)


def test_any_reward_and_any_weights():
    engine = Exact(Caller(presence=0.3), torch.float64)
    belief = engine.start()
    expected = exhaustive(engine, belief, [1.5, 1.0, 1.0], lambda b: float(certainty(b)))
    search = TreeSearch(engine, horizon=3, weights=[0.5, 0, 1], reward=certainty, simulations=300)
    assert search.values(belief).numpy() == pytest.approx(expected, abs=1e-6)


def test_values_come_nearer_to_those_of_exhaustive_search_as_simulations_grow():
    engine = Exact(Caller(), torch.float64)
    belief = engine.start()
    expected = exhaustive(engine, belief, [4, 3, 2, 1], lambda b: -float(b.entropy()))
    errors = [
        np.abs(TreeSearch(engine, horizon=4, simulations=n).values(belief).numpy() - expected).max()
        for n in (1, 30, 600)
    ]
    assert errors[2] < 1e-6 and errors[2] <= errors[1] <= errors[0] + 1e-9


@pytest.mark.parametrize("batch", [None, 3])
def test_trees_go_on_growing_from_what_was_reached(batch):
    """What is left to do after a step is less than all, and comes to the same."""
    engine = Exact(Caller(), torch.float64)
    search = TreeSearch(engine, horizon=4, simulations=400)
    action = search.act(engine.start(batch))
    sounds = torch.tensor(1.0) if batch is None else torch.tensor([1.0, 0.0, 1.0])
    belief = engine.update(engine.start(batch), action, sounds)
    reached = search._reached(rows(belief), 10)
    assert reached is not None and int(reached.used.min()) > 20
    search.simulations = 150
    found = search.values(belief).reshape(-1, 2)
    for row, sound in enumerate(sounds.reshape(-1)):
        single = engine.update(engine.start(), action.reshape(-1)[row], sound)
        expected = exhaustive(engine, single, [4, 3, 2, 1], lambda b: -float(b.entropy()))
        assert found[row].numpy() == pytest.approx(expected, abs=1e-6)
    search.reset()
    assert search._reached(rows(belief), 10) is None


def test_a_horizon_of_one_step_is_greedy():
    engine = Exact(VisualSearch(grid=Grid(3, 4)))
    glimpses = torch.randn(5, 12, generator=torch.Generator().manual_seed(0))
    belief = engine.update(engine.start(5), 5, glimpses)
    controllers = TreeSearch(engine, horizon=1, samples=2000), GreedyInfomax(engine, samples=2000)
    gains = engine.gain(belief, samples=2000)
    for controller in controllers:
        looks = controller.act(belief)
        assert bool((gains.gather(1, looks[:, None])[:, 0] > gains.amax(1) - 0.03).all())


def test_two_steps_ahead_by_drawing_come_near_to_a_sum_over_many_glimpses():
    engine = Exact(VisualSearch(grid=Grid(1, 3), acuity=Calibrated(width=1.0)), torch.float64)
    belief = engine.start()
    gains = engine.gain(belief, samples=4000)
    expected = []
    for action in range(3):
        seen, _ = engine.imagine(rows(belief), torch.tensor([action]), 1000, 1)
        after = engine.update(engine.start(1000), torch.tensor(action), seen["glimpse"][0])
        expected.append(float(2 * gains[action] + engine.gain(after, samples=64).amax(1).mean()))
    found = TreeSearch(engine, horizon=2, branches=128, samples=512, simulations=2).values(belief)
    assert found.numpy() == pytest.approx(expected, rel=0.08)


def test_batches_are_those_of_their_members_and_seeds_reproduce():
    engine = Exact(VisualSearch(grid=Grid(2, 3), acuity=Calibrated(width=1.0)), torch.float64)
    glimpses = torch.randn(3, 6, generator=torch.Generator().manual_seed(3))
    batch = engine.update(engine.start(3), 2, glimpses)
    make = lambda seed: TreeSearch(engine, horizon=2, simulations=6, seed=seed)  # noqa: E731
    found = make(1).values(batch)
    assert torch.equal(found, make(1).values(batch)) and not torch.equal(found, make(2).values(batch))
    for row, glimpse in zip(found, glimpses, strict=True):
        single = engine.update(engine.start(), 2, glimpse)
        assert make(1).values(single).numpy() == pytest.approx(row.numpy(), abs=1e-6)
    some = TreeSearch(engine, candidates=[5, 1], simulations=3).act(batch)
    assert bool(((some == 5) | (some == 1)).all())


def test_what_cannot_be_done_is_refused():
    engine = Exact(Door())
    with pytest.raises(ValueOutOfRange, match="of 1 or more, not 0, 32, 16 and 64"):
        TreeSearch(engine, horizon=0)
    with pytest.raises(ValueOutOfRange, match=r"exponent in \[0, 1\]"):
        TreeSearch(engine, widening=2.0)
    with pytest.raises(Refusal, match="continuum; give TreeSearch"):
        TreeSearch(Exact(Dial()))
    with pytest.raises(Refusal, match="chooses one action"):
        TreeSearch(Exact(Twins()))
    with pytest.raises(Refusal, match="imagines no observations"):
        TreeSearch(Variational(Door()))


def test_rows_of_beliefs_can_be_taken_and_stacked():
    for model in (Coupled(), Contingency()):
        engine = Exact(model)
        first = rows(engine.start())
        second = engine.update(engine.start(3), 1, torch.tensor([0.0, 1.0, 1.0]))
        both = stacked([first, second])
        assert both.batch == 4 and torch.equal(both.entropy()[1:], second.entropy())
        assert torch.equal(taken(both, torch.tensor([2, 0])).entropy(), both.entropy()[[2, 0]])


def compared(model, steps, batch, seed=0, **settings):
    """How much less uncertain the tree search is than the greedy controller, on average over steps, by episode."""
    found = []
    for make in (GreedyInfomax, lambda engine: TreeSearch(engine, **settings)):
        engine = Exact(model)
        data = rollout(Simulated(model, batch=batch), engine, make(engine), steps, seed=seed)
        found.append(data.entropy.values)
    return found[0] - found[1]


def significance(difference):
    """The mean of differences by episode in units of its standard error."""
    return difference.mean() / max(difference.std() / len(difference) ** 0.5, 1e-12)


def test_it_accepts_being_blind_for_what_it_will_see():
    """Greedy looking never moves, as a saccade shows nothing at once."""
    model = BlindingSearch(grid=Grid(1, 4), acuity=Calibrated(width=1.0))
    difference = compared(model, 10, 24, horizon=4, simulations=4, branches=8, samples=32)
    assert significance(difference[:, -1]) > 3


@pytest.mark.slow
def test_on_a_grid_too():
    difference = compared(
        BlindingSearch(grid=Grid(3, 3), acuity=Calibrated(width=1.2)), 10, 60, horizon=4, simulations=8, samples=32
    )
    assert significance(difference.mean(1)) > 3 and significance(difference[:, -1]) > 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "steps", "batch", "settings"),
    [
        (VisualSearch(grid=Grid(3, 3), acuity=Calibrated(width=1.2)), 8, 200, {"horizon": 2, "simulations": 8}),
        (VisualSearch(grid=Grid(5, 5)), 8, 50, {"horizon": 2, "simulations": 4}),
        (Contingency(presence=0.3), 10, 40, {"horizon": 4, "simulations": 20}),
    ],
    ids=["3x3", "5x5", "contingency"],
)
def test_it_is_never_significantly_worse_than_greedy(model, steps, batch, settings):
    assert significance(compared(model, steps, batch, **settings).mean(1)) > -2
