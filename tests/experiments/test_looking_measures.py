"""What the studies of learning to look measure, on curves and movements of which the answer is known."""

import numpy as np
import pytest
import xarray as xr

from experiments.looking import astray, by_least_squares, first_within, off, settled
from experiments.looking_disturbed import first_on_end
from experiments.looking_dynamics import course, latency, recoil, settling
from experiments.looking_noise import as_the_thesis, by_evidence
from experiments.looking_track import Tracker, overshoots


def curve(*rows, rate=10.0):
    """Shares of the way, (frame, motor), one motor a row; frames end at 0.1, 0.2 ... seconds."""
    values = np.array(rows, dtype=float).T
    times = (np.arange(len(values)) + 1) / rate
    return xr.DataArray(values, dims=("frame", "motor"), coords={"frame": times})


# Learning.


def test_an_error_has_settled_after_it_was_too_large_for_the_last_time():
    wrong = np.array([1.0, 0.01, 0.5, 0.02, 0.01])
    assert settled(wrong, 0.02) == 3 and first_within(wrong, 0.02) == 1
    assert settled(np.array([0.01, 0.01]), 0.02) == 0
    assert settled(np.array([1.0, 0.01, 0.03]), 0.02) == np.inf == first_within(np.array([1.0]), 0.02)


def test_the_first_of_so_many_right_on_end():
    right = np.array([True, False, True, True, False, True, True, True])
    assert [first_on_end(right, count) for count in (1, 2, 3, 4)] == [1, 3, 6, np.inf]
    assert first_on_end(~right, 8) == np.inf


def test_least_squares_find_what_motors_do_and_pass_over_what_was_not_seen():
    random = np.random.default_rng(0)
    actuation, commands = random.normal(size=(2, 3)), random.uniform(-1, 1, (10, 3))
    truth = commands @ actuation.T
    truth[4] = np.nan
    truth[7, 1] = np.nan
    assert np.allclose(by_least_squares(commands, truth), actuation)
    # Of movements that do not agree, the sum of squares is least.
    truth = np.nan_to_num(truth) + random.normal(size=truth.shape)
    best = by_least_squares(commands, truth)
    left = truth - commands @ best.T
    assert np.abs(left.T @ commands).max() < 1e-9


def test_an_error_is_a_share_of_the_truth_and_a_match_is_off_by_its_worse_direction():
    best = xr.DataArray([[3.0, 0.0], [0.0, 4.0]], dims=("direction", "motor"))
    actuation = xr.concat([best * 0, best, best + 0.5], "movement")
    moved = xr.DataArray([[0.0, 0.0], [3.0, -1.0], [1.0, 1.0]], dims=("movement", "direction"))
    truth = moved + np.array([[9.0, 9.0], [0.5, 2.0], [np.nan, 0.0]])
    found = xr.Dataset({"best": best, "actuation": actuation, "moved": moved, "truth": truth})
    assert off(found).values == pytest.approx([1.0, 0.0, 1.0 / 5.0])
    # The first look is no movement.
    assert astray(found)[0] == 2.0 and np.isnan(astray(found)[1]) and astray(found).shape == (2,)


# Going on.


def test_a_course_is_the_share_of_the_way_along_the_motors_own_direction():
    way = np.array([[30.0, 0.0], [40.0, -20.0]])
    shares = np.array([[0.0, 0.1], [0.5, 0.4], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0]])
    actuation = shares[:, None] * way
    # What goes across the way is none of it.
    actuation[1, :, 0] += [-4.0, 3.0]
    dims = ("frame", "direction", "motor")
    gone = course(xr.DataArray(actuation, dims=dims, coords={"frame": np.arange(5.0)}))
    assert gone.transpose("frame", "motor").values == pytest.approx(shares)


def test_a_movement_begins_when_a_tenth_of_its_way_is_gone_for_good():
    gone = curve(
        # Between 0.2 and 0.3 s, from 0 to 0.5: a fifth of it is a tenth of the way.
        [0, 0, 0.5, 1, 1],
        # A tremble before is not yet it.
        [0, 0.2, 0.05, 0.55, 1],
        # Already there in the first frame.
        [0.3, 0.6, 1, 1, 1],
        # Falling back below after half of the way does not count.
        [0, 0.6, 0.0, 1, 1],
    )
    assert latency(gone).values == pytest.approx([0.22, 0.31, 0.1, 0.1 + 0.1 / 6])


