"""Episodes to learn from: what was believed, done and rewarded, and what each action was worth afterwards."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apmodels.simulation import Worlds, as_dict, as_given, seeded
from inference import Engine

# A baseline's normal equations, whose unknowns are scaled to one, are kept solvable by so much.
RIDGE = 1e-4
# For fewer probabilities a step threads hardly pay, and on a busy machine they wait for each other much longer.
MANY = 1 << 18


@dataclass(frozen=True)
class Experience:
    """B episodes of T steps: ``probs`` (T, B, N) of the interest before each action, ``actions`` (T, B) by number,
    and ``rewards`` (T, B) that followed.
    """

    probs: Tensor
    actions: Tensor
    rewards: Tensor


class Imagined:
    """Worlds drawn from the engine's own model: a body that needs nothing but the model."""

    def __init__(self, engine: Engine, batch: int):
        self.engine, self.batch = engine, batch

    def reset(self, seed: int | None = None) -> None:
        """Draw new worlds."""
        self.worlds = Worlds(self.engine.laws, self.batch)

    def step(self, action: Any) -> Any:
        """Act in all of them, and return what is observed."""
        return as_given(self.worlds.step(as_dict(action, self.engine.model.action_names, "action")))


def live(
    engine: Engine,
    body: Any,
    interest: str,
    draw: Callable[[Tensor], Tensor],
    reward: Callable[[Any, Any], Any],
    steps: int,
    seed: int,
) -> Experience:
    """Return what happens in a body to who draws actions' numbers from probabilities (B, N) of the interest.

    ``reward`` is asked of every belief and the action that led to it.
    """
    values = engine.model.space(engine.model.action_names[0]).values()
    seen, done, rewarded = [], [], []
    with seeded(seed), torch.no_grad():
        body.reset(seed)
        belief = engine.start(body.batch)
        for _ in range(steps):
            probs = belief.marginal(interest).probs
            number = draw(probs)
            action = values[number]
            belief = engine.update(belief, action, body.step(action))
            seen.append(probs)
            done.append(number)
            rewarded.append(torch.as_tensor(reward(belief, action)))
    return Experience(torch.stack(seen), torch.stack(done), torch.stack(rewarded))


def to_go(rewards: Tensor, beta: float) -> Tensor:
    """Return what follows each action, (T, B): G_t = r_t + β G_{t+1}.

    Σ_t ∇log p_t · G_t is GPOMDP's Σ_t r_t z_t with the trace z ← βz + ∇log p (thesis section 5.5.1), summed from the
    other end.
    """
    found = rewards.clone()
    for t in range(len(rewards) - 2, -1, -1):
        found[t] += beta * found[t + 1]
    return found


def mean(worth: Tensor, probs: Tensor) -> Tensor:
    """Return what actions are worth beyond their step's mean over all other episodes, (T, B)."""
    episodes = worth.shape[1]
    return (worth - worth.mean(1, keepdim=True)) * (episodes / max(episodes - 1, 1))


def belief(worth: Tensor, probs: Tensor) -> Tensor:
    """Return what actions are worth beyond what their beliefs foretold, (T, B).

    Least squares, step by step, on the belief's entropy, its square and its maximum; biased by the order of 1/B.
    """
    entropy, most = torch.special.entr(probs).sum(-1), probs.amax(-1)
    known = torch.stack([entropy, entropy * entropy, most], -1).double()
    known = known - known.mean(1, keepdim=True)
    known = known / known.std(1, keepdim=True).clamp(min=1e-6)
    centred = (worth - worth.mean(1, keepdim=True)).double()
    square = known.mT @ known / worth.shape[1] + RIDGE * torch.eye(known.shape[-1]).to(known)
    # What is not finite is for the learner to notice: no error here.
    slopes, _ = torch.linalg.solve_ex(square, known.mT @ centred[..., None] / worth.shape[1])
    return (centred - (known @ slopes)[..., 0]).to(worth)


BASELINES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "none": lambda worth, probs: worth,
    "mean": mean,
    "belief": belief,
}


def parts(steps: int, size: int) -> Iterator[slice]:
    """Yield slices of so many steps, each of ``size`` of them or fewer."""
    for first in range(0, steps, max(1, size)):
        yield slice(first, first + max(1, size))


@contextmanager
def threads_for(values: int) -> Iterator[None]:
    """Let torch take all its threads for steps of so many probabilities, or one."""
    before = torch.get_num_threads()
    if values < MANY:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
