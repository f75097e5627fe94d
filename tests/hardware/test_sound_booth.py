"""Calls, levels and bits, with made sounds: what is heard must be what was played."""

import numpy as np
import pytest
import torch

from hardware import Caregiver, Microphone, SoundBooth, SoundError, Speaker, TwoMeans, VirtualRoom
from hardware.sound import SILENCE, at_level, chirp, decibels

RATE = 8000


def tone(seconds, hertz=440.0):
    return np.sin(2 * np.pi * hertz * np.arange(round(seconds * RATE)) / RATE).astype(np.float32)


def room(responsive=(True, False), **options):
    law = {"utterances": [tone(1.0)], "latency": (0.5, 0.5), "gap": np.inf} | options.pop("law", {})
    made = VirtualRoom(Caregiver(**law), responsive, RATE, **({"noise_level": -70.0} | options))
    made.reset(0)
    made.enter()
    return made


def test_levels():
    assert decibels(tone(1.0)) == pytest.approx(10 * np.log10(0.5), abs=1e-6)
    assert decibels(np.zeros((2, 10))).tolist() == [SILENCE, SILENCE]
    assert decibels(at_level(tone(0.3), -33.0)) == pytest.approx(-33, abs=1e-4)
    assert decibels(chirp(16000, level=-12.0)) == pytest.approx(-12, abs=1e-4)
    assert len(chirp(RATE, 0.25)) == 2000


def test_a_call_rises_and_fades():
    call = chirp(RATE, seconds=1.0, low=600.0, high=1800.0)
    for part, hertz in ((slice(1000), 675.0), (slice(-1000, None), 1725.0)):
        spectrum = np.abs(np.fft.rfft(call[part]))
        assert np.argmax(spectrum) * RATE / 1000 == pytest.approx(hertz, abs=75)
    assert max(decibels(call[:8]), decibels(call[-8:])) < decibels(call) - 20


def test_devices_are_devices():
    made = room()
    assert isinstance(made, Microphone) and isinstance(made, Speaker)


