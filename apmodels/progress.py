"""How far long work is: a bar where somebody looks, and nothing where nobody does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

from rich import get_console
from rich.progress import Progress, track

T = TypeVar("T")


def progress(show: bool = True) -> Progress:
    """Return a bar that goes away when it is full; in a file or a pipe, or if not to be shown, there is none."""
    return Progress(transient=True, disable=not (show and _watched()))


def tracked(items: Iterable[T] | Sequence[T], doing: str) -> Iterator[T]:
    """Yield all items, with a bar."""
    yield from track(items, doing, transient=True, disable=not _watched())


def _watched() -> bool:
    console: Any = get_console()
    return console.is_terminal or console.is_jupyter
