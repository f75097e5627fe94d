"""Entropies of what a bank of worlds believes: exact where there is a closed form, else an estimate that says so."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import Beta, Dirichlet, Gamma, MultivariateNormal, Normal
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values
from inference.answers.draws import draw_values, function_draws
from inference.answers.outcomes import outcomes, ranged
from inference.answers.posteriors import gaussian_of, marginal
from inference.worlds.gaussian import Gaussian
from inference.worlds.step import even, flat, pick

# Draws for entropies of mixtures, and values for those of weighted ones.
DRAWS, KERNELS = 2048, 512


def entropy(engine: Any, belief: Any, names: tuple[str, ...]) -> Tensor:
    """Return the joint entropy of variables, nats, (rows,).

    Exact for finite variables, for what is integrated given one world, and jointly with all that tells the worlds
    apart. A mixture's is an average over draws with a fixed seed; that of weighted values is a kernel estimate.
    """
    if names == ("interest",) and engine.model.declaration.interest is not None and not ranged(engine, "interest"):
        return _of_function(engine, belief)
    for name in names:
        marginal(engine, belief, name)
    if all(ranged(engine, name) for name in names):
        _, logs = outcomes(engine, belief, names)
        return -(logs.exp() * logs.clamp(min=torch.finfo(logs.dtype).min)).sum(-1)
    inner = [name for name in names if name in engine.plan.integrated]
    outer = tuple(name for name in names if name not in inner)
    worlds = belief.log_weights.shape[1]
    if all(ranged(engine, name) for name in outer):
        if worlds == 1 or (engine.distinct and set(engine.plan.worlds) <= set(outer)):
            first = entropy(engine, belief, outer) if outer else torch.zeros(len(belief.log_weights))
            return first.to(engine.dtype) + (belief.log_weights.exp() * _within(engine, belief, inner)).sum(1)
        return _of_mixture(engine, belief, inner, outer)
    values = draw_values(engine, belief, KERNELS)
    lead = (len(belief.log_weights), KERNELS)
    return _kernel([_coordinates(engine, name, values[name], lead) for name in names])


def _coordinates(engine: Any, name: str, value: Tensor, lead: tuple[int, int]) -> Tensor:
    """A variable's free coordinates: of probabilities that sum to 1, all but the last."""
    value = value.expand(*lead, *value.shape[2:])
    return value[..., :-1] if engine.structure.nodes[name].family == "Dirichlet" else value


def _within(engine: Any, belief: Any, names: list[str]) -> Tensor:
    """The entropy, in every world, of variables that are integrated, (rows, worlds)."""
    total = torch.zeros(belief.log_weights.shape, dtype=torch.float64)
    for i, group in enumerate(engine.plan.gaussian):
        some = tuple(name for name in names if name in group)
        if some:
            covariance = gaussian_of(engine, belief, some, i).covariance
            size = covariance.shape[-1]
            total = total + 0.5 * (torch.linalg.slogdet(covariance)[1] + size * (1 + math.log(2 * math.pi)))
    for i, group in enumerate(engine.plan.fields):
        for name in (name for name in names if name in group):
            variance = belief.fields[i][name][1].flatten(2).double()
            total = total + 0.5 * (variance.log() + 1 + math.log(2 * math.pi)).sum(-1)
    for i, block in enumerate(engine.tallies):
        for name in (name for name in names if name in block.names):
            total = total + _law(block.kind, block.parameters(belief.counts[i], name)).entropy().sum(-1)
    return total.to(engine.dtype)


def _law(kind: str, counts: Tensor) -> Any:
    if kind == "Dirichlet":
        return Dirichlet(counts, validate_args=False)
    if kind == "Gamma":
        return Gamma(counts[..., 0], counts[..., 1], validate_args=False)
    return Beta(counts[..., 1], counts[..., 0], validate_args=False)


def _of_mixture(engine: Any, belief: Any, inner: list[str], outer: tuple[str, ...]) -> Tensor:
    values = draw_values(engine, belief, DRAWS)
    logs = belief.log_weights[:, None] + _density(engine, belief, inner, values)
    logs = logs + _summed(engine, belief, [name for name in outer if name in engine.plan.finite], values)
    for name in (name for name in outer if name not in engine.plan.finite):
        # (rows, draws, worlds): whether a world agrees with what was drawn.
        here, there = values[name][:, :, None], belief.values[name][:, None]
        same = (here == there).flatten(3).all(-1) if here.dim() > 3 else here == there
        logs = torch.where(same, logs, -torch.inf)
    return -logs.logsumexp(2).mean(1)