def test_a_movement_has_ended_when_it_stays_near_its_end():
    gone = curve(
        [0, 0.5, 0.95, 1.0, 1.0],
        # Past it, and back.
        [0, 0.95, 1.2, 0.89, 1.0],
        [1, 1, 1, 1, 1],
        # Not until the last frame, if at all.
        [0, 0, 0, 0, 0.5],
    )
    assert settling(gone).values == pytest.approx([0.3, 0.5, 0.1, 0.5])
    assert recoil(gone).values == pytest.approx([0.0, 0.2, 0.0, -0.5])


# Following.


class Still:
    """A head that is told and does nothing."""

    motors, size = 2, (240, 320)


def tracker(knows=True):
    # Two motors, four frames: nothing, half, too far, there.
    learned = np.array([0.0, 0.5, 1.25, 1.0])[:, None, None] * np.array([[10.0, 0.0], [0.0, 20.0]])
    return Tracker(Still(), learned, knows, every=2)


def test_what_commands_have_moved_so_far_and_will_have():
    eye = tracker()
    assert eye.moved().tolist() == [0, 0] and eye.moved(9).tolist() == [0, 0]
    eye.sent, eye.frames = [(0, np.array([1.0, 0.0])), (2, np.array([0.0, 1.0]))], 2
    # Two frames after the first, in the same frame as the second.
    assert eye.moved().tolist() == [5.0, 0.0]
    assert eye.moved(1).tolist() == [12.5, 0.0] and eye.moved(2).tolist() == [10.0, 10.0]
    assert eye.moved(3).tolist() == [10.0, 25.0] and eye.moved(50).tolist() == [10.0, 20.0]
    # 2 frames until half of the way is passed by all together: 0.5 is not yet more than half.
    assert eye.half == 3


def test_a_face_that_keeps_moving_is_met_where_it_will_be():
    eye, ahead = tracker(), []
    for frame, place in ((0, [0.0, 0.0]), (2, [4.0, -2.0]), (4, [10.0, -3.0]), (6, [13.0, 5.0])):
        eye.frames = frame
        ahead.append(eye.ahead(np.array(place)).tolist())
    # Two looks tell no speed that can be relied upon; of three the lesser counts, and none where it turns.
    assert ahead[:2] == [[0, 0], [0, 0]]
    assert ahead[2] == pytest.approx([2.0 * 3, -0.5 * 3]) and ahead[3] == pytest.approx([1.5 * 3, 0.0])


def test_how_far_the_gaze_goes_past_a_face():
    # Two jumps of a face, four frames each, (right, down) of the middle.
    place = np.array(
        [[30.0, 40.0], [15.0, 20.0], [-6.0, -8.0], [0.0, 0.0], [-50.0, 0.0], [-25.0, 9.0], [-1.0, 0.0], [-2.0, 0.0]]
    )
    part = xr.Dataset({"place": (("time", "direction"), place)})
    assert overshoots(part, 4) == pytest.approx([0.2, 0.0])


# Straying.


def test_noise_that_movements_show_is_found_either_way():
    random, best = np.random.default_rng(0), np.array([[100.0, 20.0], [-10.0, 80.0]])
    straying, slip = np.array([[40.0, 5.0], [5.0, 20.0]]), 5.0
    commands = random.uniform(-1, 1, (161, 2))
    commands[0] = 0
    expected = commands @ best.T
    spread = np.sqrt((commands**2) @ (straying**2).T + slip**2)
    moved = expected + spread * random.normal(size=expected.shape)
    part = xr.Dataset(
        {
            "command": (("movement", "motor"), commands),
            "moved": (("movement", "direction"), moved),
            "expected": (("movement", "direction"), expected),
            "actuation": (("movement", "direction", "motor"), np.repeat(best[None], 161, 0)),
        }
    )
    assert np.abs(by_evidence(part, slip) - straying).max() < 9
    # Errors are told as if they added up, which they do not: only the larger ones are nearly right.
    thesis = as_the_thesis(part, warm=0)
    assert thesis.shape == (2, 2) and thesis[0, 0] > thesis[0, 1] and thesis[1, 1] > thesis[1, 0]
    assert thesis[0, 0] == pytest.approx(40, rel=0.3)
