"""Draws that stand for a posterior: from an automatic guide first, then from what their own weights say."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from pyro.infer.autoguide import AutoNormal
from torch import Tensor
from torch.distributions import MultivariateNormal, biject_to

# Draws are taken this much wider than the guide, whose tails are those of a Gaussian: what is too wide costs a few
# draws, what is too narrow gives weights without end.
WIDER = 1.3
# A covariance is learned from at least so many effective draws a dimension.
ENOUGH = 8


class Draws(NamedTuple):
    """Values by site (rows, draws, *shape); log q of the draws, (rows, draws); and where they are without bounds."""

    values: dict[str, Tensor]
    log_prob: Tensor
    free: Tensor


class Proposal(NamedTuple):
    """A Gaussian in unconstrained space for every row, (rows, D) and (rows, D, D); its sites (name, shape, way)."""

    centre: Tensor
    root: Tensor
    sites: list[tuple[str, tuple[int, ...], Any]]

    def draw(self, count: int) -> Draws:
        """Draw independently in every row."""
        law = MultivariateNormal(self.centre, scale_tril=WIDER * self.root, validate_args=False)
        free = law.sample(torch.Size([count])).movedim(0, 1)
        log_prob = law.log_prob(free.movedim(1, 0)).movedim(0, 1)
        values, at = {}, 0
        for name, shape, way in self.sites:
            size = torch.Size(shape).numel()
            value = free[..., at : at + size].reshape(*free.shape[:2], *shape)
            values[name] = way(value)
            slope = way.log_abs_det_jacobian(value, values[name])
            log_prob = log_prob - (slope.flatten(2).sum(-1) if slope.dim() > 2 else slope)
            at += size
        return Draws(values, log_prob, free)

    def learned(self, draws: Draws, log_weights: Tensor) -> Proposal:
        """Return the Gaussian that weighed draws suggest (adaptive importance sampling); itself where D is large."""
        size, count = self.centre.shape[-1], log_weights.shape[1]
        if size * ENOUGH * 2 > count:
            return self
        weights = _tempered(log_weights, float(size * ENOUGH))
        centre = (weights[..., None] * draws.free).sum(1)
        off = draws.free - centre[:, None]
        covariance = (weights[..., None] * off).mT @ off
        floor = 1e-10 * torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1) + 1e-12)
        root, failed = torch.linalg.cholesky_ex(covariance + floor)
        good = (failed == 0)[:, None]
        return Proposal(
            torch.where(good, centre, self.centre), torch.where(good[..., None], root, self.root), self.sites
        )


def proposal(guide: Any, rows: int) -> Proposal:
    """Return what a fitted guide proposes."""
    trace: Any = guide.prototype_trace
    sites, centres, spreads = [], [], []
    with torch.no_grad():
        for name in trace.stochastic_nodes:
            way = biject_to(trace.nodes[name]["fn"].support)
            if not isinstance(guide, AutoNormal):
                sites.append((name, tuple(guide._unconstrained_shapes[name]), way))
                continue
            loc, scale = guide._get_loc_and_scale(name)
            batched = len(trace.nodes[name]["cond_indep_stack"]) > 0
            loc, scale = (part if batched else part[None] for part in (loc, scale))
            sites.append((name, tuple(loc.shape[1:]), way))
            centres.append(loc.expand(rows, *loc.shape[1:]).reshape(rows, -1))
            spreads.append(scale.expand(rows, *loc.shape[1:]).reshape(rows, -1))
        if isinstance(guide, AutoNormal):
            return Proposal(torch.cat(centres, 1), torch.diag_embed(torch.cat(spreads, 1)), sites)
        fitted = guide.get_posterior()
        return Proposal(fitted.loc.detach()[None], fitted.scale_tril.detach()[None], sites)


def _tempered(log_weights: Tensor, wanted: float) -> Tensor:
    """Weights (rows, draws) to the largest power up to 1 at which so many draws are effective."""
    low, high = torch.zeros(len(log_weights), 1, dtype=log_weights.dtype), torch.ones(len(log_weights), 1)
    high = high.to(log_weights.dtype)
    for k in range(20):
        power = high if k == 0 else 0.5 * (low + high)
        flat = (power * log_weights).log_softmax(1)
        enough = (-(2 * flat).logsumexp(1, keepdim=True)).exp() >= wanted
        low = torch.where(enough, power, low)
        high = torch.where(enough, high, power)
        if bool((low == 1).all()):
            break
    return (low * log_weights).softmax(1)
