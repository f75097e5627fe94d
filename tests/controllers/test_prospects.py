"""What is expected of controllers without episodes: against plans' own values, and against episodes."""

import numpy as np
import pytest
import torch

from apmodels import Contingency, ValueOutOfRange
from controllers import Constant, DynamicProgramming, Random, RecedingHorizon, TemporalDifference, rollout
from controllers.prospects import planned, prospects, remembered, steady
from controllers.temporal_difference import Table
from hardware import Simulated
from inference import Exact

STEPS = 12


@pytest.fixture(scope="module")
def engine():
    return Exact(Contingency(presence=0.3, background=(2.0, 1.0)), torch.float64)


@pytest.fixture(scope="module")
def table(engine):
    return Table(DynamicProgramming(engine, 1).mdp, STEPS, False)


@pytest.fixture(scope="module")
def learner(engine):
    made = TemporalDifference(engine, 6, anywhere=True, epsilon=0.1, seed=1)
    made.learn(300)
    return made


def rewards(machine, table):
    found = []
    for mass in prospects(machine, table, STEPS):
        assert mass.sum() == pytest.approx(1, abs=1e-12) and (mass >= 0).all()
        found.append(mass @ table.reward)
    return np.array(found)


@pytest.mark.parametrize("weights", ["summed", "terminal"])
def test_a_plan_is_worth_what_it_was_planned_to_be(engine, table, weights):
    plan = DynamicProgramming(engine, STEPS, weights)
    found = rewards(planned(plan, table), table)
    assert found @ plan.weights == pytest.approx(plan.plan.value, abs=1e-12)


def test_a_plan_whose_horizon_recedes_is_followed(engine, table):
    plan = DynamicProgramming(engine, 5, steps=STEPS)
    check(engine, table, plan, planned(plan, table))


def test_a_memory_of_everything_is_worth_what_was_learned(engine):
    made = TemporalDifference(engine, 6, epsilon=0.1)
    made.learn(200)
    table = Table(made.mdp, 6, False)
    found = [mass @ table.reward for mass in prospects(remembered(RecedingHorizon(made, 5, 1)), table, 6)]
    assert sum(found) == pytest.approx(made.plan.value, abs=1e-12)


@pytest.mark.parametrize("memory", [0, 2, 4])
def test_short_memories_are_worth_what_episodes_say(engine, table, learner, memory):
    controller = RecedingHorizon(learner, memory, 6 - memory)
    check(engine, table, controller, remembered(controller))


def test_actions_at_random_and_for_ever_are_worth_what_episodes_say(engine, table, learner):
    check(engine, table, Random(engine), steady(learner.mdp))
    assert np.allclose(rewards(steady(learner.mdp, 0), table), -float(engine.start().entropy()))
    check(engine, table, Constant(engine, 1), steady(learner.mdp, 1))


def check(engine, table, controller, machine):
    """Of 4,000 episodes, the sums of rewards, and the last."""
    seen = -rollout(Simulated(engine.model, 4000), engine, controller, STEPS, seed=3).entropy.values
    found = rewards(machine, table)
    for mine, theirs in ((found.sum(), seen.sum(1)), (found[-1], seen[:, -1])):
        assert abs(mine - theirs.mean()) <= 4 * theirs.std() / 4000**0.5 + 1e-9


def test_a_memory_that_is_too_long_is_refused(learner):
    controller = RecedingHorizon(learner, 2, 2)
    controller.memory = 40
    with pytest.raises(ValueOutOfRange, match="too many to remember"):
        remembered(controller)
