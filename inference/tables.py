"""Tabulated laws of an observation: log p(y | hypothesis, context) by the family's own kernel.

A context is all that is known and bears on the observation (the action, known states); a hypothesis is one
combination of the hidden values that bear on it. A table keeps K contexts × H hypotheses. Elements of the
observation that a hypothesis leaves like the common baseline are not kept, and never scored.

Every table answers ``ratio``, log p(y | h) - log p(y | baseline), and ``base``, log p(y | baseline); where there is
no common baseline the latter is zero.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels import Planted
from apmodels.distributions import base_of, compact
from inference.finite_table import FiniteTable
from inference.gaussian_table import GaussianTable
from inference.generic_table import GenericTable
from inference.table import Table

# A hypothesis may differ from the baseline in at most this share of the elements for a sparse table to pay.
SPARSE = 0.25


def tabulate(law: Any, contexts: int, hypotheses: int, generic: bool = False) -> Table:
    """Make the table of a law whose batch shape is (contexts, hypotheses); ``generic`` serves every family alike."""
    base, added = base_of(law)
    if generic:
        parts = None
    elif isinstance(base, Planted):
        parts = _planted(base)
    elif len(base.event_shape) == 0:
        parts = _elementwise(base, added, contexts, hypotheses)
    else:
        parts = None
    name = type(base.here if isinstance(base, Planted) else base).__name__
    table: Table | None = None
    if parts is not None and name == "Normal":
        table = GaussianTable.of(*parts)
    elif parts is not None and name in ("Categorical", "Bernoulli"):
        table = FiniteTable.of(*parts, categorical=name == "Categorical")
    table = table or GenericTable(law)
    table.event_shape, table.hypotheses = law.event_shape, hypotheses
    return table


Parts = tuple[Tensor | None, list[Tensor], list[Tensor] | None]


def _family_parameters(base: Any) -> list[Tensor]:
    """Parameters of one element, each with all batch dimensions and one more for the parameter's own."""
    if type(base).__name__ == "Normal":
        return [base.loc[..., None], base.scale[..., None]]
    if type(base).__name__ == "Bernoulli":
        return [torch.stack([1 - base.probs, base.probs], -1)]
    return [base.probs] if type(base).__name__ == "Categorical" else []


def _planted(law: Planted) -> Parts:
    """Index (K, H, 1), parameters there (K, H, 1, P), and elsewhere (K, E, P)."""
    here = [p.unsqueeze(2) for p in _family_parameters(law.here)]
    # What is planted does not change what is elsewhere; if it does, the law is as good as dense.
    elsewhere = [compact(p) for p in _family_parameters(law.elsewhere)]
    if any(p.shape[1] != 1 for p in elsewhere):
        index = law.index[..., None, None]
        dense = [
            e.expand(*law.index.shape, *e.shape[2:]).scatter(2, index.expand(*h.shape), h)
            for e, h in zip(_family_parameters(law.elsewhere), here, strict=True)
        ]
        return None, dense, None
    shape = (len(law.index), *elsewhere[0].shape[2:3])
    return law.index[..., None], here, [p[:, 0].expand(*shape, p.shape[-1]) for p in elsewhere]


def _elementwise(base: Any, added: int, contexts: int, hypotheses: int) -> Parts:
    """Index, parameters there and baseline of a dense law if most elements are alike, else (None, dense, None)."""
    dense = [p.reshape(contexts, hypotheses, -1, p.shape[-1]) for p in _family_parameters(base)]
    if not dense or hypotheses < 3 or dense[0].shape[2] < 2:
        return None, dense, None
    baseline = _baseline(dense)
    differs = torch.stack([(p != b[:, None]).any(-1) for p, b in zip(dense, baseline, strict=True)]).any(0)
    most = int(differs.sum(-1).max())
    if most > SPARSE * differs.shape[-1]:
        return None, dense, None
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
