"""The threshold between silence and sound, against all splits of small sets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hardware import SoundError, TwoMeans
from hardware.two_means import two_means

LEVELS = arrays(float, st.integers(2, 9), elements=st.floats(-90, 0).map(lambda x: round(x, 3)))


def spread(values, low, high):
    return np.minimum((values - low) ** 2, (values - high) ** 2).sum()


@given(LEVELS)
def test_no_other_split_is_better(values):
    low, high = two_means(values)
    ordered = np.sort(values)
    best = min(spread(values, ordered[:k].mean(), ordered[k:].mean()) for k in range(1, len(values)))
    assert spread(values, low, high) == pytest.approx(best, abs=1e-8)


@given(arrays(float, (3, 6), elements=st.floats(-90, 0)))
def test_rows_are_apart(values):
    low, high = two_means(values)
    for i, row in enumerate(values):
        assert (low[i], high[i]) == two_means(row)


def test_one_value_has_one_mean():
    assert two_means(np.array([-3.0])) == (-3.0, -3.0)


@pytest.mark.parametrize("exponent", [0.0, 0.3, 0.5, 1.0])
def test_two_levels_are_told_apart(exponent):
    ear = TwoMeans(exponent)
    heard = [bool(ear.hear(np.array(level))) for level in (-50.0, -49, -20, -51, -21)]
    assert heard == [False, False, True, False, True]
    assert -50 < ear.threshold < -20


def test_the_threshold_depends_on_what_is_averaged():
    levels = np.array([-50.0, -50, -50, -20, -20])
    decibels, loudness, amplitude, power = (float(TwoMeans(x).middle(levels)) for x in (0.0, 0.3, 0.5, 1.0))
    assert decibels == pytest.approx(-35)
    assert decibels < loudness < amplitude < power == pytest.approx(-20 - 10 * np.log10(2), abs=0.01)
    # Of two equal levels and hardly any exponent, nothing but decibels is left.
    assert float(TwoMeans(1e-6).middle(levels)) == pytest.approx(decibels, abs=1e-3)


def test_a_hum_is_no_sound():
    ear = TwoMeans()
    noise = np.random.default_rng(0).normal(-40, 0.3, 50)
    assert not any(bool(ear.hear(np.array(level))) for level in noise)
    assert np.isinf(ear.threshold)
    assert bool(ear.hear(np.array(-20.0)))


def test_a_threshold_is_held_once_there_is_one():
    ear = TwoMeans(hold=3)
    rooms = np.array([[-50.0, -40.0], [-50.0, -40.0], [-20.0, -40.0]])
    for levels in rooms:
        ear.hear(levels)
    first = ear.threshold.copy()
    assert np.isfinite(first[0]) and np.isinf(first[1])
    for _ in range(4):
        ear.hear(np.array([-10.0, -10.0]))
    assert ear.threshold[0] == first[0] and -40 < ear.threshold[1] < -10
    follows = TwoMeans()
    for level in (-50.0, -50, -20, -10, -10, -10, -10):
        follows.hear(np.array(level))
    assert follows.threshold > first[0]


@pytest.mark.parametrize("wrong", [{"exponent": -0.1}, {"exponent": 2.0}, {"apart": -1.0}])
def test_bad_ears(wrong):
    with pytest.raises(SoundError, match="An ear needs"):
        TwoMeans(**wrong)
