"""What a bank of worlds says about a variable: mixtures over worlds of what is believed in each."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import Beta, Categorical, Dirichlet, Gamma, Independent, MultivariateNormal, Normal
from pyro.distributions.torch import MixtureSameFamily  # type: ignore[attr-defined]
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.errors import nearest
from inference.answers.outcomes import outcomes, ranged
from inference.beliefs import Marginal, Weighted
from inference.worlds.gaussian import Gaussian


def marginal(engine: Any, belief: Any, name: str) -> Any:
    """Return the distribution of a hidden variable, batch shape (*batch,)."""
    plan = engine.plan
    if name in plan.integrated:
        return _integrated(engine, belief, name)
    if name == "interest" or name in (*plan.worlds, *plan.computed, *plan.finite):
        if ranged(engine, name):
            values, logs = outcomes(engine, belief, (name,))
            return Marginal(_single(belief, logs), values[name])
        value = values_of(engine, belief, name)
        if name == "interest" and not value.is_floating_point():
            values, logs = shares(engine, value)
            return Marginal(_single(belief, logs), values)
        weights = belief.log_weights if name != "interest" or value.shape[1] == belief.log_weights.shape[1] else None
        if weights is None:
            weights = torch.full(value.shape[:2], -math.log(value.shape[1]), dtype=engine.dtype)
        value = value.expand(*weights.shape, *value.shape[2:])
        return Weighted(_single(belief, weights), _single(belief, value))
    node = engine.structure.nodes.get(name)
    if node is None:
        hidden = [node.name for node in engine.structure.hidden]
        raise ValueOutOfRange(f"there is no variable {name}{nearest(name, hidden)}")
    raise ValueOutOfRange(f"{name} is {node.plan}, and no belief is held about it: see belief.known")


def shares(engine: Any, drawn: Tensor) -> tuple[Tensor, Tensor]:
    """The whole values (n, *shape) of a function of variables, those that the prior allows; and their log shares."""
    flat = drawn.reshape(drawn.shape[0] * drawn.shape[1], -1)
    if "values" not in engine.functions:
        first = values_of(engine, engine.start(), "interest")
        engine.functions["values"] = torch.unique(first.reshape(first.shape[1], -1), dim=0)
    listed = engine.functions["values"]
    table = torch.unique(torch.cat([listed, flat]), dim=0)
    listed = listed if len(table) == len(listed) else table
    same = (flat[:, None] == listed[None]).all(-1).reshape(*drawn.shape[:2], len(listed))
    return listed.reshape(-1, *drawn.shape[2:]), same.to(engine.dtype).mean(1).log()


def values_of(engine: Any, belief: Any, name: str) -> Tensor:
    """The value of a variable in every world, or of a function of variables in as many draws, (rows, n, *shape)."""
    if name == "interest":
        from inference.answers.draws import function_draws

        return function_draws(engine, belief)
    if name not in belief.values:
        raise ValueOutOfRange(f"{name} has no value before the first step")
    return belief.values[name]


def gaussian_of(engine: Any, belief: Any, names: tuple[str, ...], index: int) -> Gaussian:
    """Return the joint Gaussian, in every world, of some variables of one Gaussian group."""
    block = engine.gaussians[index]
    layout = block.layout(belief.time)
    for name in names:
        if (name, 0) not in layout:
            raise ValueOutOfRange(f"{name} has no value before the first step")
    return block.take(belief.gaussian[index], layout, [(name, 0) for name in names])


def _integrated(engine: Any, belief: Any, name: str) -> Any:
    shape = tuple(engine.structure.nodes[name].shape)
    rows, worlds = belief.log_weights.shape
    for i, group in enumerate(engine.plan.gaussian):
        if name in group:
            found = gaussian_of(engine, belief, (name,), i)
            return _mixture(belief, _gaussian(found, shape, (rows, worlds)), worlds)
    for i, group in enumerate(engine.plan.fields):
        if name in group:
            if name not in belief.fields[i]:
                gone = engine.roles[name] == "static"
                when = "is not kept after the first step: it is only what another was" if gone else "has no value"
                raise ValueOutOfRange(f"{name} {when} before {'time began' if gone else 'the first step'}")
            mean, variance = (part.expand(rows, worlds, *shape) for part in belief.fields[i][name])
            return _mixture(belief, [mean, variance.sqrt(), len(shape)], worlds)
    index = next(i for i, group in enumerate(engine.plan.counted) if name in group)
    counts = engine.tallies[index].parameters(belief.counts[index], name).to(engine.dtype)
    counts = counts.expand(rows, worlds, *counts.shape[2:])
    return _mixture(belief, [engine.tallies[index].kind, counts, shape], worlds)


def _gaussian(found: Gaussian, shape: tuple[int, ...], lead: tuple[int, int]) -> list[Any]:
    mean = found.mean.expand(*lead, -1)
    covariance = found.covariance.expand(*lead, *found.covariance.shape[-2:])
    if len(shape) == 1:
        return [mean, _root(covariance).to(mean.dtype), None]
    # A scalar, or an array of which the elements are given one by one.
    spread = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt().to(mean.dtype)
    return [mean.reshape(*lead, *shape), spread.reshape(*lead, *shape), len(shape)]


def _root(covariance: Tensor) -> Tensor:
    """A lower triangular square root, also of what is singular."""
    root, failed = torch.linalg.cholesky_ex(covariance)
    if bool((failed != 0).any()):
        values, vectors = torch.linalg.eigh(covariance)
        floor = 1e-18 + 1e-15 * values.amax(-1, keepdim=True)
        half = vectors * torch.maximum(values, floor).sqrt()[..., None, :]
        upper = torch.linalg.qr(half.mT).R
        sign = torch.sign(upper.diagonal(dim1=-2, dim2=-1))
        root = upper.mT * torch.where(sign == 0, 1.0, sign)[..., None, :]
    return root


def _mixture(belief: Any, parts: list[Any], worlds: int) -> Any:
    """A distribution of one world's family, or the mixture of several worlds'."""

    def cut(value: Tensor) -> Tensor:
        value = value[:, 0] if worlds == 1 else value
        return value[0] if belief.batch is None else value

    law: Any
    if isinstance(parts[0], str):
        kind, counts, shape = parts
        counts = cut(counts)
        lead = counts.shape[:-2]
        if kind == "Dirichlet":
            law = Dirichlet(counts.reshape((*lead, *shape)), validate_args=False)
        else:
            first, second = (counts[..., i].reshape((*lead, *shape)) for i in (1, 0))
            if kind == "Gamma":
                first, second = second, first
            law = (Beta if kind == "Beta" else Gamma)(first, second, validate_args=False)
        events = len(shape) - (kind == "Dirichlet")
    elif parts[2] is None:
        law, events = MultivariateNormal(cut(parts[0]), scale_tril=cut(parts[1]), validate_args=False), 0
    else:
        law, events = Normal(cut(parts[0]), cut(parts[1]), validate_args=False), parts[2]
    law = Independent(law, events) if events else law
    if worlds == 1:
        return law
    return MixtureSameFamily(Categorical(logits=_single(belief, belief.log_weights)), law, validate_args=False)


def _single(belief: Any, value: Tensor) -> Tensor:
    return value[0] if belief.batch is None else value
