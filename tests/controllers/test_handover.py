"""One controller first, then another."""

import pytest
import torch

from apmodels import Contingency, ValueOutOfRange
from controllers import Constant, Handover, Playback, Random, rollout
from hardware import Simulated
from inference import Exact

ENGINE = Exact(Contingency())


def test_it_hands_over():
    plan = Playback(ENGINE, torch.tensor([1, 1, 1, 0, 1, 0]))
    both = Handover(Constant(ENGINE, 0), 2, plan)
    found = rollout(Simulated(Contingency(), batch=3), ENGINE, both, 6)
    assert found.vocalize.values.tolist() == [[0, 0, 1, 0, 1, 0]] * 3
    assert "Constant" in repr(both) and "Playback" in repr(both)


def test_both_begin_anew():
    both = Handover(Random(ENGINE), 10, Random(ENGINE, seed=7))
    once, again = (rollout(Simulated(Contingency()), ENGINE, both, 20, seed=3) for _ in range(2))
    assert once.vocalize.equals(again.vocalize)
    assert 0 < once.vocalize.values.mean() < 1


def test_no_negative_time():
    with pytest.raises(ValueOutOfRange, match="0 steps or more"):
        Handover(Constant(ENGINE, 0), -1, Constant(ENGINE, 1))
