"""What can be wrong: with a declaration, and with a value."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class DeclarationError(TypeError):
    """A model class that cannot mean anything; raised when the class is made."""


class ValueOutOfRange(ValueError):
    """A parameter, action or observation outside what the model allows; raised when it is built or stepped."""


def nearest(name: str, names: Iterable[str]) -> str:
    """Return ' (nearest: a, b)' for the names closest to ``name``, or all of them when none is close."""
    names = list(names)
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        return f" (nearest: {', '.join(close)})"
    return f" (there are: {', '.join(names)})" if names else ""