def test_answers_come_when_the_law_says():
    """The call is 0.2 s, the answer begins 0.5 s after its end and lasts 1 s, and nobody else answers."""
    made = room(delay=0.05, decay=0.0)
    made.play(chirp(RATE), np.array([True, True]))
    sound = made.read(RATE * 3)
    ten = decibels(sound.reshape(2, -1, RATE // 100))
    loud = ten > -50
    answered, alone = ([float(at) / 100 for at in np.flatnonzero(row)] for row in loud)
    own = [at for at in answered if at < 0.4]
    assert own == alone and min(own) == pytest.approx(0.05, abs=0.011) and max(own) == pytest.approx(0.24, abs=0.02)
    answer = [at for at in answered if at >= 0.4]
    assert min(answer) == pytest.approx(0.7, abs=0.011) and max(answer) == pytest.approx(1.69, abs=0.011)


def test_reading_in_pieces_is_reading_at_once():
    whole, pieces = (room(noise_level=-200.0) for _ in range(2))
    for made in (whole, pieces):
        made.play(chirp(RATE), np.array([True, True]))
    long = whole.read(16000)
    short = np.concatenate([pieces.read(n) for n in (1, 799, 5200, 6400, 3600)], 1)
    assert np.abs(long).max() > 0.05
    np.testing.assert_allclose(short, long, atol=1e-6)


def test_levels_of_a_room():
    talk = np.random.default_rng(0).normal(size=RATE * 4)
    made = room(conversation=talk, conversation_level=-31.0, noise_level=-80.0)
    assert decibels(made.read(RATE * 4)) == pytest.approx([-31, -31], abs=0.1)
    made = room(speech_level=-23.0, noise_level=-80.0, law={"utterances": [tone(2.0)], "latency": (0.0, 0.0)})
    made.play(np.zeros(8), np.array([True, True]))
    assert decibels(made.read(RATE)[:, 800:]) == pytest.approx([-23, -80], abs=0.2)


def test_a_second_call_is_answered_after_the_first():
    made = room(noise_level=-90.0, law={"utterances": [tone(2.0)], "latency": (0.0, 0.0), "pause": 0.5})
    call = np.zeros(8)
    for _ in range(3):
        made.play(call, np.array([True, False]))
    loud = decibels(made.read(RATE * 8)[0].reshape(-1, 400)) > -50
    assert loud.sum() * 0.05 == pytest.approx(4.0, abs=0.11)  # two are said, the third call is lost
    edges = np.flatnonzero(np.diff(loud.astype(int))) * 0.05
    assert edges[1] - edges[0] == pytest.approx(0.5, abs=0.11)


def test_some_calls_are_not_answered():
    made = room(np.full(400, True), noise_level=-90.0, law={"chance": 0.3, "latency": (0.0, 0.0)})
    made.play(np.zeros(8), np.full(400, True))
    answered = (decibels(made.read(RATE)) > -50).mean()
    assert abs(answered - 0.3) < 5 * np.sqrt(0.3 * 0.7 / 400)


def test_who_does_not_respond_talks_all_the_same():
    made = room(np.full(200, False), noise_level=-90.0, law={"gap": 3.0, "pause": 0.0})
    loud = np.concatenate([decibels(made.read(800)) > -50 for _ in range(300)])
    # Utterances of 1 s, silences of 3 s in the mean: a quarter of the time; a little more, for two halves of a piece.
    assert 0.2 < loud.mean() < 0.33
    polite = room(np.full(20, True), noise_level=-90.0, law={"gap": 3.0})
    assert not (decibels(polite.read(RATE * 5)) > -50).any()
    silent = room(np.full(20, False), noise_level=-90.0)
    assert not (decibels(silent.read(RATE * 5)) > -50).any()


def test_rooms_hear_different_things():
    talk = np.random.default_rng(0).normal(size=RATE * 4)
    made = room(np.full(9, True), conversation=talk, conversation_level=-31.0, noise_level=-200.0)
    assert len(np.unique(made.read(8)[:, 0].round(6))) > 1
    law = {"utterances": [tone(0.3), tone(0.9)], "latency": (0.0, 0.0)}
    made = room(np.full(40, True), noise_level=-90.0, law=law)
    made.play(np.zeros(8), np.full(40, True))
    longer = decibels(made.read(RATE)[:, RATE // 2 :]) > -50
    assert 5 < longer.sum() < 35


def test_nobody_answers_before_the_check_is_over():
    made = room(np.full(3, True))
    booth = SoundBooth(made, made, check=8)
    booth.reset(1)
    assert np.isfinite(booth.ear.threshold).all() and not booth.log["level"]
    assert booth.step(np.zeros(3)).tolist() == [0, 0, 0]
    assert booth.step(np.ones(3)).tolist() == [1, 1, 1]
    assert [booth.step(np.zeros(3)).tolist() for _ in range(3)] == [[1, 1, 1], [1, 1, 1], [0, 0, 0]]
    assert len(booth.log["level"]) == len(booth.log["threshold"]) == 5


def test_the_same_seed_is_the_same_session():
    def session(seed):
        booth = SoundBooth(made := room(np.full(4, True), law={"chance": 0.5}), made, ear=TwoMeans())
        booth.reset(seed)
        return torch.stack([booth.step(np.full(4, t % 4 == 0)) for t in range(40)])

    assert session(3).equal(session(3)) and not session(3).equal(session(4))


def test_a_session_knows_nothing_of_the_last():
    booth = SoundBooth(made := room(np.full(4, True)), made)
    thresholds = []
    for _ in range(2):
        booth.reset(5)
        booth.step(np.zeros(4))
        thresholds.append(booth.ear.threshold)
        for _ in range(3):
            booth.step(np.ones(4))
    assert thresholds[0].tolist() == thresholds[1].tolist()


class Counting:
    """A microphone of an odd rate that counts what is asked of it."""

    rate = 11025

    def __init__(self):
        self.asked = 0

    def read(self, samples):
        self.asked += samples
        return np.zeros(samples)


def test_no_time_is_lost_between_periods():
    microphone = Counting()
    booth = SoundBooth(microphone, period=0.0123, check=0)
    booth.reset()
    for step in range(1, 200):
        assert booth.step(0).shape == ()
        assert abs(microphone.asked - step * 0.0123 * 11025) <= 0.5
    booth.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: SoundBooth(Counting(), period=0.0),
        lambda: SoundBooth(Counting(), check=-1),
        lambda: Caregiver([]),
        lambda: Caregiver([tone(1.0)], latency=(2.0, 1.0)),
        lambda: Caregiver([tone(1.0)], chance=1.5),
        lambda: VirtualRoom(None, []),
        lambda: VirtualRoom(None, np.ones((2, 2))),
    ],
)
def test_bad_rooms(make):
    with pytest.raises(SoundError) as error:
        make()
    assert str(error.value).endswith(".") and "\n" not in str(error.value)
