"""What a bank of worlds expects to see: a mixture over worlds of what is expected in each."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import Categorical, Delta, Independent, MultivariateNormal, Normal
from pyro.distributions.torch import Bernoulli, MixtureSameFamily, NegativeBinomial  # type: ignore[attr-defined]
from torch import Tensor
from torch.distributions import Distribution

from apmodels.distributions import tensors, with_tensors
from inference.worlds.gaussian_block import predicted
from inference.worlds.step import BankBelief, Step

# The pseudo-count that stands for certainty: more of it is lost to rounding.
CERTAIN = 1e8


def forecast(engine: Any, belief: BankBelief, action: Any) -> Any:
    """Return the predictive distribution of the next observation; a dict by name where there are several."""
    rows = len(belief.log_weights)
    step, _ = engine.step_of(belief, engine._actions(action, rows))
    engine.move(step)
    made = {name: _forecast(engine, belief, step, name) for name in engine.model.observation_names}
    return next(iter(made.values())) if len(made) == 1 else made


def _forecast(engine: Any, belief: BankBelief, step: Step, name: str) -> Any:
    kind, at = engine.owner.get(name, ("", 0))
    shape = tuple(engine.shown[name])
    weights = belief.log_weights
    if kind == "gaussian":
        block = engine.gaussians[at]
        law = _gaussian(
            engine, block, predicted(block.advance(step.gaussian[at], step.frame), block.view(step.frame)), name
        )
    elif kind == "field":
        centre, variance = engine.images[at].predicted(name, step.fields[at], step.frame)
        law = Independent(Normal(centre, variance.sqrt(), validate_args=False), len(shape))
    elif kind == "count":
        law = _counted(engine.tallies[at], step.counts[at], step, name, shape, engine.dtype)
    elif kind == "finite":
        inner, law = engine.summed.predicted(name, step.finite, step.frame)
        cells = inner.shape[-1]
        weights = (weights[..., None] + inner.log().reshape(*weights.shape, cells)).flatten(1)
        law = with_tensors(law, [p.reshape(len(weights), -1, *p.shape[2:]) for p in tensors(law)], weights.shape, 2)
    else:
        found = step.frame.in_all(engine.laws, name, step.lead)
        law = found
        if not isinstance(found, Distribution):
            law = Delta(found.to(engine.dtype), event_dim=len(shape), validate_args=False)
    return _mixed(belief, weights, law)


def _gaussian(engine: Any, block: Any, found: Any, name: str) -> Any:
    at = 0
    for other in block.seen:
        width = torch.Size(engine.shown[other]).numel()
        if other == name:
            break
        at += width
    shape = tuple(engine.shown[name])
    mean, covariance = found.mean[..., at : at + width], found.covariance[..., at : at + width, at : at + width]
    if len(shape) == 1:
        covariance = covariance.to(mean.dtype).expand(*mean.shape, mean.shape[-1])
        return MultivariateNormal(mean, covariance_matrix=covariance, validate_args=False)
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt().to(mean.dtype).expand(mean.shape)
    lead = mean.shape[:-1]
    law = Normal(mean.reshape(*lead, *shape), spread.reshape(*lead, *shape), validate_args=False)
    return Independent(law, len(shape)) if shape else law


def _counted(block: Any, counts: Tensor, step: Step, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Any:
    """Element by element: what is selected, in the mean."""
    index, alone = block.selected[name](step.frame)
    lead = torch.broadcast_shapes(counts.shape[:2], index.shape[:2])
    wide = counts.expand(*lead, *counts.shape[2:])
    at = index.clamp(min=0).expand(*lead, -1)[..., None].expand(*lead, index.shape[-1], counts.shape[-1])
    found = wide.gather(2, at)
    told = (index >= 0)[..., None]
    if block.kind == "Gamma":
        # A Poisson variable of a known rate is one of a Gamma that is all but certain; single precision is too coarse.
        size = torch.where(told[..., 0], found[..., 0].double(), CERTAIN)
        rate = torch.where(told[..., 0], found[..., 1].double(), CERTAIN / alone[..., 0].double().clamp(min=1e-12))
        law: Any = NegativeBinomial(size.reshape(*lead, *shape), (1 / (1 + rate)).reshape(*lead, *shape))
    else:
        mean = found / found.sum(-1, keepdim=True)
        if block.kind == "Beta":
            probs = torch.where(told[..., 0], mean[..., 1], alone[..., 0])
            law = Bernoulli(probs.reshape(*lead, *shape).to(dtype), validate_args=False)
        else:
            probs = torch.where(told, mean, alone)
            law = Categorical(probs.reshape(*lead, *shape, probs.shape[-1]).to(dtype), validate_args=False)
    return Independent(law, len(shape)) if shape else law


def _mixed(belief: BankBelief, weights: Tensor, law: Any) -> Any:
    rows, worlds = weights.shape
    parts = tensors(law)
    lead = law.batch_shape[:2]
    wide = [p.expand(rows, p.shape[1] if worlds == 1 else worlds, *p.shape[2:]) for p in parts]
    if worlds == 1:
        only = [p[:, 0] for p in wide]
        law = with_tensors(law, only, (rows,), len(lead))
        return with_tensors(law, [p[0] for p in only], (), 1) if belief.batch is None else law
    law = with_tensors(law, wide, (rows, worlds), len(lead))
    if belief.batch is None:
        law, weights = with_tensors(law, [p[0] for p in wide], (worlds,), 2), weights[0]
    return MixtureSameFamily(Categorical(logits=weights), law, validate_args=False)
