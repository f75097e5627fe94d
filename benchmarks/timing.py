"""Timing two things side by side."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def milliseconds(*functions: Callable[[], object], repeats: int = 20, inner: int = 1, rest: float = 0.0) -> list[float]:
    """Return each function's median time in ms, run in turn, so that a busy machine is busy for all of them.

    ``rest`` are seconds before each, in which threads that one of them has woken go to sleep.
    """
    times: list[list[float]] = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(repeats):
        for function, record in zip(functions, times, strict=True):
            time.sleep(rest)
            start = time.perf_counter()
            for _ in range(inner):
                function()
            record.append((time.perf_counter() - start) / inner * 1e3)
    return [statistics.median(record) for record in times]
