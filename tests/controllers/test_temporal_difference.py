"""What is learned from trials against what is computed, and short memories against long ones."""

import numpy as np
import pytest
import torch

from apmodels import Contingency, ValueOutOfRange
from controllers import DynamicProgramming, RecedingHorizon, TemporalDifference, rollout
from hardware import Simulated
from inference import Exact


@pytest.fixture(scope="module")
def engine():
    return Exact(Contingency(presence=0.3), torch.float64)


@pytest.mark.parametrize(("optimism", "epsilon"), [(1.0, 0.0), (0.2, 0.05)])
def test_enough_trials_teach_the_best_policy(engine, optimism, epsilon):
    best = DynamicProgramming(engine, 6).plan.value
    learner = TemporalDifference(engine, 6, epsilon=epsilon, optimism=optimism)
    assert learner.table.best(learner.weights) == pytest.approx(best, abs=1e-12)
    before = learner.plan.value
    done = learner.learn(20_000)
    assert done.sum() == 6 * 20_000 and (done > 0).all()
    assert before < learner.plan.value == pytest.approx(best, abs=1e-9)


def test_values_are_never_below_what_is_true_where_they_began_above(engine):
    """Backing up the best action keeps optimism optimistic; the first state's value falls to the truth."""
    learner = TemporalDifference(engine, 5)
    best = learner.table.best(learner.weights)
    for _ in range(5):
        learner.learn(200)
        assert learner.values[0, learner.mdp.first, 0] >= best - 1e-12


def test_the_same_seed_learns_the_same(engine):
    found = []
    for _ in range(2):
        learner = TemporalDifference(engine, 5, seed=3)
        learner.learn(50)
        learner.learn(50)
        found.append(learner.values)
    assert np.array_equal(*found)
    other = TemporalDifference(engine, 5, seed=4)
    other.learn(100)
    assert not np.array_equal(other.values, found[0])


@pytest.mark.parametrize("anywhere", [False, True])
def test_what_was_learned_is_kept_and_opened_again(engine, anywhere, tmp_path):
    learner = TemporalDifference(engine, 6, anywhere=anywhere)
    learner.learn(3000)
    learner.save(tmp_path / "learned.npz")
    again = DynamicProgramming.load(engine, tmp_path / "learned.npz")
    one, other = (rollout(Simulated(engine.model, batch=200), engine, c, steps=6, seed=4) for c in (learner, again))
    assert (one.vocalize == other.vocalize).all() and one.vocalize.values.any()
    assert again.plan.value == learner.plan.value


def test_a_memory_as_long_as_the_episode_is_the_plan_itself(engine):
    learner = TemporalDifference(engine, 8, anywhere=True)
    learner.learn(3000)
    body = Simulated(engine.model, batch=50)
    long, whole = RecedingHorizon(learner, 7, 1), learner
    one, other = (rollout(body, engine, controller, steps=8, seed=2) for controller in (long, whole))
    assert (one.vocalize == other.vocalize).all()


def test_what_was_seen_long_ago_is_forgotten(engine):
    """Two histories that differ in their beginning alone lead to the same actions once it is forgotten."""
    learner = TemporalDifference(engine, 5, anywhere=True)
    learner.learn(2000)
    controller = RecedingHorizon(learner, 3, 2)
    calls = torch.tensor([[1, 0, 0, 0, 0, 0, 1, 0], [0, 1, 0, 0, 0, 0, 1, 0]])
    sounds = torch.tensor([[1.0, 1, 1, 1, 0, 0, 1, 1], [1, 1, 1, 0, 0, 0, 1, 1]])
    belief = engine.start(2)
    for t in range(8):
        controller.act(belief)
        belief = engine.update(belief, calls[:, t], sounds[:, t])
    controller.act(belief)
    seen = sum(controller.steps)
    assert np.array_equal(seen[0], seen[1])
    assert len(set(controller.act(engine.start(2)).tolist())) == 1


def test_stretches_of_sessions_teach_what_a_short_memory_meets(engine):
    """Every value that the controller asks for comes to be what backward induction says."""
    learner = TemporalDifference(
        engine, 5, epsilon=0.3, optimism=0.0, anywhere=True, memory=3, session=20, symmetric=True
    )
    best = learner.table.solved(learner.weights)
    assert best[0, learner.starts, 0].mean() == learner.table.best(learner.weights)
    done = learner.learn(5000)
    assert done.sum() == 20 * 5000
    assert np.allclose(learner.values[0, :, 0], best[0, :, 0], atol=1e-9)
    assert learner.plan.value == pytest.approx(learner.table.best(learner.weights), abs=1e-9)


def test_mirror_images_are_learned_together(engine):
    twins = []
    for symmetric in (False, True):
        learner = TemporalDifference(engine, 5, anywhere=True, session=10, symmetric=symmetric)
        learner.learn(30)
        mirror = learner.table.states.index(learner.table.counts[..., ::-1])
        twins.append(np.array_equal(learner.values, learner.values[:, :, mirror]))
    assert twins == [False, True]


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda e: TemporalDifference(e, 0), "1 step or more"),
        (lambda e: TemporalDifference(e, 3, epsilon=2.0), "epsilon and optimism"),
        (lambda e: TemporalDifference(e, 3, memory=3), "a memory of fewer, not 3"),
        (lambda e: TemporalDifference(e, 3, session=9), "a session of as many"),
        (lambda e: RecedingHorizon(TemporalDifference(e, 4), 4, 1), "cannot remember 4 and look 1 ahead"),
        (
            lambda e: RecedingHorizon(TemporalDifference(e, 4), 2, 1).act(e.filter([0, 0], [0.0, 1.0])[-1]),
            "must follow",
        ),
    ],
)
def test_what_makes_no_sense_is_told(engine, made, words):
    with pytest.raises(ValueOutOfRange, match=words):
        made(engine)
