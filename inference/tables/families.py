"""Tabulated laws of an observation: log p(y | hypothesis, context) by the family's own kernel.

A context is all that is known and bears on the observation (the action, known states); a hypothesis is one
combination of the hidden values that bear on it. A table keeps K contexts × H hypotheses. Elements of the
observation that a hypothesis leaves like the common baseline are not kept, and never scored.

Every table answers ``ratio``, log p(y | h) - log p(y | baseline), and ``base``, log p(y | baseline); where there is
no common baseline the latter is zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from apmodels import Planted
from apmodels.distributions import base_of, compact
from inference.tables.finite_table import FiniteTable
from inference.tables.gaussian_table import GaussianTable
from inference.tables.generic_table import GenericTable
from inference.tables.table import Table

# A hypothesis may differ from the baseline in at most this share of the elements for a sparse table to pay.
SPARSE = 0.25


# Kinds of table, from what a model's structure allows at best to what serves every law.
SPARSE_LEVEL, DENSE_LEVEL, GENERIC_LEVEL = range(3)


def tabulate(law: Any, contexts: int, hypotheses: int, level: int = SPARSE_LEVEL) -> Table:
    """Make the table of a law whose batch shape is (contexts, hypotheses); a higher level serves more laws."""
    table: Table | None = None
    while table is None:
        table = _of_level(law, contexts, hypotheses, level)
        level += 1
    table.event_shape, table.hypotheses = law.event_shape, hypotheses
    return table


def _of_level(law: Any, contexts: int, hypotheses: int, level: int) -> Table | None:
    """A table, or None where the level is too low for the law."""
    base, _ = base_of(law)
    planted = isinstance(base, Planted)
    name = type(base.here if planted else base).__name__
    if level == GENERIC_LEVEL or name not in ("Normal", "Categorical", "Bernoulli"):
        return GenericTable(law)
    if planted:
        parts = _planted(base) if level == SPARSE_LEVEL else _dense_planted(base)
    else:
        parts = _elementwise(base, contexts, hypotheses, level)
    if parts is None:
        return None
    return GaussianTable.of(*parts) if name == "Normal" else FiniteTable.of(*parts)


Parts = tuple[Tensor | None, list[Tensor], list[Tensor] | None]


def _family_parameters(base: Any, keep: Callable[[Tensor], Tensor] = lambda p: p) -> list[Tensor]:
    """Parameters of one element, each with all batch dimensions and one more for the parameter's own."""
    if type(base).__name__ == "Normal":
        return [keep(base.loc)[..., None], keep(base.scale)[..., None]]
    probs = keep(base.probs)
    return [torch.stack([1 - probs, probs], -1)] if type(base).__name__ == "Bernoulli" else [probs]


def _planted(law: Planted) -> Parts | None:
    """Index (K, H, 1), parameters there (K, H, 1, P), and elsewhere (K, E, P)."""
    here = [p.unsqueeze(2) for p in _family_parameters(law.here)]
    elsewhere = _family_parameters(law.elsewhere, compact)
    # What is planted does not change what is elsewhere; if it does, the law is as good as dense.
    if any(p.shape[1] != 1 for p in elsewhere):
        return None
    shape = (len(law.index), law.event_shape[0])
    return law.index[..., None], here, [p[:, 0].expand(*shape, p.shape[-1]) for p in elsewhere]


def _dense_planted(law: Planted) -> Parts:
    index = law.index[..., None, None]
    here = [p.unsqueeze(2) for p in _family_parameters(law.here)]
    dense = []
    for p, other in zip(here, _family_parameters(law.elsewhere), strict=True):
        wide = other.expand(*law.index.shape, *other.shape[2:])
        dense.append(wide.scatter(2, index.expand(*p.shape), p))
    return None, dense, None


def _elementwise(base: Any, contexts: int, hypotheses: int, level: int) -> Parts | None:
    """Index, parameters there and baseline of a law most of whose elements are alike; or (None, all of them, None)."""
    dense = [p.reshape(contexts, hypotheses, -1, p.shape[-1]) for p in _family_parameters(base)]
    if level == DENSE_LEVEL:
        return None, dense, None
    if hypotheses < 3 or dense[0].shape[2] < 2:
        return None
    baseline = _baseline(dense)
    differs = torch.stack([(p != b[:, None]).any(-1) for p, b in zip(dense, baseline, strict=True)]).any(0)
    most = int(differs.sum(-1).max())
    if most > SPARSE * differs.shape[-1]:
        return None
    index = _positions(differs, max(most, 1))
    here = [p.gather(2, index[..., None].expand(*index.shape, p.shape[-1])) for p in dense]
    return index, here, baseline


def _baseline(dense: list[Tensor]) -> list[Tensor]:
    """The parameters (K, E, P) that at least two of three hypotheses share, else any: then nothing is alike."""
    first, middle, last = 0, dense[0].shape[1] // 2, dense[0].shape[1] - 1
    agree = torch.stack([(p[:, first] == p[:, middle]).all(-1) for p in dense]).all(0)
    return [torch.where(agree[..., None], p[:, first], p[:, last]) for p in dense]


def _positions(differs: Tensor, most: int) -> Tensor:
    """The positions of the true elements, (K, H, most); where there are fewer, elements that do not differ."""
    # A stable descending sort of a mask puts the true elements first.
    return differs.to(torch.uint8).topk(most, dim=-1).indices
