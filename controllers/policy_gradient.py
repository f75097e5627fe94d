"""Learning where to look from one's own beliefs, by the gradient of what a policy earns (thesis section 5.5.1)."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor, nn

from apmodels import ValueOutOfRange
from apmodels.errors import nearest
from apmodels.progress import progress
from controllers.controller import Controller
from controllers.dynamic_programming import shares
from controllers.policy import Policy, sizes
from controllers.policy_experience import BASELINES, Experience, Imagined, live, parts, threads_for, to_go
from controllers.policy_files import keep, policy_from, read
from controllers.policy_watch import LearningWarning, Watch
from controllers.rewards import Information, asked, interest_of
from inference import Belief, Engine, Refusal

# How many probabilities are kept of episodes at a time, and how many go through the policy at once.
KEPT, AT_ONCE = 1 << 27, 1 << 21


@dataclass(frozen=True)
class Falling:
    """A rate that falls evenly from ``first``, over so many updates, to the share ``least`` of it, and stays there."""

    first: float
    updates: int
    least: float = 0.03

    def __call__(self, update: int) -> float:
        """Return the rate after so many updates."""
        return self.first * max(self.least, 1 - update / self.updates)


class PolicyGradient(Controller):
    """Draws actions from a policy, which learns what to do from batches of episodes (GPOMDP; Adam).

    It needs to know of the model no more than that the interest has finitely many values, and the action too.

    Args:
        engine: makes beliefs, and imagines episodes where there is no body.
        policy: logits of actions from the probabilities of the interest's values.
        reward: a function of the belief, (*batch,), or of the belief and the action that led to it; Information.
        steps: of an episode; as many as there are actions by default (the thesis's T = N).
        batch: episodes an update, all of them in the body's where there is one.
        rate: Adam's step, in weights; or a function of how many updates there have been, such as Falling.
        damping: Adam's ε, in rewards a weight: where gradients are smaller, steps are too. Weights that hardly matter
            then stay where they are, and do not wander about by a step an update.
        beta: how much of the trace is kept: less than 1 is less noise and some bias.
        baseline: "none", "mean" (of the step, over the batch) or "belief" (what the belief before foretold).
        weights: how much each step's reward counts: "summed", "terminal", or a number for every step.
        greedy: take the most probable action instead of drawing; learning draws all the same.
        seed: of the draws, in acting and in learning.
        body: where experience comes from; worlds drawn from the engine's own model by default.
        device: where the policy computes ("cpu", "cuda"); where it is by default.
    """

    def __init__(
        self,
        engine: Engine,
        policy: nn.Module,
        reward: Callable[..., Any] | None = None,
        steps: int | None = None,
        batch: int = 256,
        rate: float | Callable[[int], float] = 20.0,
        damping: float = 0.1,
        beta: float = 1.0,
        baseline: str = "belief",
        weights: str | Sequence[float] = "summed",
        greedy: bool = False,
        seed: int = 0,
        body: Any = None,
        device: str | torch.device | None = None,
    ):
        super().__init__(engine, seed)
        if isinstance(policy, Policy):
            policy.serves(engine)
        _, space = sizes(engine)
        self.interest, self.values = interest_of(engine), space.values()
        self.policy = policy if device is None else _on(policy, device)
        self.reward = reward or Information()
        self._asked = asked(self.reward)
        self.steps = len(self.values) if steps is None else steps
        self.body, self.batch = body, batch if body is None else getattr(body, "batch", None) or 1
        self.rate, self.damping, self.beta, self.baseline = rate, damping, beta, baseline
        self.greedy, self.seed = greedy, seed
        self._check()
        self.weights = shares(weights, self.steps)
        self.updates = 0
        self.optimiser, self.watch = self._adam(), Watch(self.policy)

    def _check(self) -> None:
        if self.baseline not in BASELINES:
            raise ValueOutOfRange(f"there is no baseline {self.baseline!r}{nearest(self.baseline, BASELINES)}")
        if self.steps < 1 or self.batch < (1 if self.baseline == "none" else 2):
            raise ValueOutOfRange(
                f"learning needs 1 step or more, and 2 episodes or more to compare, not {self.steps} and {self.batch}"
            )
        if not 0 <= self.beta <= 1 or not 0 < self.damping < math.inf:
            raise ValueOutOfRange(
                f"the trace keeps a share in [0, 1], and damping is above 0, not {self.beta} and {self.damping}"
            )
        self._rate()

    def _rate(self, update: int = 0) -> float:
        rate = float(self.rate(update) if callable(self.rate) else self.rate)
        if not 0 < rate < math.inf:
            raise ValueOutOfRange(f"the rate of update {update} is {rate}; it must be a number above 0")
        return rate

    def _adam(self) -> torch.optim.Adam:
        return torch.optim.Adam(self.policy.parameters(), lr=1.0, eps=self.damping)

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode; the same seed draws the same actions."""
        if seed is not None:
            self.generator = _apart(seed)

    def act(self, belief: Belief) -> Any:
        """Return a draw from the policy, or its most probable action, for each belief."""
        probs = belief.marginal(self.interest).probs
        with torch.no_grad():
            return self.values[self.chosen(probs, self.generator, self.greedy)]

    def chosen(self, probs: Tensor, generator: torch.Generator, greedy: bool = False) -> Tensor:
        """Return numbers of actions, (*batch,), for probabilities (*batch, N) of the interest."""
        logits = self.logits(probs)
        if greedy:
            return logits.argmax(-1).to(probs.device)
        below = logits.softmax(-1).cumsum(-1)
        # Drawn on the CPU whatever the device, so that a seed means the same everywhere.
        draws = torch.rand(below.shape[:-1], generator=generator, dtype=below.dtype).to(below.device)
        number = torch.searchsorted(below, draws[..., None] * below[..., -1:], right=True)[..., 0]
        return number.clamp(max=below.shape[-1] - 1).to(probs.device)

    def logits(self, probs: Tensor) -> Tensor:
        """Return the policy's logits, (*batch, M), on its own device."""
        weights = next(self.policy.parameters())
        return self.policy(probs.to(weights.device, weights.dtype))

    def learn(self, updates: int) -> xr.Dataset:
        """Learn from so many more batches of episodes, or fewer where it goes wrong (LearningWarning).

        Returns:
            By ``update``: ``worth``, the mean of an episode's weighted rewards, and its standard ``error``;
            ``entropy`` of the policy, nats an action; the ``gradient``'s length; ``rate``; ``seconds``.
        """
        rows: list[dict[str, float]] = []
        trouble = None
        size = self.engine.start().marginal(self.interest).probs.numel()
        with threads_for(self.batch * size), progress() as bar:
            task = bar.add_task("learning", total=updates)
            for _ in range(updates):
                row, trouble = self._update()
                rows += [row] if row else []
                if trouble:
                    break
                bar.update(task, advance=1, description=f"learning: {row['worth']:.4g}")
        if trouble:
            self.watch.restore()
            self.optimiser = self._adam()
            message = f"learning stopped at update {self.updates}, and the last good parameters were kept: {trouble}"
            warnings.warn(message, LearningWarning, stacklevel=2)
        columns = {name: ("update", np.array([row[name] for row in rows])) for name in (rows[0] if rows else {})}
        return xr.Dataset(columns, coords={"update": self.updates - len(rows) + 1 + np.arange(len(rows))})

    def _update(self) -> tuple[dict[str, float], str | None]:
        begin = time.perf_counter()
        try:
            rate = self._rate(self.updates)
        except ValueOutOfRange as error:
            return {}, str(error)
        self.optimiser.zero_grad()
        worth, entropy = self.gradient(self.updates)
        self.updates += 1
        error = float(worth.std()) / math.sqrt(len(worth)) if len(worth) > 1 else 0.0
        gradients = [p.grad.norm() for p in self.policy.parameters() if p.grad is not None]
        row = {"worth": float(worth.mean()), "error": error, "entropy": entropy}
        row |= {"gradient": float(torch.stack(gradients).norm()), "rate": rate}
        trouble = self.watch.trouble(row["worth"], error, entropy)
        if trouble is None:
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            self.optimiser.step()
        return row | {"seconds": time.perf_counter() - begin}, trouble

    def gradient(self, update: int) -> tuple[Tensor, float]:
        """Add minus the gradient of what an episode is worth to the parameters' ``grad``, from a batch of episodes.

        Return what each was worth, (batch,), and the mean entropy of the policy, nats.
        """
        largest = max(2, KEPT // (self.steps * self.engine.start().marginal(self.interest).probs.numel()))
        pieces = 1 if self.body is not None else -(-self.batch // largest)
        worth, entropy = [], 0.0
        for piece in range(pieces):
            episodes = self.batch // pieces + (piece < self.batch % pieces)
            experience = self.experience(episodes, (self.seed * 1_000_003 + update) * 1009 + piece)
            weighted = experience.rewards * torch.as_tensor(self.weights).to(experience.rewards)[:, None]
            found = BASELINES[self.baseline](to_go(weighted, self.beta), experience.probs)
            entropy += self._descend(experience, found / self.batch) / self.batch
            worth.append(weighted.sum(0))
        return torch.cat(worth), entropy

    def experience(self, episodes: int, seed: int) -> Experience:
        """Return episodes in which the policy acted."""
        seed %= 2**63
        body = Imagined(self.engine, episodes) if self.body is None else self.body
        draws = _apart(seed)
        return live(
            self.engine, body, self.interest, lambda probs: self.chosen(probs, draws), self._asked, self.steps, seed
        )

    def _descend(self, experience: Experience, found: Tensor) -> float:
        """Add -Σ found · ∇log p(action) to the gradient, and return the sum over episodes of mean entropies."""
        entropy = 0.0
        for part in parts(self.steps, AT_ONCE // experience.probs[0].numel()):
            log_p = self.logits(experience.probs[part]).log_softmax(-1)
            taken = log_p.gather(-1, experience.actions[part].to(log_p.device)[..., None])[..., 0]
            (-taken * found[part].to(log_p)).sum().backward()
            kept = log_p.detach()
            entropy -= float((kept.exp() * kept).sum()) / self.steps
        return entropy

    def save(self, path: str | Path) -> None:
        """Keep the policy and how far it has learned: arrays and a JSON header (numpy's npz)."""
        policy = self.policy
        if not isinstance(policy, Policy):
            raise Refusal(f"a {type(policy).__name__} cannot be kept: it has no header of its own")
        about = {"policy": policy.header(), "model": repr(self.model), "updates": self.updates, "greedy": self.greedy}
        about |= {"steps": self.steps, "batch": self.batch, "beta": self.beta, "baseline": self.baseline}
        about |= {"rate": self._rate(self.updates), "damping": self.damping, "weights": self.weights, "seed": self.seed}
        arrays = {"weights": policy.weights.detach().cpu().numpy()}
        state = self.optimiser.state.get(policy.weights, {})
        arrays |= {f"adam_{name}": value.cpu().numpy() for name, value in state.items()}
        keep(path, about, arrays)

    @classmethod
    def load(cls, engine: Engine, path: str | Path, reward: Any = None, body: Any = None) -> PolicyGradient:
        """Return the controller that was saved, for an engine of the same model; it learns on at the rate it had."""
        header, arrays = read(path)
        policy = policy_from(path, header, arrays)
        if header["model"] != repr(engine.model):
            raise ValueOutOfRange(f"{path} has learned {header['model']}, and not {engine.model!r}")
        names = "steps", "batch", "rate", "damping", "beta", "baseline", "weights", "greedy", "seed"
        made = cls(engine, policy, reward, body=body, **{name: header[name] for name in names})
        made.updates = header["updates"]
        state = {name[5:]: torch.as_tensor(value) for name, value in arrays.items() if name.startswith("adam_")}
        if state:
            made.optimiser.state[policy.weights] = state
        return made

    def __repr__(self) -> str:
        return f"PolicyGradient({type(self.policy).__name__}, {self.reward!r}, {self.updates} updates)"


def _on(policy: nn.Module, device: str | torch.device) -> nn.Module:
    try:
        return policy.to(device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueOutOfRange(f"the policy cannot compute on {device!r}: {str(error).splitlines()[0]}") from error


def _apart(seed: int) -> torch.Generator:
    """Return a generator that repeats with the seed, but draws other numbers than a world of the same seed does."""
    drawn = torch.randint(2**62, (), generator=torch.Generator().manual_seed(seed))
    return torch.Generator().manual_seed(int(drawn))
