"""Voices of the fetched data, as studies use them: prompts as answers, two people talking as the background."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import soundfile
from scipy.signal import resample_poly

from apmodels import ValueOutOfRange
from experiments import data

# Samples a second of everything here: the prompts' own.
RATE = 8000
# What is below this share of the peak is silence before and after a prompt.
FAINT = 0.03


def utterances(shortest: float, longest: float, half: str = "test") -> list[np.ndarray]:
    """Return the prompts that last so many seconds, (samples,) at ``RATE``; every other one is of the other half."""
    chosen = [sound for sound in _prompts()[_half(half) :: 2] if shortest <= len(sound) / RATE <= longest]
    if not chosen:
        raise ValueOutOfRange(f"no prompt of the {half} half lasts {shortest} to {longest} s")
    return chosen


def conversation(half: str = "test") -> np.ndarray:
    """Return two people taking turns, (samples,) at ``RATE``, from the first word on; its first or its last half."""
    (path,) = data.files("pyannote-sample", "**/*.wav")
    (turns,) = data.files("pyannote-sample", "**/*.rttm")
    sound = _read(path)
    words = [line.split() for line in turns.read_text().splitlines() if line.strip()]
    begin = min(float(word[3]) for word in words)
    end = max(float(word[3]) + float(word[4]) for word in words)
    middle = (begin + end) / 2
    first, last = ((begin, middle), (middle, end))[_half(half)]
    return sound[round(first * RATE) : round(last * RATE)]


def _half(half: str) -> int:
    halves = ("fit", "test")
    if half not in halves:
        raise ValueOutOfRange(f"there is no {half} half of the voices; there are fit and test")
    return halves.index(half)


@cache
def _prompts() -> list[np.ndarray]:
    found = []
    for path in data.files("asterisk-en", "**/*.wav"):
        sound = _read(path)
        loud = np.flatnonzero(np.abs(sound) > FAINT * np.abs(sound).max())
        if len(loud):
            found.append(sound[loud[0] : loud[-1] + 1])
    return found


def _read(path: Path) -> np.ndarray:
    sound, rate = soundfile.read(path, dtype="float32")
    return resample_poly(sound, RATE, rate).astype(np.float32) if rate != RATE else sound
