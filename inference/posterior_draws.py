"""Draws from an automatic guide, and how probable the guide makes them."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from pyro.infer.autoguide import AutoNormal
from torch import Tensor
from torch.distributions import MultivariateNormal, biject_to

# Draws are taken this much wider than the guide, whose tails are those of a Gaussian: what is too wide costs a few
# draws, what is too narrow gives weights without end.
WIDER = 1.3


class Draws(NamedTuple):
    """Values by site (rows, draws, *shape), and log q of the draws, (rows, draws)."""

    values: dict[str, Tensor]
    log_prob: Tensor


def guide_draws(guide: Any, count: int, rows: int) -> Draws:
    """Draw from a fitted guide: independent in every row."""
    with torch.no_grad():
        free, log_prob = _independent(guide, count, rows) if isinstance(guide, AutoNormal) else _joint(guide, count)
        values: dict[str, Tensor] = {}
        trace: Any = guide.prototype_trace
        for site, value in free.items():
            law = trace.nodes[site]["fn"]
            way = biject_to(law.support)
            values[site] = way(value)
            slope = way.log_abs_det_jacobian(value, values[site])
            log_prob = log_prob - (slope.flatten(2).sum(-1) if slope.dim() > 2 else slope)
    return Draws(values, log_prob)


def _independent(guide: Any, count: int, rows: int) -> tuple[dict[str, Tensor], Tensor]:
    free, total = {}, torch.zeros(rows, count)
    for site in guide.prototype_trace.stochastic_nodes:
        loc, scale = guide._get_loc_and_scale(site)
        batched = len(guide._cond_indep_stacks[site]) > 0
        loc, scale = (part[:, None] if batched else part[None, None] for part in (loc, WIDER * scale))
        noise = torch.randn(rows, count, *loc.shape[2:], dtype=loc.dtype)
        free[site] = loc + scale * noise
        score = -0.5 * noise**2 - scale.log() - 0.9189385332046727
        total = total + (score.flatten(2).sum(-1) if score.dim() > 2 else score)
    return free, total


def _joint(guide: Any, count: int) -> tuple[dict[str, Tensor], Tensor]:
    fitted = guide.get_posterior()
    law = MultivariateNormal(fitted.loc, scale_tril=WIDER * fitted.scale_tril)
    latent = law.sample((count,))
    free, at = {}, 0
    for site in guide.prototype_trace.stochastic_nodes:
        shape = guide._unconstrained_shapes[site]
        size = torch.Size(shape).numel()
        free[site] = latent[:, at : at + size].reshape(1, count, *shape)
        at += size
    return free, law.log_prob(latent)[None]
