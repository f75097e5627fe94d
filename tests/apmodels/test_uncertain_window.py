"""Contingency with answers of unknown length, against the mixture of all lengths, each a plain contingency."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import inference
from apmodels import Contingency, UncertainWindow
from inference import Exact

PRIORS = {"presence": 0.2, "answering": (2.0, 1.0), "background": (0.5, 1.5)}
RECORDS = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1)), min_size=1, max_size=25)
MIXED = Exact(UncertainWindow(**PRIORS), torch.float64)
PLAIN = [Exact(Contingency(window=(1, last), **PRIORS), torch.float64) for last in (1, 2, 3)]


@settings(deadline=None, max_examples=40)
@given(RECORDS)
def test_it_is_a_mixture_of_windows(record):
    calls, sounds = (torch.tensor(column) for column in zip(*record, strict=True))
    beliefs = [engine.filter(calls, sounds.double())[-1] for engine in PLAIN]
    evidence = np.array([float(belief.log_evidence) for belief in beliefs])
    chance = np.array([float(belief.marginal("responsive").probs[1]) for belief in beliefs])
    weights = np.exp(evidence - evidence.max())
    found = MIXED.filter(calls, sounds.double())[-1]
    assert float(found.marginal("responsive").probs[1]) == pytest.approx(weights @ chance / weights.sum(), abs=1e-9)
    lasting = found.marginal("lasting").probs.numpy()
    assert lasting == pytest.approx(weights / weights.sum(), abs=1e-9)
    assert float(found.log_evidence) == pytest.approx(np.log(np.mean(np.exp(evidence))), abs=1e-9)


def test_a_window_of_one_step_is_certain():
    record = torch.tensor([1, 0, 0, 1, 0]), torch.tensor([1.0, 1, 0, 1, 1])
    chances = [
        float(Exact(kind(window=(2, 2)), torch.float64).filter(*record)[-1].marginal("responsive").probs[1])
        for kind in (Contingency, UncertainWindow)
    ]
    assert chances[0] == pytest.approx(chances[1], abs=1e-12)


@pytest.mark.slow
def test_other_engines_agree():
    report = inference.check(UncertainWindow(presence=0.3), steps=3, records=2)
    assert report, report
