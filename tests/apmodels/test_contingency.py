"""The contingency model against the thesis's closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import betaln

from apmodels import Contingency, ValueOutOfRange
from inference import Exact


def counted(model, calls, sounds):
    """P2, Q2, P3, Q3 by walking through the record (4.36, 4.37)."""
    timer, counts = model.window[1] + 1, {"answer": [0, 0], "background": [0, 0]}
    for call, sound in zip(calls, sounds, strict=True):
        timer = 0 if call else min(timer + 1, model.window[1] + 1)
        if model.window[0] <= timer <= model.window[1]:
            counts["answer"][int(sound)] += 1
        elif not model.echo[0] <= timer <= model.echo[1]:
            counts["background"][int(sound)] += 1
    return *counts["answer"][::-1], *counts["background"][::-1]


def odds(model, p2, q2, p3, q3):
    """The posterior odds of 4.46 and 4.47; with the background's prior in both places where errata say so."""
    (a2, b2), (a3, b3) = model.answering, model.background
    ratio = betaln(a2 + p2, b2 + q2) - betaln(a2, b2) + betaln(a3 + p3, b3 + q3) - betaln(a3 + p2 + p3, b3 + q2 + q3)
    return np.exp(ratio) * model.presence / (1 - model.presence)


pairs = st.tuples(st.floats(0.3, 5), st.floats(0.3, 5))


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 1), st.integers(0, 2), st.integers(0, 2), st.floats(0.05, 0.9), pairs, pairs, st.integers(0, 10_000)
)
def test_the_posterior_odds_are_those_of_the_appendix(first, more, wait, presence, answering, background, seed):
    window = (first + 1 + wait, first + 1 + wait + more)
    model = Contingency(presence=presence, echo=(0, first), window=window, answering=answering, background=background)
    random = np.random.default_rng(seed)
    calls, sounds = random.integers(0, 2, (2, 12))
    belief = Exact(model, torch.float64).filter(torch.tensor(calls), torch.tensor(sounds))[-1]
    expected = odds(model, *counted(model, calls, sounds))
    assert float(belief.marginal("responsive").probs[1]) == pytest.approx(expected / (1 + expected), abs=1e-6)


@pytest.mark.parametrize(("echo", "window"), [((0, 1), (1, 3)), ((-1, 0), (1, 3)), ((0, 0), (3, 1))])
def test_an_echo_must_end_before_answers_begin(echo, window):
    with pytest.raises(ValueOutOfRange, match="the echo must end before answers begin"):
        Contingency(echo=echo, window=window)


@pytest.mark.parametrize("period", [0, -1.0, "a while"])
def test_a_period_takes_time(period):
    with pytest.raises(ValueOutOfRange, match="a period is seconds"):
        Contingency(period=period)
