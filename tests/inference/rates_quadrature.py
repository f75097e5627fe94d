"""Beliefs about rates by numerical integration: no conjugacy is used, and nothing of the library.

Given each hypothesis, prior times likelihood is evaluated on a grid over all rates jointly and summed with the weights
of a Gauss rule, which is exact for polynomials (Beta and Dirichlet priors of whole parameters) and good to rounding for
the smooth integrands of a Gamma.
"""

import numpy as np
from scipy import stats


class Quadrature:
    """Posterior over finite hypotheses and rates.

    Args:
        priors: the prior probability of each hypothesis, (H,).
        points: the grid of rates, (n, rates).
        weights: log of prior density times the rule's weight at each point, given each hypothesis, (H, n).
        likelihood: log p(record | hypothesis, rates) on the whole grid, from (hypothesis, points), (n,).
    """

    def __init__(self, priors, points, weights, likelihood):
        with np.errstate(divide="ignore"):
            logs = [np.log(p) + w + likelihood(h, points) for h, (p, w) in enumerate(zip(priors, weights, strict=True))]
        logs = np.stack(logs)
        self.points = points
        self.evidence = float(np.logaddexp.reduce(logs, axis=None))
        self.cells = np.exp(logs - self.evidence)

    @property
    def probabilities(self):
        """Of each hypothesis, (H,)."""
        return self.cells.sum(1)

    @property
    def entropy(self):
        """Of the hypothesis, nats."""
        return float(stats.entropy(self.probabilities))

    @property
    def mean(self):
        """Of each rate, (rates,), over all hypotheses."""
        return self.cells.sum(0) @ self.points

    @property
    def variance(self):
        """Of each rate, (rates,), over all hypotheses."""
        return self.cells.sum(0) @ (self.points - self.mean) ** 2


def grid(*axes):
    """All combinations of points (n_i, d_i), (n, sum of d_i), and the sum of their log weights, (n,)."""
    index = np.stack(np.meshgrid(*[np.arange(len(points)) for points, _ in axes], indexing="ij")).reshape(len(axes), -1)
    points = np.concatenate([points[i] for (points, _), i in zip(axes, index, strict=True)], 1)
    return points, sum(logs[i] for (_, logs), i in zip(axes, index, strict=True))


def interval(nodes, low=0.0, high=1.0):
    """Gauss-Legendre points, (nodes, 1), and log weights."""
    points, weights = np.polynomial.legendre.leggauss(nodes)
    return (low + (high - low) * (points + 1) / 2)[:, None], np.log(weights * (high - low) / 2)


def triangle(nodes):
    """Points of the simplex of three probabilities, (nodes ** 2, 3), and log weights: (x, (1 - x) y, the rest)."""
    points, logs = grid(interval(nodes), interval(nodes))
    x, y = points.T
    return np.stack([x, (1 - x) * y, (1 - x) * (1 - y)], 1), logs + np.log(1 - x)


def tossed(rate, outcomes):
    """Log p of outcomes 0 and 1 at rates (n,); NaN is missing."""
    return sum((np.log(rate if y == 1 else 1 - rate) for y in outcomes if not np.isnan(y)), np.zeros(len(rate)))


def counted(rate, drops):
    """Log p of Poisson counts at rates (n,); NaN is missing."""
    return sum((stats.poisson.logpmf(y, rate) for y in drops if not np.isnan(y)), np.zeros(len(rate)))


def rolled(table, outcomes):
    """Log p of categories under probabilities (n, categories); NaN is missing."""
    return sum((np.log(table[:, int(y)]) for y in outcomes if not np.isnan(y)), np.zeros(len(table)))
