"""Trees of beliefs, one for each belief of a batch, as arrays: they grow side by side."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from inference.rows import stacked, taken


class SearchTree:
    """R trees of up to M nodes with K candidate actions each; node 0 is the root.

    A value is what is yet to come: the expected increments of the reward, each counted with the weights of all rewards
    from its step on, ``counted`` (horizon + 2,). The arrays by node and action are ``gain`` (the expected increment),
    ``ahead`` and ``share`` (the sum of p · value over children, and of p), ``visits`` and ``blocks`` (how often it was
    widened). ``luck`` is by how much a node turned out better than was expected, and ``guessed`` the same of what its
    value is guessed from. ``left`` counts children that are not known for good yet, where all outcomes are there.
    """

    def __init__(self, root: Any, room: int, candidates: int, counted: Tensor, last: int):
        size, self.dtype, self.same = root.batch, counted.dtype, (counted, last)
        self.beliefs, self.start, self.counted, self.last = root, root.time, counted, last
        self.used = torch.ones(size, dtype=torch.int64)
        self.rows = torch.arange(size)
        self.place = torch.zeros(size, room, dtype=torch.int64)
        self.place[:, 0] = self.rows
        self.parent = torch.full((size, room), -1, dtype=torch.int64)
        self.via = torch.zeros_like(self.parent)
        self.depth = torch.full_like(self.parent, -1)
        self.depth[:, 0] = 0
        self.chance, self.value = (torch.zeros(size, room, dtype=self.dtype) for _ in range(2))
        self.seen, self.luck, self.guessed = (torch.zeros(size, room, dtype=self.dtype) for _ in range(3))
        shape = (size, room, candidates)
        self.gain, self.ahead, self.share, self.visits = (torch.zeros(shape, dtype=self.dtype) for _ in range(4))
        self.blocks = torch.zeros(shape, dtype=torch.int16)
        self.left = torch.full(shape, 1e9, dtype=self.dtype)

    def worth(self, rows: Tensor, nodes: Tensor) -> Tensor:
        """Return what every action of nodes (n,) is worth, (n, K); -inf where nothing is known but its gain."""
        known = self.share[rows, nodes]
        found = self.counted[self.depth[rows, nodes] + 1][:, None] * self.gain[rows, nodes]
        found = found + self.ahead[rows, nodes] / known.clamp(min=1e-30)
        return torch.where(known > 0, found, -torch.inf)

    def steadied(self) -> tuple[Tensor, Tensor]:
        """Return what every action of the roots is worth, (R, K), without the part that follows luck, and its error.

        Luck has mean zero, so that its regression may be taken off (a control variate): where much was learned by luck
        less is left to learn.
        """
        mine = (self.parent == 0) & (self.chance > 0)
        chance = torch.where(mine, self.chance, 0.0)
        lucks = self.luck + self.guessed
        share = torch.zeros_like(self.ahead[:, 0]).scatter_add(1, self.via, chance).clamp(min=1e-30)
        means = [torch.zeros_like(share).scatter_add(1, self.via, chance * v) / share for v in (self.value, lucks)]
        value, luck = (v - mean.gather(1, self.via) for v, mean in zip((self.value, lucks), means, strict=True))
        slope = (chance * value * luck).sum(1) / (chance * luck * luck).sum(1).clamp(min=1e-12)
        rest = chance * (value - slope[:, None] * luck)
        error = torch.zeros_like(share).scatter_add(1, self.via, rest * rest).sqrt() / share
        return self.worth(self.rows, torch.zeros_like(self.rows)) - slope[:, None] * means[1], error

    def hopes(self, rows: Tensor, nodes: Tensor, exploration: float) -> Tensor:
        """Return an upper confidence bound of every action, (n, K); what was never tried is hoped to go on as well."""
        worth = self.worth(rows, nodes)
        counted = self.counted[self.depth[rows, nodes] + 1][:, None]
        gain = counted * self.gain[rows, nodes]
        ahead = (worth - gain).amax(1, keepdim=True).nan_to_num(0.0, neginf=0.0)
        worth = torch.where(torch.isneginf(worth), gain + ahead, worth)
        visits = self.visits[rows, nodes]
        bonus = exploration * counted * ((1 + visits.sum(1, keepdim=True)).log() / (1 + visits)).sqrt()
        return torch.where(self.left[rows, nodes] > 0, worth + bonus, -torch.inf)

    def descend(self, exploration: float, allowed: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Walk down all trees that are not known for good; return the rows, and nodes and actions to be widened."""
        rows = self.rows[(self.left[:, 0] > 0).any(1)]
        nodes = torch.zeros_like(rows)
        stops: list[tuple[Tensor, Tensor, Tensor]] = []
        for depth in range(self.last + 1):
            if not len(rows):
                break
            actions = self.hopes(rows, nodes, exploration).argmax(1)
            visits = self.visits[rows, nodes, actions]
            self.visits[rows, nodes, actions] += 1
            self.seen[rows, nodes] += 1
            whole = self.left[rows, nodes, actions] < 1e9
            stop = (self.blocks[rows, nodes, actions] < allowed(visits)) & ~whole
            stop |= depth == self.last
            stops.append((rows[stop], nodes[stop], actions[stop]))
            rows, nodes, actions = rows[~stop], nodes[~stop], actions[~stop]
            nodes = self._child(rows, nodes, actions)
        found = [torch.cat(parts) for parts in zip(*stops, strict=True)] if stops else [rows, nodes, rows]
        return found[0], found[1], found[2]

    def _child(self, rows: Tensor, nodes: Tensor, actions: Tensor) -> Tensor:
        """The child of each that was visited least for its probability, and is not known for good."""
        mine = (self.parent[rows] == nodes[:, None]) & (self.via[rows] == actions[:, None])
        mine &= (self.left[rows] > 0).any(2) & (self.chance[rows] > 0)
        wanted = self.chance[rows] / (1 + self.seen[rows])
        return torch.where(mine, wanted, -1.0).argmax(1)

    def add(self, rows: Tensor, nodes: Tensor, actions: Tensor, chances: Tensor, beliefs: Any) -> Tensor:
        """Add children (n, C) with probabilities, and their beliefs; return their numbers, (n, C)."""
        count, wide = chances.shape
        order = torch.argsort(rows, stable=True)
        ranks = torch.empty_like(rows)
        first = torch.searchsorted(rows[order], rows[order])
        ranks[order] = torch.arange(count) - first
        made = self.used[rows][:, None] + ranks[:, None] * wide + torch.arange(wide)
        self.used.index_add_(0, rows, torch.full_like(rows, wide))
        at = rows[:, None].expand(-1, wide), made
        self.place[at] = self.beliefs.batch + torch.arange(count * wide).reshape(count, wide)
        self.parent[at], self.via[at] = nodes[:, None].expand(-1, wide), actions[:, None].expand(-1, wide)
        self.depth[at] = self.depth[rows, nodes][:, None].expand(-1, wide) + 1
        self.chance[at] = chances
        self.blocks[rows, nodes, actions] += 1
        self.beliefs = stacked([self.beliefs, beliefs])
        return made

    def increase(self, rows: Tensor, nodes: Tensor, actions: Tensor, chances: Tensor, grown: Tensor) -> None:
        """Average the increments of the reward (n, C) that new children came with, where they are not known."""
        at = rows, nodes, actions
        known = torch.where(self.blocks[at] == 1, 0.0, self.share[at])
        total = known * self.gain[at] + (chances * grown).sum(1)
        self.gain[at] = total / (known + chances.sum(1))

    def learn(self, rows: Tensor, nodes: Tensor, actions: Tensor, children: Tensor, whole: bool) -> None:
        """Tell the ancestors of new children (n, C) what those are worth; ``whole``: no more of them will come."""
        # What was a guess gives way to what was imagined.
        self.guessed[rows, nodes] = 0.0
        first = self.blocks[rows, nodes, actions] == 1
        for array in (self.ahead, self.share):
            array[rows[first], nodes[first], actions[first]] = 0.0
        chances = self.chance[rows[:, None], children]
        self.ahead[rows, nodes, actions] += (chances * self.value[rows[:, None], children]).sum(1)
        self.share[rows, nodes, actions] += chances.sum(1)
        if whole:
            open_ = (self.left[rows[:, None], children] > 0).any(2) & (chances > 0)
            self.left[rows, nodes, actions] = open_.sum(1).to(self.dtype)
        self._up(torch.unique(torch.stack([rows, nodes]), dim=1))

    def _up(self, pairs: Tensor) -> None:
        """Bring values of (rows, nodes), and of all above them, up to date; children come after their parents."""
        while pairs.shape[1]:
            rows, nodes = pairs
            old, new = self.value[rows, nodes], self.worth(rows, nodes).amax(1)
            self.value[rows, nodes] = new
            inner = nodes > 0
            rows, nodes, change = rows[inner], nodes[inner], (new - old)[inner]
            above, via = self.parent[rows, nodes], self.via[rows, nodes]
            at = (rows, above, via)
            self.ahead.index_put_(at, self.chance[rows, nodes] * change, accumulate=True)
            done = ~(self.left[rows, nodes] > 0).any(1) & (self.left[at] < 1e9)
            self.left.index_put_(
                tuple(part[done] for part in at), torch.tensor(-1.0, dtype=self.dtype), accumulate=True
            )
            pairs = torch.unique(torch.stack([rows, above]), dim=1)

    def belief(self, rows: Tensor, nodes: Tensor) -> Any:
        """Return the beliefs of nodes, (n,)."""
        return taken(self.beliefs, self.place[rows, nodes])

    def below(self, nodes: Tensor, room: int) -> SearchTree:
        """Return the trees whose roots are nodes (R,), with room for so many more; their outcomes are all there."""
        kept = torch.zeros_like(self.parent, dtype=torch.bool)
        kept[self.rows, nodes] = True
        for _ in range(self.last + 1):
            kept |= kept.gather(1, self.parent.clamp(min=0)) & (self.parent >= 0)
        # Those that are kept come first, in their order, so that children still come after their parents.
        order, number = (~kept).to(torch.uint8).argsort(dim=1, stable=True), kept.cumsum(1) - 1
        most = int(kept.sum(1).max())
        tree = SearchTree(
            taken(self.beliefs, self.place[self.rows, nodes]), most + room, self.gain.shape[2], *self.same
        )
        tree.used, held = kept.sum(1), torch.arange(most) < kept.sum(1)[:, None]
        at = held.nonzero(as_tuple=True)
        old = at[0], order[:, :most][held]
        for name in ("via", "chance", "value", "seen", "gain", "ahead", "share", "visits", "blocks", "guessed"):
            getattr(tree, name)[at] = getattr(self, name)[old]
        tree.depth[at] = self.depth[old] - 1
        tree.parent[at] = number[at[0], self.parent[old].clamp(min=0)]
        tree.parent[:, 0], tree.chance[:, 0] = -1, 0.0
        tree.beliefs = taken(self.beliefs, self.place[old])
        tree.place[at] = torch.arange(len(at[0]))
        # Where the horizon was, one more step may be hoped to bring what the next one does.
        leaf = (tree.depth == self.last) & ~(tree.blocks > 0).any(2)
        hope = self.counted[self.last + 2] * tree.gain[leaf].amax(1, keepdim=True)
        tree.ahead[leaf] = hope * (tree.share[leaf] > 0)
        tree._again()
        return tree

    def _again(self) -> None:
        """Work out all values again, from the leaves to the roots: depths have changed, and with them what counts."""
        widened = self.blocks > 0
        self.ahead[widened], self.left[widened] = 0.0, 0.0
        for depth in range(self.last + 1, -1, -1):
            rows, nodes = (self.depth == depth).nonzero(as_tuple=True)
            self.value[rows, nodes] = self.worth(rows, nodes).amax(1)
            if depth:
                at, chance = (rows, self.parent[rows, nodes], self.via[rows, nodes]), self.chance[rows, nodes]
                self.ahead.index_put_(at, chance * self.value[rows, nodes], accumulate=True)
                unknown = (self.left[rows, nodes] > 0).any(1) & (chance > 0)
                self.left.index_put_(at, unknown.to(self.dtype), accumulate=True)

    def children(self, actions: Tensor) -> Tensor:
        """Return the roots' children by actions (R,), (R, n) in their order; -1 where there are fewer."""
        mine = (self.parent == 0) & (self.via == actions[:, None]) & (self.chance > 0)
        most = int(mine.sum(1).max())
        order = (~mine).to(torch.uint8).argsort(dim=1, stable=True)[:, :most]
        return torch.where(mine.gather(1, order), order, -1)
