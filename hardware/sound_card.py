"""The microphone and the loudspeaker of this machine, by PortAudio."""

from __future__ import annotations

import queue
from importlib import import_module
from typing import Any

import numpy as np

from hardware.sound import SoundError


class SoundCard:
    """A microphone and a loudspeaker.

    Args:
        microphone: its number or name, as ``python -m sounddevice`` lists them; None is the system's own choice.
        speaker: likewise.
        rate: samples a second.
        patience: seconds without any sound from the microphone, after which it is taken to be gone.

    Raises:
        SoundError: there is no such device, or what talks to devices is not installed.
    """

    batch = None

    def __init__(
        self,
        microphone: int | str | None = None,
        speaker: int | str | None = None,
        rate: int = 16_000,
        patience: float = 3.0,
    ):
        self.rate, self.patience, self.speaker = rate, patience, speaker
        self.audio = _library()
        self.waiting: queue.Queue[np.ndarray] = queue.Queue()
        self.rest = np.zeros(0, np.float32)
        self.stream: Any = None
        try:
            self.audio.query_devices(speaker, "output")
            self.stream = self.audio.InputStream(
                samplerate=rate, device=microphone, channels=1, dtype="float32", callback=self._came
            )
            self.stream.start()
        except (self.audio.PortAudioError, ValueError) as error:
            self.close()
            raise SoundError(
                f"There is no microphone with a loudspeaker that can be used here: {str(error).rstrip('.')}; "
                f"'python -m sounddevice' lists the devices."
            ) from None

    def reset(self, seed: int | None = None) -> None:
        """Forget what was heard and not read."""
        self.rest = np.zeros(0, np.float32)
        while not self.waiting.empty():
            self.waiting.get_nowait()

    def read(self, samples: int) -> np.ndarray:
        """Return the next (samples,) float32; wait for them."""
        while len(self.rest) < samples:
            try:
                self.rest = np.concatenate([self.rest, self.waiting.get(timeout=self.patience)])
            except queue.Empty:
                raise SoundError(
                    f"The microphone has been silent for {self.patience:g} s; is it still there?"
                ) from None
        sound, self.rest = self.rest[:samples], self.rest[samples:]
        return sound

    def play(self, sound: np.ndarray, where: np.ndarray) -> None:
        """Begin to play a sound, (samples,), if where is true; what was playing stops."""
        if np.all(where):
            try:
                self.audio.play(sound, self.rate, device=self.speaker)
            except self.audio.PortAudioError as error:
                raise SoundError(f"The loudspeaker does not play any more: {str(error).rstrip('.')}.") from None

    def close(self) -> None:
        """Let go of the devices."""
        if self.stream is not None:
            self.stream.close()
            self.stream = None
            self.audio.stop()

    def _came(self, sound: np.ndarray, frames: int, time: Any, status: Any) -> None:
        self.waiting.put(sound[:, 0].copy())


def _library() -> Any:
    try:
        return import_module("sounddevice")
    except ImportError:
        raise SoundError("Sound devices need the extra 'hardware': pip install 'apmodels[hardware]'.") from None
    except OSError as error:
        # The package is there, and the system's library, which it needs on Linux, is not.
        raise SoundError(f"Sound devices cannot be used here: {error}; on Debian, install libportaudio2.") from None
