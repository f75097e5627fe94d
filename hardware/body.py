"""What a body is: something that turns an action into the next observation."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Body(Protocol):
    """A body, simulated or physical. It may also have ``close()``, ``batch`` and ``truth``."""

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode."""
        ...

    def step(self, action: Any) -> Any:
        """Act, and return the observation that follows."""
        ...
