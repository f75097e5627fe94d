"""What is said of sound, once: a microphone, a loudspeaker, how loud something is, and what may go wrong."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

# What is softer than this, in dB of full scale, is silence: half a step of 16 bits is at -96.
SILENCE = -90.0


class SoundError(ValueError):
    """A sound or a sound device that cannot be used; the message is one sentence that says what to do."""


@runtime_checkable
class Microphone(Protocol):
    """Where sound comes from. It may also have ``batch`` (so many rooms side by side), ``reset`` and ``close``."""

    # Samples a second.
    rate: int

    def read(self, samples: int) -> np.ndarray:
        """Return the next sound, (samples,), or (batch, samples), in [-1, 1]; wait for it. SoundError if it is gone."""
        ...


@runtime_checkable
class Speaker(Protocol):
    """Where sound goes to."""

    # Samples a second.
    rate: int

    def play(self, sound: np.ndarray, where: np.ndarray) -> None:
        """Begin to play a sound, (samples,) in [-1, 1], in the rooms where that is true, (*batch,); do not wait."""
        ...


def decibels(sound: np.ndarray) -> np.ndarray:
    """Mean power of sounds, (*batch, samples) to (*batch,), in dB of full scale; ``SILENCE`` at the least."""
    power = np.mean(np.square(sound, dtype=np.float64), axis=-1)
    return 10 * np.log10(np.maximum(power, 10 ** (SILENCE / 10)))


def at_level(sound: np.ndarray, level: float) -> np.ndarray:
    """Return a sound (samples,) scaled to this mean power, in dB of full scale."""
    return (sound * 10 ** ((level - decibels(sound)) / 20)).astype(np.float32)


def chirp(
    rate: int, seconds: float = 0.2, low: float = 600.0, high: float = 1800.0, level: float = -20.0
) -> np.ndarray:
    """Return a robot's call: a tone that rises from low to high (Hz), faded in and out, (samples,) float32."""
    time = np.arange(round(rate * seconds)) / rate
    tone = np.sin(2 * np.pi * (low * time + (high - low) * time**2 / (2 * seconds)))
    return at_level(tone * np.sin(np.pi * time / seconds) ** 0.5, level)
