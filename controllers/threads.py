"""How many threads compiled loops take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

# For fewer values threads hardly pay, and on a busy machine they wait for each other much longer than they work.
MANY = 1_000_000


@contextmanager
def threads_for(values: int) -> Iterator[None]:
    """Let compiled loops over so many values use all threads, or one; torch keeps the threads that it had.

    Both share one pool of threads in some installations, so that what is set for one is set for the other.
    """
    import numba

    ours, torchs = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(ours if values >= MANY else 1)
    try:
        yield
    finally:
        numba.set_num_threads(ours)
        torch.set_num_threads(torchs)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch work in one thread: in many small steps threads wait for each other longer than they work."""
    torchs = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torchs)
