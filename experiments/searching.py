"""Searching for a target, many trials side by side: how soon it is found, and learning to look (thesis section 5.5)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
import xarray as xr

from controllers import ConvolutionalPolicy, Falling, PolicyGradient
from hardware import Simulated
from inference import Exact

# Resampled trials, for errors.
RESAMPLED = 400
# As many trials are searched at a time.
AT_ONCE = 4900


def engine_of(model: Any) -> Exact:
    """Return the engine of a search, with all that it needs tabulated: what is timed afterwards is not."""
    return Exact(model).prepare()


def search(model: Any, engine: Any, controller: Any, trials: int, steps: int, seed: int) -> xr.Dataset:
    """Search for a target that was in each cell as often, with one controller.

    Args:
        model: what the world is like; its variable ``target`` is a cell of its ``grid``.
        engine: of the same model, or of what the controller believes.
        controller: says where to look.
        trials: in each cell.
        steps: fixations in each of them.
        seed: of all draws.

    Returns:
        ``correct`` (trial, fixation): the most probable cell is the target's, a tie counting as much as it is likely to
        be settled so; ``sure``, P(target); ``seconds``, of choosing, by fixation, all trials together.
    """
    cells = torch.arange(model.grid.size).repeat(trials)
    correct, sure = np.empty((len(cells), steps), np.float32), np.empty((len(cells), steps), np.float32)
    seconds = np.zeros(steps)
    for begin in range(0, len(cells), AT_ONCE):
        part = cells[begin : begin + AT_ONCE]
        body = _body(model, part)
        body.reset(seed + begin)
        controller.reset(seed + begin)
        belief = engine.start(len(part))
        for step in range(steps):
            before = time.perf_counter()
            look = controller.act(belief)
            seconds[step] += time.perf_counter() - before
            belief = engine.update(belief, look, body.step(look))
            probs = belief.marginal("target").probs
            here = probs.gather(1, body.truth["target"][:, None].long())
            most = probs.amax(1, keepdim=True)
            correct[begin : begin + len(part), step] = ((here == most) / (probs == most).sum(1, keepdim=True))[:, 0]
            sure[begin : begin + len(part), step] = here[:, 0]
    return xr.Dataset(
        {
            "correct": (("trial", "fixation"), correct),
            "sure": (("trial", "fixation"), sure),
            "seconds": ("fixation", seconds),
        },
        coords={"fixation": np.arange(1, steps + 1)},
    )


def _body(model: Any, targets: torch.Tensor) -> Simulated:
    """Worlds whose targets are, or begin, in these cells."""
    role = model.declaration.variables["target"].role
    return Simulated(model, len(targets), {"target" if role == "static" else "start": targets})


def fixations_to(correct: np.ndarray, share: float) -> float:
    """How many fixations it takes until a share of trials (trials, fixations) is right, between two of them by a line.

    NaN where it is never reached.
    """
    curve = np.concatenate([[0.0], np.asarray(correct).mean(0)])
    reached = np.flatnonzero(curve >= share)
    if not len(reached) or not reached[0]:
        return np.nan if not len(reached) else 0.0
    at = reached[0]
    return float(at - 1 + (share - curve[at - 1]) / (curve[at] - curve[at - 1]))


def error_of(correct: np.ndarray, share: float, other: np.ndarray | None = None, seed: int = 0) -> float:
    """Standard error of ``fixations_to``, or of its difference from that of other trials with the same targets.

    By trials drawn anew; NaN where most of those never reach the share.
    """
    random = np.random.default_rng(seed)
    drawn = random.multinomial(len(correct), np.full(len(correct), 1 / len(correct)), RESAMPLED) / len(correct)
    found = np.array([fixations_to(curve[None], share) for curve in drawn @ correct])
    if other is not None:
        found = found - [fixations_to(curve[None], share) for curve in drawn @ other]
    there = found[np.isfinite(found)]
    return float(there.std()) if len(there) > RESAMPLED / 2 else np.nan


def learned(
    engine: Any, settings: Any, seed: int, reward: Any = None, policy: Any = None
) -> tuple[PolicyGradient, xr.Dataset, float]:
    """Learn where to look, with a convolutional policy by default; return it, its course, and the seconds it took."""
    if policy is None:
        grid, features = engine.model.grid, tuple(settings.features)
        policy = ConvolutionalPolicy(grid, features=features, spacing=settings.spacing)
    learner = PolicyGradient(
        engine,
        policy,
        reward,
        steps=settings.steps,
        batch=settings.batch,
        rate=Falling(settings.rate, settings.updates),
        damping=settings.damping,
        beta=settings.beta,
        baseline=settings.baseline,
        seed=seed,
        greedy=settings.greedy,
        device=settings.device,
    )
    begin = time.perf_counter()
    course = learner.learn(settings.updates)
    return learner, course, time.perf_counter() - begin


def kernel(learner: PolicyGradient) -> tuple[np.ndarray, np.ndarray]:
    """Return distances, in cells, and the weights of a convolutional policy's first feature at them, (R,)."""
    policy: Any = learner.policy
    return policy.distances.cpu().numpy(), policy.kernels.detach()[0].cpu().numpy()
