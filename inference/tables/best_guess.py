"""How probably the best guess will be right: E[max_i B_i] after the next observation (Najemnik & Geisler 2005)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from inference.tables.imagining import Imagination, of_pairs

# Beyond so many deviations nothing is left of a Gaussian that matters here.
BELOW, ABOVE = 4.0, 3.0
# Below this d' nothing is seen; it keeps a quotient finite.
LEAST = 1e-5


def best(logs: Tensor) -> Tensor:
    """Return how probable the most probable of values with log probabilities (N, n) is, (N,)."""
    return logs.amax(-1).exp()


def best_guess(engine: Any, belief: Any, actions: Any, samples: int, seed: int) -> Tensor:
    """Return E[max_i B_i | action] under the exact engine, (*batch, K).

    Where every hypothesis shows in Normal elements of its own, it is an integral over one number, taken at ``samples``
    points; else an expectation over imagined observations.
    """

    def answer(imagined: Imagination) -> Tensor:
        own = _own(imagined)
        return imagined.expected(best, samples, seed) if own is None else largest(imagined.before(), own, samples)

    return of_pairs(engine, belief, actions, answer, samples)


def _own(imagined: Imagination) -> Tensor | None:
    """d' of every hypothesis, (R, H), where each is one value of the interest and shows in elements of its own."""
    tables = imagined.engine.tabulation.tables
    name, table = next(iter(tables.items()))
    if len(tables) > 1 or len(imagined.engine.names(None)) > 1 or imagined.other(name) is not None:
        return None
    own = table.own(imagined.rows)
    return None if own is None or own.shape != imagined.before().shape else own


def largest(log_probs: Tensor, distance: Tensor, points: int) -> Tensor:
    """Return E[max_i w_i] of independent w_i with E[w_i] = p_i and log w_i Normal of deviation d_i, (R,).

    Under the baseline the likelihood ratios of what is seen are independent, and E[max_i B_i] is the integral of
    1 - prod_i F_i(t) over t. The integral of sum_i (1 - F_i), which has a closed form, is taken apart; what remains is
    smooth but for hypotheses of small d', which step where it begins, so that the points are densest there. The error
    falls as one over their number squared.

    Args:
        log_probs: (R, H).
        distance: d_i, (R, H).
        points: how many.
    """
    spread = distance.clamp(min=LEAST)
    middle = log_probs - spread * spread / 2
    low = (middle - BELOW * spread).amax(1, keepdim=True)
    high = torch.maximum((middle + spread * (spread + ABOVE)).amax(1, keepdim=True), low + LEAST)
    at = low + (high - low) * torch.linspace(0, 1, max(points, 2), dtype=low.dtype) ** 3
    above = _tail((at[..., None] - middle[:, None]) / spread[:, None])
    rest = at.exp() * (above.sum(2) - 1 + (1 - above).prod(2))
    over = log_probs.exp() * _tail((low - middle) / spread - spread) - low.exp() * above[:, 0]
    return low.exp()[:, 0] + over.sum(1) - torch.trapezoid(rest, at, dim=1)


def _tail(z: Tensor) -> Tensor:
    """P(a standard Normal number is larger)."""
    return 0.5 * torch.erfc(z * math.sqrt(0.5))
