"""A record, and what is made of it when something is asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from apmodels.simulation import Values
from inference.beliefs import Belief


@dataclass(frozen=True)
class VariationalBelief(Belief):
    """A record, and the posterior that is fitted to it when it is first asked for.

    ``record`` are the (actions, observations) of every step, each (rows, ...) by name.
    """

    record: tuple[tuple[Values, Values], ...] = field(repr=False)
    before: Any = field(repr=False, compare=False, default=None)
    # Where the posterior is kept, once it was asked for.
    kept: dict = field(repr=False, compare=False, default_factory=dict)

    @property
    def log_evidence(self) -> Tensor:  # type: ignore[override]
        """log p(observations | actions), nats, (*batch,): the log of the mean weight of the draws."""
        return self.engine.posterior(self).log_evidence

    @log_evidence.setter
    def log_evidence(self, value: Any) -> None:
        # Known once the posterior is; the field of every belief is not kept.
        pass


def line(belief: VariationalBelief) -> Iterator[VariationalBelief]:
    """The beliefs before one, the latest first."""
    node = belief.before
    while node is not None:
        yield node
        node = node.before
