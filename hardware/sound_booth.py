"""A head that calls and listens: a loudspeaker, a microphone, and one bit a step (thesis section 4.6)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from hardware.sound import Microphone, SoundError, Speaker, chirp, decibels
from hardware.two_means import TwoMeans


class SoundBooth:
    """Calls, or not, and returns whether there was a sound, once a period.

    The level of a period is its mean power; what is louder than the threshold of ``ear`` is a sound.

    Args:
        microphone: what is heard with.
        speaker: what calls; None calls without a sound.
        call: the sound of a call, (samples,) at the speaker's rate; a short chirp by default.
        period: seconds a step takes.
        ear: see ``TwoMeans``.
        check: before a session it listens to the room for so many periods, and calls in the last quarter of them, so
            that the threshold knows both. Nobody should answer then.

    Attributes:
        log: levels and thresholds of the session, dB of full scale, one for every step.
    """

    def __init__(
        self,
        microphone: Microphone,
        speaker: Speaker | None = None,
        call: np.ndarray | None = None,
        period: float = 0.8,
        ear: TwoMeans | None = None,
        check: int = 12,
    ):
        if period * microphone.rate < 1 or check < 0:
            raise SoundError(
                f"A booth needs a period that holds a sample and 0 periods of check or more, not {period} s, {check}."
            )
        self.microphone, self.speaker, self.period, self.check = microphone, speaker, period, check
        self.call = chirp(microphone.rate if speaker is None else speaker.rate) if call is None else call
        self.ear = ear or TwoMeans()
        self.batch: int | None = getattr(microphone, "batch", None)

    def reset(self, seed: int | None = None) -> None:
        """Begin a session: forget the last one, and check the sound."""
        if hasattr(self.microphone, "reset"):
            self.microphone.reset(seed)  # type: ignore[attr-defined]
        self.ear.reset()
        self.time, self.heard = 0, 0
        self.log: dict[str, list[Any]] = {"level": [], "threshold": []}
        quiet = self.check - (self.check // 4 if self.speaker is not None else 0)
        for i in range(self.check):
            self._listen(np.full(self._shape(), i >= quiet))
        if hasattr(self.microphone, "enter"):
            # In a virtual room nobody is there before the check is over.
            self.microphone.enter()  # type: ignore[attr-defined]

    def step(self, action: Any) -> Tensor:
        """Call where the action is 1, (*batch,), listen for a period, and return 1 for a sound, (*batch,)."""
        level, loud = self._listen(np.broadcast_to(np.asarray(action) == 1, self._shape()))
        self.log["level"].append(level)
        self.log["threshold"].append(self.ear.threshold)
        return torch.as_tensor(loud, dtype=torch.get_default_dtype())

    def close(self) -> None:
        """Let go of the devices."""
        for device in (self.microphone, self.speaker):
            if hasattr(device, "close"):
                device.close()  # type: ignore[union-attr]

    def _shape(self) -> tuple[int, ...]:
        return () if self.batch is None else (self.batch,)

    def _listen(self, call: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.speaker is not None and call.any():
            self.speaker.play(self.call, call)
        # Periods need not be whole numbers of samples: what is lost in one is made up for in another.
        self.time += 1
        upto = round(self.time * self.period * self.microphone.rate)
        level = decibels(self.microphone.read(upto - self.heard))
        self.heard = upto
        return level, self.ear.hear(level)
