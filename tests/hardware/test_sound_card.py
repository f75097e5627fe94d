"""The sound card, with a fake library under it that does what PortAudio does."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from hardware import SoundBooth, SoundCard, SoundError


class PortAudioError(Exception):
    pass


def library(microphone=True, speaker=True, seconds=1e9, pace=1000, starts=True):
    """A machine with these devices; its microphone gives so many seconds of sound, this many times as fast as life."""
    played, opened = [], []

    class InputStream:
        def __init__(self, samplerate, device, channels, dtype, callback):
            if not microphone:
                raise PortAudioError("Error querying device -1")
            self.callback, self.left, self.open = callback, seconds * samplerate, True
            self.block = samplerate // 50

        def start(self):
            opened.append(self)
            if not starts:
                raise PortAudioError("Unanticipated host error")
            threading.Thread(target=self.run, daemon=True).start()

        def run(self):
            rng, buffer = np.random.default_rng(0), np.zeros((self.block, 1), np.float32)
            while self.open and self.left > 0:
                # As PortAudio does, in the same place again and again.
                buffer[:] = rng.normal(0, 0.01, (self.block, 1))
                self.callback(buffer, self.block, None, None)
                buffer[:] = 1
                self.left -= self.block
                time.sleep(1 / 50 / pace)

        def close(self):
            self.open = False

    def query_devices(device=None, kind=None):
        if kind == "output" and not speaker:
            raise PortAudioError("Error querying device -1")
        return {}

    def play(sound, rate, device=None):
        if not speaker or played == ["gone"]:
            raise PortAudioError("Device unavailable")
        played.append((len(sound), rate))

    return SimpleNamespace(
        InputStream=InputStream,
        PortAudioError=PortAudioError,
        query_devices=query_devices,
        play=play,
        stop=lambda: None,
        played=played,
        opened=opened,
    )


def test_it_hears_and_plays(monkeypatch):
    fake = library(seconds=60)
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    card = SoundCard(rate=8000)
    booth = SoundBooth(card, card, period=0.25, check=4)
    booth.reset()
    for call in (1, 0, 0, 1):
        booth.step(call)
    assert fake.played == [(1600, 8000)] * 3  # one in the check
    assert booth.log["level"] == pytest.approx([-40] * 4, abs=1)
    booth.close()
    booth.close()


def test_a_microphone_that_goes_away_is_noticed(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", library(seconds=1.0))
    card = SoundCard(rate=8000, patience=0.05)
    assert card.read(4000).shape == (4000,)
    with pytest.raises(SoundError, match="is it still there"):
        card.read(8000)


def test_what_was_not_read_is_forgotten(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", library(seconds=1.0))
    card = SoundCard(rate=8000, patience=0.3)
    card.read(100)
    time.sleep(0.3)  # all of it has come
    card.reset()
    with pytest.raises(SoundError, match="is it still there"):
        card.read(1)


def test_silence_is_not_played(monkeypatch):
    fake = library()
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    card = SoundCard(rate=8000)
    card.play(np.zeros(8), np.array(False))
    assert not fake.played
    card.close()


def test_a_loudspeaker_that_goes_away_is_noticed(monkeypatch):
    fake = library()
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    card = SoundCard(rate=8000)
    fake.played.append("gone")
    with pytest.raises(SoundError, match="does not play any more"):
        card.play(np.zeros(8), np.array(True))
    card.close()


@pytest.mark.parametrize("missing", [{"microphone": False}, {"speaker": False}])
def test_no_devices(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, "sounddevice", library(**missing))
    with pytest.raises(SoundError, match="no microphone with a loudspeaker"):
        SoundCard()


def test_a_microphone_that_does_not_start_is_let_go(monkeypatch):
    fake = library(starts=False)
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    with pytest.raises(SoundError, match="Unanticipated"):
        SoundCard()
    assert [stream.open for stream in fake.opened] == [False]


def test_no_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(SoundError, match=r"apmodels\[hardware\]"):
        SoundCard()