def _summed(engine: Any, belief: Any, names: list[str], values: Values) -> Tensor:
    """log p of drawn values of summed variables in every world, (rows, draws, worlds)."""
    rows, worlds = belief.log_weights.shape
    if not names:
        return torch.zeros(rows, 1, worlds, dtype=engine.dtype)
    axes = {axis.name: i for i, axis in enumerate(engine.summed.axes)}
    for name in names:
        if name not in axes:
            raise ValueOutOfRange(f"{name} is computed from what is summed: ask for its entropy apart")
    gone = [i + 2 for name, i in axes.items() if name not in names]
    logs = belief.finite.logsumexp(gone) if gone else belief.finite
    cell = torch.zeros(1, 1, dtype=torch.int64)
    for axis in (axis for axis in engine.summed.axes if axis.name in names):
        value = values[axis.name].to(axis.values.dtype)
        same = (flat(value)[:, :, None] == axis.values.reshape(1, 1, axis.size, -1)).all(-1)
        cell = cell * axis.size + same.to(torch.uint8).argmax(-1)
    table = logs.expand(rows, worlds, *logs.shape[2:]).flatten(2).mT
    return table.gather(1, cell.expand(rows, -1)[..., None].expand(-1, -1, worlds))


def _density(engine: Any, belief: Any, names: list[str], values: Values) -> Tensor:
    """log p of drawn values in every world, (rows, draws, worlds)."""
    rows, worlds = belief.log_weights.shape
    total = torch.zeros(rows, 1, worlds, dtype=engine.dtype)
    for i, group in enumerate(engine.plan.gaussian):
        some = tuple(name for name in names if name in group)
        if some:
            found: Gaussian = gaussian_of(engine, belief, some, i)
            value = torch.cat([flat(values[name]) for name in some], -1)[:, :, None]
            law = MultivariateNormal(
                found.mean.double()[:, None], covariance_matrix=found.covariance[:, None], validate_args=False
            )
            total = total + law.log_prob(value.double()).to(engine.dtype)
    for i, group in enumerate(engine.plan.fields):
        for name in (name for name in names if name in group):
            mean, variance = belief.fields[i][name]
            law = Normal(mean[:, None], variance.sqrt()[:, None], validate_args=False)
            total = total + law.log_prob(values[name][:, :, None]).flatten(3).sum(-1)
    for i, block in enumerate(engine.tallies):
        for name in (name for name in names if name in block.names):
            counts = block.parameters(belief.counts[i], name)[:, None]
            shape = (*values[name].shape[:2], 1, *counts.shape[3:])
            value = values[name].double()
            value = value.reshape(shape) if block.kind == "Dirichlet" else value.reshape(shape[:-1])
            total = total + _law(block.kind, counts).log_prob(value).sum(-1).to(engine.dtype)
    return total


def _of_function(engine: Any, belief: Any) -> Tensor:
    value = function_draws(engine, belief)
    if value.is_floating_point():
        rows = torch.full(value.shape[:2], -math.log(value.shape[1]))
        index = even(rows, KERNELS, torch.full((len(rows), 1), 0.5))
        return _kernel([pick(value, index)])
    rows, draws = value.shape[:2]
    table, groups = torch.unique(value.reshape(rows * draws, -1), dim=0, return_inverse=True)
    ones = torch.ones(rows, draws)
    counts = torch.zeros(rows, len(table)).scatter_add(1, groups.reshape(rows, draws), ones)
    probs = counts / counts.sum(1, keepdim=True)
    return -torch.xlogy(probs, probs).sum(1).to(engine.dtype)


def _kernel(values: list[Tensor]) -> Tensor:
    """The entropy of equally weighted values (rows, n, ...), each of which is smeared by Silverman's bandwidth."""
    points = torch.cat([flat(value) for value in values], -1).double()
    rows, count, size = points.shape
    off = points - points.mean(1, keepdim=True)
    covariance = off.mT @ off / count + 1e-12 * torch.eye(size, dtype=torch.float64)
    root = torch.linalg.cholesky(covariance)
    width = (4 / (count * (size + 2))) ** (1 / (size + 4))
    white = torch.linalg.solve_triangular(root, off.mT, upper=False).mT / width
    distance = torch.cdist(white, white) ** 2
    # A value is no neighbour of itself.
    distance = distance + torch.diag_embed(torch.full((rows, count), torch.inf, dtype=torch.float64))
    logs = (-0.5 * distance).logsumexp(2) - math.log(count - 1) - 0.5 * size * math.log(2 * math.pi)
    scale = root.diagonal(dim1=-2, dim2=-1).log().sum(-1) + size * math.log(width)
    return (scale - logs.mean(1)).to(values[0].dtype)
