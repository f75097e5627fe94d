"""Visual search: O(N) work per update from an O(N²) declaration, and what an update and a choice cost."""

from __future__ import annotations

import torch
from pyro.distributions import Normal

from apmodels import DetectorSearch, Grid, VisualSearch, observation
from benchmarks.timing import milliseconds
from controllers import GreedyInfomax, MostProbable
from inference import Exact
from inference.tables import families

SIDES = (7, 11, 21, 31, 51)


class OneHot(VisualSearch):
    """The same law, written with N means for each of N targets."""

    @observation
    def glimpse(self, target, fixation):
        signal = self.acuity(self.grid.distance(target, fixation))
        return Normal(signal * self.grid.one_hot(target), 1.0).to_event(1)


def measure() -> dict[str, float]:
    figures: dict[str, float] = {}
    for side in SIDES:
        figures |= _sparse_against_dense(side)
    figures |= _update_and_choice()
    figures |= _gain()
    return figures


def _dense(model) -> Exact:
    """The same engine, made to score every element under every hypothesis."""
    share, families.SPARSE = families.SPARSE, -1.0
    try:
        engine = Exact(model)
        engine.update(engine.start(), 0, torch.zeros(model.grid.size))
    finally:
        families.SPARSE = share
    return engine


def _sparse_against_dense(side: int) -> dict[str, float]:
    model = OneHot(grid=Grid(side, side))
    sparse, dense = Exact(model), _dense(model)
    glimpse = model.simulate(1, actions=torch.zeros(1, dtype=torch.int64), seed=side)["glimpse"][0]
    slim, full = (engine.update(engine.start(), 0, glimpse).marginal("target").probs for engine in (sparse, dense))
    starts = sparse.start(), dense.start()
    quick, slow = milliseconds(
        lambda: sparse.update(starts[0], 0, glimpse), lambda: dense.update(starts[1], 0, glimpse), inner=5
    )
    return {
        f"update_ms.{side}x{side}": quick,
        f"dense_update_ms.{side}x{side}": slow,
        f"sparse_vs_dense.{side}x{side}": slow / quick,
        f"difference.{side}x{side}": float((slim - full).abs().max()),
    }


def _update_and_choice() -> dict[str, float]:
    model = DetectorSearch()
    engine = Exact(model).prepare()
    controller = MostProbable(engine)
    counts = torch.zeros(model.grid.size)
    counts[50] = 3
    start = engine.start()
    both, batch = milliseconds(
        lambda: controller.act(engine.update(start, 5, counts)),
        lambda: engine.update(engine.start(1000), 5, counts),
        inner=20,
        repeats=30,
    )
    return {"update_and_choice_ms.21x21": both, "updates_per_second.21x21": 1e6 / batch}


def _gain() -> dict[str, float]:
    engine = Exact(VisualSearch(grid=Grid(7, 7))).prepare()
    controller = GreedyInfomax(engine)
    start = engine.start()
    (once,) = milliseconds(lambda: controller.act(start))
    return {"greedy_infomax_ms.7x7": once}
