"""Recordings: any format that libsndfile knows, whatever their rate, width and number of channels."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile

from hardware.sound import SILENCE, SoundError, decibels

# A recording has this many samples a second at the least, and at the most.
RATES = (4_000, 384_000)
# A sample so near to full scale was cut off.
FULL = 0.999


def read_sound(path: str | os.PathLike[str]) -> tuple[np.ndarray, int]:
    """Read a recording.

    Returns:
        (samples,) float32, the mean of all channels, or the loudest where they cancel; samples a second. Full scale is
        1; only a recording of floating-point numbers may be beyond it.

    Raises:
        SoundError: there is no such file, it is no recording, holds no sound, or is silent all through.
    """
    path = Path(os.path.expanduser(path))
    if path.is_dir() or not path.exists():
        raise SoundError(
            f"'{path}' is {'a folder' if path.is_dir() else 'not there'}; give a recording, such as a WAV."
        )
    try:
        channels, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, OSError, TypeError) as error:
        raise SoundError(f"'{path}' cannot be read as a recording: {str(error).rstrip('.')}.") from None
    if not len(channels):
        raise SoundError(f"'{path}' holds no sound at all.")
    if not RATES[0] <= rate <= RATES[1]:
        raise SoundError(f"'{path}' has {rate} samples a second; {RATES[0]:,} to {RATES[1]:,} can be used.")
    if not np.isfinite(channels).all():
        raise SoundError(f"'{path}' holds samples that are no numbers.")
    return _mono(path, channels), int(rate)


def _mono(path: Path, channels: np.ndarray) -> np.ndarray:
    levels = decibels(channels.T)
    if levels.max() <= SILENCE:
        raise SoundError(f"'{path}' is silent from beginning to end; was the microphone on?")
    mixed = channels.mean(1)
    # Two microphones wired the wrong way round cancel each other.
    cancels = decibels(mixed) < levels.max() - 20
    return channels[:, levels.argmax()] if cancels else mixed


def clipped(sound: np.ndarray) -> float:
    """Return the share of samples that were too loud for the recording."""
    return float((np.abs(sound) >= FULL).mean())


@dataclass
class SoundFile:
    """A microphone that hears a recording, once."""

    path: str | os.PathLike[str]

    def __post_init__(self) -> None:
        self.sound, self.rate = read_sound(self.path)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Begin anew."""
        self.place = 0

    def read(self, samples: int) -> np.ndarray:
        """Return the next (samples,); SoundError where the recording ends before."""
        if self.place + samples > len(self.sound):
            raise SoundError(f"'{self.path}' is over after {len(self.sound) / self.rate:.1f} s.")
        self.place += samples
        return self.sound[self.place - samples : self.place]
