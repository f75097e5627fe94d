"""When is it loud?  The two means of all levels so far, and the middle between them (thesis section 4.6)."""

from __future__ import annotations

import numpy as np

from hardware.sound import SoundError


def two_means(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper of the two means that values, (*batch, n), are nearest to, (*batch,) each.

    It is the best split of all, not a local one. Where all values are alike so are the means.
    """
    ordered = np.sort(values, -1)
    n = ordered.shape[-1]
    below = np.cumsum(ordered, -1)
    total = below[..., -1:]
    count = np.arange(1, n)
    low, high = below[..., :-1] / count, (total - below[..., :-1]) / (n - count)
    between = count * (n - count) * (high - low) ** 2
    if n < 2:
        return total[..., 0], total[..., 0]
    best = between.argmax(-1)[..., None]
    return np.take_along_axis(low, best, -1)[..., 0], np.take_along_axis(high, best, -1)[..., 0]


class TwoMeans:
    """Tells sounds from silence by a threshold that follows what is heard.

    Args:
        exponent: means are taken of the power to this exponent: 1 is power, 0.5 amplitude, 0.3 loudness as people hear
            it (Stevens), 0 decibels.
        apart: while the means are not so many dB apart, nothing is a sound: a hum alone has no two levels.
        hold: after so many levels a threshold stays as it is, once there is one; None follows for ever.
    """

    def __init__(self, exponent: float = 0.3, apart: float = 3.0, hold: int | None = None):
        if not 0 <= exponent <= 1 or apart < 0:
            raise SoundError(
                f"An ear needs an exponent in [0, 1] and levels 0 dB apart or more, not {exponent} and {apart}."
            )
        self.exponent, self.apart, self.hold = exponent, apart, hold
        self.reset()

    def reset(self) -> None:
        """Forget what was heard."""
        self.levels: list[np.ndarray] = []
        self.threshold = np.asarray(np.inf)

    def hear(self, level: np.ndarray) -> np.ndarray:
        """Return whether levels (*batch,), in dB, are sounds, among all that was heard, these included."""
        full = self.hold is not None and len(self.levels) >= self.hold
        held = np.isfinite(self.threshold) & full
        if not held.all():
            self.levels.append(np.asarray(level, dtype=float))
            self.threshold = np.where(held, self.threshold, self.middle(np.stack(self.levels, -1)))
        return level > self.threshold

    def middle(self, levels: np.ndarray) -> np.ndarray:
        """Return the threshold (*batch,) of levels (*batch, n), in dB; infinite where they are all of a kind."""
        if not self.exponent:
            low, high = two_means(levels)
            return np.where(high - low >= self.apart, (low + high) / 2, np.inf)
        width = 10 / self.exponent
        low, high = two_means(10 ** (levels / width))
        quiet, loud, middle = (width * np.log10(mean) for mean in (low, high, (low + high) / 2))
        return np.where(loud - quiet >= self.apart, middle, np.inf)
