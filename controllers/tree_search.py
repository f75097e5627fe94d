"""Looking several steps ahead, where it seems worth it: Monte-Carlo tree search over beliefs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import as_given
from controllers.controller import Controller
from controllers.dynamic_programming import shares
from controllers.one_step import ROUNDING
from controllers.rewards import Information
from controllers.search_tree import SearchTree
from controllers.threads import one_thread
from inference import Belief, Engine, Refusal
from inference.rows import alike, rows, taken


class TreeSearch(Controller):
    """Chooses the action after which most reward is expected over a horizon, if one goes on acting well.

    A tree of beliefs grows where it is worth most (upper confidence bounds); what may be seen after an action is drawn
    and widened as it is visited more often (Sunberg & Kochenderfer 2018), or listed where outcomes are few: then the
    values become those of exhaustive search. A new belief is worth what acting greedily from there on brings; what the
    reward is expected to grow by in one step is not sampled but asked for, so that with a horizon of 1 the controller
    is the greedy one. The trees of a batch grow side by
    side, and go on growing from what was reached, where the beliefs that come are among those that were imagined.

    Args:
        engine: one that imagines observations.
        horizon: how many steps to look ahead.
        simulations: how often the tree is grown.
        weights: how much the reward after each step counts: "summed", "final" or numbers; see DynamicProgramming.
        reward: a function of beliefs, (*batch,); ``Information`` by default.
        candidates: the actions to choose from, (K, *shape); all of them by default, where they are finite.
        branches: how many observations an action is imagined to bring at a time; a quarter of them below the root.
        widening: the exponent with which those become more as an action is visited more often.
        exploration: how much, nats, an action may be hoped to be better than it seems.
        samples: for the expected increments of the reward; a quarter of them below the root.
        seed: for what is imagined.
    """

    def __init__(
        self,
        engine: Engine,
        horizon: int = 3,
        simulations: int = 32,
        weights: str | Sequence[float] = "summed",
        reward: Callable[[Any], Any] | None = None,
        candidates: Any = None,
        branches: int = 16,
        widening: float = 0.5,
        exploration: float = 0.1,
        samples: int = 64,
        seed: int = 0,
    ):
        super().__init__(engine, seed)
        if horizon < 1 or simulations < 1 or branches < 1 or samples < 1:
            raise ValueOutOfRange(
                "TreeSearch needs a horizon, simulations, branches and samples of 1 or more, not "
                f"{horizon}, {simulations}, {branches} and {samples}"
            )
        if not 0 <= widening <= 1 or not exploration >= 0:
            raise ValueOutOfRange(
                f"TreeSearch widens with an exponent in [0, 1] and explores by 0 or more, not {widening}, {exploration}"
            )
        self.name, space = self.only_action()
        if candidates is None and space.size is None:
            raise Refusal(f"{self.name} is a continuum; give TreeSearch the candidates to choose from")
        self.candidates = space.values() if candidates is None else space.check(candidates, self.name)
        self.horizon, self.simulations, self.branches, self.widening = horizon, simulations, branches, widening
        self.exploration, self.samples = exploration, samples
        self.reward: Any = reward or Information()
        # An increment of the reward counts in all rewards from its step on; nothing counts beyond the horizon.
        counted = [0.0, *torch.tensor(shares(weights, horizon)).flip(0).cumsum(0).flip(0).tolist(), 0.0]
        self.counted = torch.tensor(counted, dtype=engine.dtype)
        self.asks = hasattr(self.reward, "gain")
        self.last = horizon - 2 if self.asks else horizon - 1
        # An engine that cannot imagine refuses here, and not in the middle of an episode.
        _, chances = engine.imagine(rows(engine.start()), self.candidates[:1], branches + 1)
        self.listed = chances.shape[1] <= branches

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode, with new trees."""
        super().reset(seed)
        self.tree: SearchTree | None = None
        self.done: Tensor | None = None

    def act(self, belief: Belief) -> Any:
        """Return the best candidate, for each belief; of those equal but for rounding, the first.

        Where the best is not better than the greedy one by more than the error of that, the greedy one.
        """
        worth, error, gain = self._searched(belief)
        greedy, best = _first(gain), _first(worth)
        pair = torch.stack([best, greedy], -1)
        (high, low), doubt = worth.gather(-1, pair).unbind(-1), error.gather(-1, pair).square().sum(-1).sqrt()
        self.done = torch.where(high - low > doubt, best, greedy) if not self.listed else best
        return self.candidates[self.done]

    def values(self, belief: Any) -> Tensor:
        """Return how much weighted reward each candidate is expected to add, (*batch, K)."""
        return self._searched(belief)[0]

    def _searched(self, belief: Any) -> tuple[Tensor, ...]:
        """What candidates are worth, the error of that, and what they are worth in one step, (*batch, K) each."""
        seed, root = int(torch.randint(2**30, (), generator=self.generator)), rows(belief)
        with one_thread():
            if self.last < 0:
                gain = self.counted[1] * self.reward.gain(self.engine, root, self.candidates, self.samples, seed)
                found = gain, torch.zeros_like(gain), gain
            else:
                tree = self.grown(root, seed)
                found = *tree.steadied(), tree.gain[:, 0]
                # Of observations that are drawn the one that comes is none; a list of them has it.
                self.tree, self.done = tree if self.listed else None, None
        return tuple(part[0] for part in found) if belief.batch is None else found

    def grown(self, root: Any, seed: int) -> SearchTree:
        """Return the trees of a batch of beliefs; the first simulation tries all candidates."""
        many = len(self.candidates)
        room = 1 + self.branches * (many + self.simulations)
        tree = self._reached(root, room)
        if tree is None:
            tree = SearchTree(root, room, many, self.counted, self.last)
            self._value(tree, tree.rows, torch.zeros_like(tree.rows)[:, None], root, self.samples, seed)
        at, actions = (tree.blocks[:, 0] == 0).nonzero(as_tuple=True)
        if len(at):
            self._widen(tree, at, torch.zeros_like(at), actions, seed)
        tree.visits[:, 0] += 1
        for _ in range(self.simulations - 1):
            found = tree.descend(self.exploration, self._allowed)
            if not len(found[0]):
                break
            self._widen(tree, *found, seed)
        return tree

    def _reached(self, root: Any, room: int) -> SearchTree | None:
        """Return the parts of the last step's trees that were reached since, where all beliefs are found there."""
        tree = self.tree
        if tree is None or self.done is None or root.batch != len(tree.rows) or root.time != tree.start + 1:
            return None
        children = tree.children(self.done.expand(root.batch) if root.batch == 1 else self.done)
        found = torch.full_like(tree.rows, -1)
        for nodes in children.T:
            same = alike(replace(tree.belief(tree.rows, nodes.clamp(min=0)), time=root.time), root) & (nodes >= 0)
            found = torch.where(same, nodes, found)
        if bool((found < 0).any()):
            return None
        below = tree.below(found, room)
        below.start = root.time
        return below

    def _allowed(self, visits: Tensor) -> Tensor:
        return ((1 + visits) / self.branches) ** self.widening

    def _widen(self, tree: SearchTree, at: Tensor, nodes: Tensor, actions: Tensor, seed: int) -> None:
        """Imagine observations after actions in nodes, (n,), and value what is believed then.

        What is imagined first, second, ... is so with the same random numbers everywhere.
        """
        blocks = tree.blocks[at, nodes, actions].long()
        # Before the first step beliefs may be of another kind than later.
        kind = 2 * blocks + (nodes > 0)
        for key in torch.unique(kind).tolist():
            some = kind == key
            where = at[some], nodes[some], actions[some]
            belief = replace(tree.belief(*where[:2]), time=tree.start + key % 2)
            acts = self.candidates[where[2]]
            drawn = seed + 7919 * (key // 2)
            seen, chances = self.engine.imagine(belief, acts, self._wide(nodes[some]), drawn)
            after = self._after(belief, acts, seen, chances)
            children = tree.add(*where, chances, after)
            self._value(tree, where[0], children, after, max(1, self.samples // 4), drawn)
            grown = self.reward(after).reshape(chances.shape) - self.reward(belief)[:, None]
            if self.asks:
                counted = self.counted[tree.depth[where[0], children[:, 0]] + 1]
                tree.luck[where[0][:, None], children] += counted[:, None] * (grown - tree.gain[where][:, None])
            else:
                tree.increase(*where, chances, grown)
            tree.learn(*where, children, self.listed)

    def _wide(self, nodes: Tensor) -> int:
        """How many observations to imagine at a time; fewer below the root, where they only tell what follows."""
        return self.branches if self.listed or not bool(nodes.any()) else max(1, self.branches // 4)

    def _after(self, belief: Any, acts: Tensor, seen: dict[str, Tensor], chances: Tensor) -> Any:
        """Return the beliefs after each of C observations, (n * C,)."""
        count, wide = chances.shape
        possible = torch.where(chances > 0, torch.arange(wide), chances.argmax(1, keepdim=True))
        pick = torch.arange(count)[:, None], possible
        seen = {name: value[pick].flatten(0, 1) for name, value in seen.items()}
        index = torch.arange(count).repeat_interleave(wide)
        return self.engine.update(taken(belief, index), acts[index], as_given(seen))

    def _value(self, tree: SearchTree, at: Tensor, nodes: Tensor, beliefs: Any, samples: int, seed: int) -> None:
        """Fill in what new nodes (n, C) are worth: the next step as the reward says, and more by acting greedily."""
        at, wide, nodes = at.repeat_interleave(nodes.shape[1]), nodes.shape[1], nodes.flatten()
        depth = tree.depth[at, nodes]
        tree.left[at[depth > self.last], nodes[depth > self.last]] = 0.0
        if self.asks:
            gain = self.reward.gain(self.engine, beliefs, self.candidates, samples, seed)
            tree.gain[at, nodes] = gain
            best = self._greedy(gain, tree.via[at, nodes])
        else:
            gain = torch.zeros(len(at), len(self.candidates), dtype=self.counted.dtype)
            best = torch.randint(len(self.candidates), (len(at),), generator=self.generator)
        future, luck = self._followed(beliefs, best, gain.amax(1), depth, wide, samples, seed)
        tree.guessed[at, nodes] = luck
        tree.ahead[at, nodes, best], tree.share[at, nodes, best] = future, 1.0
        tree.value[at, nodes] = tree.worth(at, nodes).amax(1)

    def _followed(
        self, beliefs: Any, first: Tensor, gain: Tensor, depth: Tensor, wide: int, samples: int, seed: int
    ) -> tuple[Tensor, Tensor]:
        """Return what is yet to come, (n,), by acting greedily once from beliefs to the horizon, and the luck in that.

        ``first`` are the candidates it begins with, and ``gain`` what those are expected to bring, which is not
        counted here. Where that is not known one acts at random.
        """
        future, luck = torch.zeros(2, len(first), dtype=self.counted.dtype)
        index, steps = (depth <= self.last).nonzero()[:, 0], 0
        belief, chosen, gain = taken(beliefs, index), first[index], gain[index]
        while len(index):
            steps += 1
            later = self._once(belief, self.candidates[chosen], index % wide, wide, seed + steps)
            at, grown = depth[index] + steps, self.reward(later) - self.reward(belief)
            if self.asks:
                luck[index] += self.counted[at + 1] * (grown - gain)
                gains = self.reward.gain(self.engine, later, self.candidates, samples, seed + steps)
                chosen, gain = self._greedy(gains, chosen), gains.amax(1)
                future[index] += self.counted[at + 1] * gain
            else:
                future[index] += self.counted[at] * grown
                chosen = torch.randint(len(self.candidates), chosen.shape, generator=self.generator)
            some = (at <= self.last).nonzero()[:, 0]
            index, chosen, gain, belief = index[some], chosen[some], gain[some], taken(later, some)
        return future, luck

    def _greedy(self, gain: Tensor, last: Tensor) -> Tensor:
        """Return the candidate with the largest gain (n, K), (n,); of those equal but for rounding the last one again.

        Where nothing is to be learned now, dithering would keep it so.
        """
        best, at = gain.max(1)
        same = gain.gather(1, last[:, None])[:, 0] >= best - ROUNDING * torch.finfo(gain.dtype).eps * best.clamp(
            min=1.0
        )
        return torch.where(same, last, at)

    def _once(self, belief: Any, acts: Tensor, which: Tensor, wide: int, seed: int) -> Any:
        """Return beliefs after one observation each, of which siblings imagine different ones."""
        seen, chances = self.engine.imagine(belief, acts, self.branches if self.listed else wide, seed)
        if self.listed:
            which = torch.multinomial(chances, 1, generator=self.generator)[:, 0]
        pick = torch.arange(len(which)), which
        return self.engine.update(belief, acts, as_given({name: value[pick] for name, value in seen.items()}))


def _first(worth: Tensor) -> Tensor:
    """The first of the largest but for rounding, (*batch,), of (*batch, K)."""
    best = worth.amax(-1, keepdim=True)
    equal = worth >= best - ROUNDING * torch.finfo(worth.dtype).eps * best.abs().clamp(min=1.0)
    return equal.to(torch.uint8).argmax(-1)
