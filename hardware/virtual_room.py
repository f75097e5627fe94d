"""Rooms made of real sounds: a robot's own call, a caregiver, a conversation and noise, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hardware.sound import SoundError, at_level, decibels

# Two utterances of a caregiver are kept: the one under way, and the next.
SLOTS = 2
NEVER = -(10**12)


@dataclass(frozen=True)
class Caregiver:
    """How somebody talks: the law of her answers.

    Attributes:
        utterances: what she says, sounds (samples,) of one rate; one of them, at random, at a time.
        latency: shortest and longest seconds from the end of a call to the beginning of her answer; all between
            are alike.
        chance: P(a call is answered).
        gap: where she does not respond to calls she talks all the same: mean seconds of silence between
            utterances; infinite is silent.
        pause: seconds after an utterance before she begins the next.
    """

    utterances: Sequence[np.ndarray]
    latency: tuple[float, float] = (0.5, 1.0)
    chance: float = 1.0
    gap: float = 6.0
    pause: float = 0.2

    def __post_init__(self) -> None:
        first, last = self.latency
        if not len(self.utterances) or not 0 <= first <= last or not 0 <= self.chance <= 1 or self.gap <= 0:
            raise SoundError(
                f"A caregiver needs something to say, a latency such as (0.5, 1.0), a chance in [0, 1] and a gap above "
                f"0, not {len(self.utterances)} utterances, {self.latency}, {self.chance} and {self.gap}."
            )


class VirtualRoom:
    """Rooms side by side, each with a loudspeaker and a microphone; what is played is heard, and may be answered.

    Levels are in dB of the microphone's full scale.

    Args:
        caregiver: who is there; None is nobody.
        responsive: whether calls are answered, (batch,) booleans; their number is that of the rooms.
        rate: samples a second, of all sounds.
        conversation: others talk: a sound (samples,) that goes round and round, from a random place on.
        conversation_level: of the whole of it; None leaves it out.
        noise_level: of white noise.
        speech_level: of every utterance of the caregiver.
        echo_level: how loud the robot hears its own call.
        delay: seconds until it hears it.
        decay: seconds in which its reverberation falls by 60 dB.
    """

    def __init__(
        self,
        caregiver: Caregiver | None,
        responsive: Sequence[bool] | np.ndarray,
        rate: int = 8000,
        conversation: np.ndarray | None = None,
        conversation_level: float | None = None,
        noise_level: float = -60.0,
        speech_level: float = -26.0,
        echo_level: float = -20.0,
        delay: float = 0.1,
        decay: float = 0.2,
    ):
        self.caregiver, self.rate, self.responsive = caregiver, rate, np.asarray(responsive, dtype=bool)
        if self.responsive.ndim != 1 or not len(self.responsive):
            raise SoundError(f"responsive must be booleans, one a room, not {self.responsive.shape}.")
        self.batch = len(self.responsive)
        self.bank, self.lengths = _bank(caregiver.utterances if caregiver else [], speech_level)
        self.loop = None
        if conversation is not None and conversation_level is not None:
            self.loop = at_level(conversation, conversation_level)
        self.noise = 10 ** (noise_level / 20)
        self.echo_level, self.delay, self.decay = echo_level, delay, decay
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Begin anew, with nobody there yet; the same seed makes the same sounds."""
        self.random = np.random.default_rng(seed)
        self.now, self.present = 0, False
        self.offset = self.random.integers(0, 1 if self.loop is None else len(self.loop), self.batch)
        self.echo = np.zeros(1, np.float32)
        self.called = np.full(self.batch, NEVER)
        self.begins = np.full((self.batch, SLOTS), NEVER)
        self.says = np.zeros((self.batch, SLOTS), dtype=int)

    def enter(self) -> None:
        """Let the caregiver in."""
        self.present = True

    def play(self, sound: np.ndarray, where: np.ndarray) -> None:
        """Call in the rooms where that is true, (batch,)."""
        self.echo = self._echo(sound)
        self.called = np.where(where, self.now + round(self.delay * self.rate), self.called)
        # Drawn for every room, so that what is random does not depend on who calls when.
        answered = self.random.random(self.batch)
        latency, which = self.random.uniform(0, 1, self.batch), self.random.random(self.batch)
        if self.caregiver is None or not self.present:
            return
        first, last = self.caregiver.latency
        begin = self.now + len(sound) + self.rate * (first + (last - first) * latency)
        self._say(where & self.responsive & (answered < self.caregiver.chance), begin, which)

    def read(self, samples: int) -> np.ndarray:
        """Return what is heard next, (batch, samples) float32."""
        if self.caregiver is not None and self.present:
            self._talk(samples)
        heard = self.noise * self.random.standard_normal((self.batch, samples), dtype=np.float32)
        if self.loop is not None:
            round_again = np.resize(self.loop, (1, len(self.loop) + samples))
            heard += _parts(round_again, 0, (self.offset + self.now) % len(self.loop), samples)
        self._add(heard, self.echo[None], np.zeros(self.batch, dtype=int), self.called)
        for slot in range(SLOTS):
            self._add(heard, self.bank, self.says[:, slot], self.begins[:, slot])
        self.now += samples
        return np.clip(heard, -1, 1, out=heard)

    def _add(self, heard: np.ndarray, sounds: np.ndarray, which: np.ndarray, begins: np.ndarray) -> None:
        """Add what is to be heard now of sounds (K, samples), each of which (batch,) begins at a time (batch,)."""
        samples, since = heard.shape[1], self.now - begins
        rows = np.flatnonzero((since > -samples) & (since < sounds.shape[1]))
        if len(rows):
            padded = np.pad(sounds, ((0, 0), (samples, samples)))
            heard[rows] += _parts(padded, which[rows], since[rows] + samples, samples)

    def _talk(self, samples: int) -> None:
        """Who does not respond talks all the same, at times of her own."""
        caregiver = self.caregiver
        assert caregiver is not None
        which, due = self.random.random((2, self.batch))
        if not np.isfinite(caregiver.gap):
            return
        silent = self._busy().max(1) <= self.now
        begins = due < -np.expm1(-samples / (self.rate * caregiver.gap))
        # A place within what is read next.
        begin = self.now + samples * self.random.random(self.batch)
        self._say(silent & begins & ~self.responsive, begin, which)

    def _say(self, where: np.ndarray, begin: np.ndarray, which: np.ndarray) -> None:
        """Begin an utterance, or queue it behind the one under way; who has one queued already says no more."""
        assert self.caregiver is not None
        busy = self._busy()
        slot, rows = busy.argmin(1), np.arange(self.batch)
        free = where & (busy.min(1) <= self.now)
        after = busy.max(1) + round(self.caregiver.pause * self.rate)
        begin = np.maximum(begin.astype(int), after)
        said = (which * len(self.lengths)).astype(int)
        self.begins[rows[free], slot[free]] = begin[free]
        self.says[rows[free], slot[free]] = said[free]

    def _busy(self) -> np.ndarray:
        """When utterances end, (batch, slots)."""
        return self.begins + self.lengths[self.says]

    def _echo(self, sound: np.ndarray) -> np.ndarray:
        tail = np.exp(-6.9 * np.arange(round(self.decay * self.rate) + 1) / max(1, self.decay * self.rate))
        # Its level is that of the call itself, whatever the room adds behind it.
        full = np.convolve(sound, tail * np.random.default_rng(0).choice([-1.0, 1.0], len(tail)))
        gain = 10 ** ((self.echo_level - decibels(full[: len(sound)])) / 20)
        return (full * gain).astype(np.float32)


def _bank(utterances: Sequence[np.ndarray], level: float) -> tuple[np.ndarray, np.ndarray]:
    """Utterances of one level, side by side, padded, and the length of each."""
    lengths = np.array([len(sound) for sound in utterances] or [1])
    bank = np.zeros((len(lengths), lengths.max()), np.float32)
    for row, sound in zip(bank, utterances, strict=False):
        row[: len(sound)] = at_level(sound, level)
    return bank, lengths


def _parts(sounds: np.ndarray, which: np.ndarray | int, first: np.ndarray, samples: int) -> np.ndarray:
    """Return as many samples of sounds (K, samples) from places on, (n, samples)."""
    return np.lib.stride_tricks.sliding_window_view(sounds, samples, axis=1)[which, first]
