"""Planning for "is anybody answering me?": compiling, solving, and looking actions up."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

import numpy as np
import torch

from apmodels import Contingency
from benchmarks.timing import milliseconds
from controllers import DynamicProgramming, belief_mdp
from controllers.dynamic_programming import SHARES
from controllers.plan import solve
from inference import Exact

HORIZONS = (20, 40, 70, 100)
LOOKUPS = 1_000_000
# Run in a process that has nothing compiled yet.
FIRST = "from benchmarks.planning import first; print(first())"


def measure() -> dict[str, float]:
    engine = Exact(Contingency(), torch.float64)
    mdp = belief_mdp(engine)
    figures = {"compile_seconds": _compiled()}
    for horizon in HORIZONS:

        def solved(horizon: int = horizon) -> object:
            return solve(mdp, horizon, SHARES["summed"](horizon), keep=lambda left: False)

        (figures[f"solve_ms.{horizon}"],) = milliseconds(solved, repeats=3)
        figures[f"states.{horizon}"] = float(mdp.lattice(horizon).size)
    plan = DynamicProgramming(engine, 60).plan
    random = np.random.default_rng(0)
    seen = random.integers(0, 8, size=(LOOKUPS, 2, 2))
    kinds = random.integers(0, len(mdp.after), LOOKUPS)
    there = plan.states.has(seen)
    seen, kinds = seen[there], kinds[there]
    (took,) = milliseconds(lambda: plan.choose(kinds, seen, 12), repeats=5)
    return figures | {"lookups_per_second": len(seen) / took * 1e3}


def first() -> float:
    """How long a first plan takes in this process, seconds; it is short, and all of it is compiling."""
    mdp = belief_mdp(Exact(Contingency(), torch.float64))
    begin = time.perf_counter()
    solve(mdp, 4, SHARES["summed"](4))
    return time.perf_counter() - begin


def _compiled() -> float:
    with tempfile.TemporaryDirectory() as empty:
        env = {**os.environ, "NUMBA_CACHE_DIR": empty}
        done = subprocess.run([sys.executable, "-c", FIRST], env=env, capture_output=True, text=True, check=True)
    return float(done.stdout)
