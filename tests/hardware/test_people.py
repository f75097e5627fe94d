"""People who stand about, sway and walk to and fro."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import Person

SOME = np.zeros((4, 4), np.uint8)
times = st.floats(0, 500)
people = st.builds(
    Person,
    picture=st.just(SOME),
    distance=st.floats(0.1, 10),
    bearing=st.floats(-90, 90),
    up=st.floats(-1, 1),
    sway=st.floats(0, 0.5),
    pace=st.one_of(st.just(0.0), st.floats(0.1, 60)),
    turn=st.floats(1, 120),
    phase=st.floats(0, 100),
)


def ahead(person, bearing):
    """Where they would stand without swaying."""
    angle = math.radians(bearing)
    return np.array([math.sin(angle) * person.distance, math.cos(angle) * person.distance, person.up])


@settings(deadline=None)
@given(person=people, time=times)
def test_they_stay_near_where_they_stand_and_sway_no_farther_than_is_said(person, time):
    place, bearing = person.place(time)
    away = place - ahead(person, bearing)
    assert math.hypot(*away[:2]) <= person.sway + 1e-9 and abs(away[2]) <= person.sway / 2 + 1e-9
    # To and fro is across the way to the head.
    assert abs(away[:2] @ ahead(person, bearing)[:2]) < 1e-6
    assert abs(bearing - person.bearing) <= person.turn + 1e-9


@settings(deadline=None)
@given(person=people, time=times)
def test_they_go_as_far_to_the_left_as_to_the_right(person, time):
    if not person.pace:
        return
    half = 2 * person.turn / person.pace
    one, other = person.place(time)[1], person.place(time + half)[1]
    assert one + other == pytest.approx(2 * person.bearing, abs=1e-6)


def test_they_set_out_to_the_right_at_their_pace_and_turn_where_is_said():
    person = Person(SOME, distance=2.0, bearing=10.0, up=0.1, pace=20.0, turn=30.0)
    bearings = [person.place(time)[1] for time in (0.0, 1.0, 1.5, 2.0, 3.0, 4.5, 6.0)]
    assert bearings == pytest.approx([10, 30, 40, 30, 10, -20, 10])
    place, _ = person.place(1.0)
    assert place == pytest.approx([2 * math.sin(math.radians(30)), 2 * math.cos(math.radians(30)), 0.1])


def test_who_talks_moves_all_the_time_and_nearly_as_far_as_is_said():
    person = Person(SOME, sway=0.2)
    places = np.stack([person.place(time)[0] for time in np.arange(0, 60, 0.05)])
    assert 0.18 < np.abs(places[:, 0]).max() <= 0.2
    assert 0.09 < np.abs(places[:, 2] - person.up).max() <= 0.1
    assert (np.abs(np.diff(places[:, 0])) > 0).all()


def test_a_phase_is_how_far_ahead_somebody_sways():
    one, other = Person(SOME, sway=0.2), Person(SOME, sway=0.2, phase=3.0)
    assert np.allclose(one.place(8.0)[0], other.place(5.0)[0])
    assert not np.allclose(one.place(5.0)[0], other.place(5.0)[0])


@pytest.mark.parametrize("given", [{"distance": 0}, {"height": -1}, {"turn": 0}, {"sway": -0.1}, {"pace": -1}])
def test_bad_people(given):
    with pytest.raises(ValueError, match="a person is at a distance"):
        Person(SOME, **given)
