"""The algebra of a joint Gaussian: move it on, and condition it on what is seen.

Means and covariances have whatever leading dimensions broadcast: a covariance that is the same for all rows of a batch
is kept once, and computed once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from apmodels import ValueOutOfRange


class Gaussian(NamedTuple):
    """Mean (*lead, n), and covariance (*lead or 1, n, n) in double precision, so that it stays positive definite."""

    mean: Tensor
    covariance: Tensor


def move(belief: Gaussian, matrix: Tensor, offset: Tensor, noise: Tensor) -> Gaussian:
    """Return the law of ``matrix`` x + ``offset`` + e, e ~ N(0, ``noise``).

    Shapes: matrix (*lead, m, n), offset (*lead, m), noise (*lead, m, m).
    """
    mean = _times(matrix.to(belief.mean.dtype), belief.mean) + offset.to(belief.mean.dtype)
    return Gaussian(mean, _symmetric(matrix @ belief.covariance @ matrix.mT + noise))


def condition(
    belief: Gaussian, matrix: Tensor, offset: Tensor, noise: Tensor, value: Tensor
) -> tuple[Gaussian, Tensor]:
    """Condition on ``value`` = ``matrix`` x + ``offset`` + e, e ~ N(0, ``noise``), in Joseph's form.

    Args:
        belief: of x, (*lead, n).
        matrix: (*lead, m, n).
        offset: (*lead, m).
        noise: (*lead, m, m).
        value: (*lead, m); elements that are NaN are missing.

    Returns:
        The conditioned belief, and log p(value), nats, (*lead,).

    Raises:
        ValueOutOfRange: a value without any noise that the belief already held for certain.
    """
    dtype = belief.mean.dtype
    surprise = value - _times(matrix.to(dtype), belief.mean) - offset.to(dtype)
    missing = torch.isnan(value)
    if bool(missing.any()):
        # What is missing is seen through nothing, with a noise of its own: it says nothing.
        surprise = torch.where(missing, 0.0, surprise)
        kept = (~missing).to(noise.dtype)
        matrix = matrix * kept[..., None]
        noise = noise * kept[..., None] * kept[..., None, :] + torch.diag_embed(1 - kept)
    seen = (~missing).sum(-1).to(noise.dtype)
    cross = belief.covariance @ matrix.mT
    root, failed = torch.linalg.cholesky_ex(_symmetric(matrix @ cross + noise))
    if bool((failed != 0).any()):
        raise ValueOutOfRange("an observation without noise repeats what is known for certain; give it some noise")
    gain = torch.cholesky_solve(cross.mT, root).mT
    kept = torch.eye(matrix.shape[-1], dtype=matrix.dtype) - gain @ matrix
    covariance = _symmetric(kept @ belief.covariance @ kept.mT + gain @ noise @ gain.mT)
    mean = belief.mean + _times(gain.to(dtype), surprise)
    whitened = torch.linalg.solve_triangular(root, surprise.to(root.dtype)[..., None], upper=False)[..., 0]
    scale = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    score = -0.5 * (whitened * whitened).sum(-1) - scale - 0.5 * math.log(2 * math.pi) * seen
    return Gaussian(mean, covariance), score.to(dtype)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    if matrix.shape[:-2].numel() == 1:
        # One matrix for all: one product, instead of one for each row.
        wide = max(matrix.dim() - 1, vector.dim())
        product = vector @ matrix.reshape(matrix.shape[-2:]).mT
        return product.reshape((1,) * (wide - product.dim()) + product.shape)
    return (matrix @ vector[..., None])[..., 0]


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)
