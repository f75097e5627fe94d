"""Engines against peers, filtering whole records: filterpy, dynamax, pymdp and particles (install them: make bench).

Every peer is used as its own documentation does, on the same data, compilation excluded, and its answers are compared
with ours. What is slow is run on a subset, and its time is scaled. Ours are the declared model, ``engine.filter`` and
nothing else. Precision: dynamax and pymdp compute in single precision, filterpy and particles in double; ours in single
precision, but for covariances.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from pyro.distributions import Categorical, MultivariateNormal, Normal
from torch import Tensor

from apmodels import Model, observation, state
from benchmarks.timing import milliseconds
from inference import Exact, Kalman, Particles

SERIES, STEPS = 1000, 200
# So many series that the time goes into arithmetic, and not into asking for it.
MANY = 8000
FILTERPY_SERIES = 20
PARTICLES = 10_000
REST = 0.02
STILL = torch.zeros(4)


def measure() -> dict[str, float]:
    return _kalman() | _finite() | _particles()


# Constant velocity on a plane: four Gaussian states, of which two are seen.


class Moving(Model):
    """Position and velocity on a plane; the position is seen."""

    move: Tensor = torch.tensor([[1.0, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])
    push: Tensor = 0.1 * torch.tensor([[1 / 3, 0, 1 / 2, 0], [0, 1 / 3, 0, 1 / 2], [1 / 2, 0, 1, 0], [0, 1 / 2, 0, 1]])

    @state
    def motion(self, prev_motion=STILL):
        return MultivariateNormal(self.move @ prev_motion, self.push)

    @observation
    def reading(self, motion):
        return Normal(motion[:2], 1.0).to_event(1)


def _kalman() -> dict[str, float]:
    import jax
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm.inference import lgssm_filter, make_lgssm_params
    from filterpy.kalman import KalmanFilter

    model = Moving()
    readings = model.simulate(STEPS, batch=SERIES, seed=1)["reading"]
    engine = Kalman(model)
    move, push, see = model.move.double().numpy(), model.push.double().numpy(), np.eye(2, 4)
    params = make_lgssm_params(np.zeros(4), push, move, push, see, np.eye(2))
    compiled = jax.jit(jax.vmap(lambda emissions: lgssm_filter(params, emissions)))
    emissions, columns = jnp.asarray(readings.numpy()), readings.double().numpy()[..., None]

    def filterpy() -> np.ndarray:
        means = []
        for series in columns[:FILTERPY_SERIES]:
            kalman = KalmanFilter(dim_x=4, dim_z=2)
            kalman.F, kalman.Q, kalman.H, kalman.R, kalman.P = move, push, see, np.eye(2), np.zeros((4, 4))
            means.append(kalman.batch_filter(series)[0])
        return np.stack(means)[..., 0]

    def ours() -> Any:
        return engine.filter(None, readings, batch=SERIES)

    def dynamax() -> Any:
        return jax.block_until_ready(compiled(emissions))

    beliefs, theirs = ours(), dynamax()
    means = np.stack([belief.marginal("motion").mean.numpy() for belief in beliefs], 1)
    spread = np.sqrt(np.diagonal(np.asarray(theirs.filtered_covariances), axis1=-2, axis2=-1))
    one, other, peer = _times(ours, dynamax, filterpy, repeats=20)
    peer *= SERIES / FILTERPY_SERIES
    many = model.simulate(STEPS, batch=MANY, seed=2)["reading"]
    wide = jnp.asarray(many.numpy())
    ours_many, theirs_many = _times(
        lambda: engine.filter(None, many, batch=MANY), lambda: jax.block_until_ready(compiled(wide)), repeats=9
    )
    return {
        "kalman_ms": one,
        "kalman_dynamax_ms": other,
        "kalman_filterpy_ms": peer,
        "kalman_vs_dynamax": other / one,
        "kalman_many_ms": ours_many,
        "kalman_many_dynamax_ms": theirs_many,
        "kalman_many_vs_dynamax": theirs_many / ours_many,
        "kalman_vs_filterpy": peer / one,
        "difference.kalman_dynamax_deviations": _largest((means - np.asarray(theirs.filtered_means)) / spread),
        "difference.kalman_dynamax_nats": _largest(beliefs[-1].log_evidence - np.asarray(theirs.marginal_loglik)),
        "difference.kalman_filterpy_deviations": _largest(
            (means[:FILTERPY_SERIES] - filterpy()) / spread[:FILTERPY_SERIES]
        ),
    }


# A hidden Markov model: one of 64 places, one of 32 signs.


class Chain(Model):
    """Places that follow each other, and signs that tell of them."""

    moves: Tensor
    signs: Tensor

    @state
    def place(self, prev_place=0):
        return Categorical(self.moves[prev_place])

    @observation
    def sign(self, place):
        return Categorical(self.signs[place])

    interest = place


def _finite() -> dict[str, float]:
    import equinox
    import jax
    import jax.numpy as jnp
    from dynamax.hidden_markov_model.inference import hmm_filter
    from pymdp.agent import Agent

    draw = np.random.default_rng(0)
    moves, signs = (draw.dirichlet(np.ones(n), size=64).astype(np.float32) for n in (64, 32))
    model = Chain(moves=torch.tensor(moves), signs=torch.tensor(signs))
    seen = model.simulate(STEPS, batch=SERIES, seed=1)["sign"]
    engine = Exact(model)
    outcomes = jnp.asarray(seen.numpy().astype(np.int32))
    rows, logs = jnp.asarray(moves), jnp.log(jnp.asarray(signs)).T
    compiled = jax.jit(jax.vmap(lambda series: hmm_filter(rows[0], rows, logs[series])))

    def wide(table: np.ndarray) -> list:
        return [jnp.broadcast_to(jnp.asarray(table), (SERIES, *table.shape))]

    agent = Agent(A=wide(signs.T), B=wide(moves.T[..., None]), D=wide(moves[0]), batch_size=SERIES, num_iter=1)
    infer = equinox.filter_jit(lambda agent, sign, prior: agent.infer_states([sign], empirical_prior=prior))
    predict = equinox.filter_jit(lambda agent, action, beliefs: agent.update_empirical_prior(action, beliefs))
    still = jnp.zeros((SERIES, 1), int)

    def pymdp() -> list:
        prior, found = agent.D, []
        for t in range(STEPS):
            beliefs = infer(agent, outcomes[:, t, None], prior)
            prior = predict(agent, still, beliefs)
            found.append(beliefs[0])
        return jax.block_until_ready(found)

    def ours() -> Any:
        return engine.filter(None, seen, batch=SERIES)

    def read() -> Any:
        return [belief.log_probs for belief in engine.filter(None, seen, batch=SERIES)]

    def dynamax() -> Any:
        return jax.block_until_ready(compiled(outcomes))

    beliefs, theirs = ours(), dynamax()
    probs = np.stack([belief.marginal("place").probs.numpy() for belief in beliefs], 1)
    others = np.stack([np.asarray(q)[:, -1] for q in pymdp()], 1)
    one, all_logs, other, peer = _times(ours, read, dynamax, pymdp, repeats=9)
    return {
        "finite_ms": one,
        "finite_all_logs_ms": all_logs,
        "finite_dynamax_ms": other,
        "finite_pymdp_ms": peer,
        "finite_vs_dynamax": other / one,
        "finite_vs_pymdp": peer / one,
        "difference.finite_dynamax": _largest(probs - np.asarray(theirs.filtered_probs)),
        "difference.finite_dynamax_nats": _largest(beliefs[-1].log_evidence - np.asarray(theirs.marginal_loglik)),
        "difference.finite_pymdp": _largest(probs - others),
    }


# Stochastic volatility: a level that is only seen in how far things stray.


class Volatility(Model):
    """The log of a variance wanders about a mean."""

    mean: float = -1.0
    stay: float = 0.95
    push: float = 0.3

    @state
    def level(self, prev_level=-1.0):
        return Normal(self.mean + self.stay * (prev_level - self.mean), self.push)

    @observation
    def change(self, level):
        return Normal(0.0, (0.5 * level).exp())


def _particles() -> dict[str, float]:
    import particles
    from particles import distributions, state_space_models

    class Peer(state_space_models.StateSpaceModel):
        default_params = {"mean": -1.0, "stay": 0.95, "push": 0.3}

        def PX0(self):
            return distributions.Normal(self.mean, self.push)

        def PX(self, t, xp):
            return distributions.Normal(self.mean + self.stay * (xp - self.mean), self.push)

        def PY(self, t, xp, x):
            return distributions.Normal(0.0, np.exp(0.5 * x))

    model = Volatility()
    changes = model.simulate(STEPS, seed=1)["change"]
    data = changes.double().numpy()
    engines = [Particles(model, particles=PARTICLES, guided=False, seed=seed) for seed in range(20)]

    def peer() -> float:
        boot = state_space_models.Bootstrap(ssm=Peer(), data=data)
        run = particles.SMC(fk=boot, N=PARTICLES, resampling="systematic", ESSrmin=0.5, collect="off")
        run.run()
        return float(run.logLt)

    def ours() -> Any:
        return engines[0].filter(None, changes)

    found = [float(engine.filter(None, changes)[-1].log_evidence) for engine in engines]
    np.random.seed(1)
    theirs = [peer() for _ in engines]
    error = ((statistics.variance(found) + statistics.variance(theirs)) / len(engines)) ** 0.5
    one, other = _times(ours, peer, repeats=20)
    return {
        "particles_ms": one,
        "particles_particles_ms": other,
        "particles_vs_particles": other / one,
        "particles_deviation_nats": statistics.stdev(found),
        "particles_particles_deviation_nats": statistics.stdev(theirs),
        "difference.particles_nats": statistics.fmean(found) - statistics.fmean(theirs),
        "difference.particles_errors": (statistics.fmean(found) - statistics.fmean(theirs)) / error,
    }


def _times(*functions: Callable[[], object], repeats: int) -> list[float]:
    return milliseconds(*functions, repeats=repeats, rest=REST)


def _largest(values: Any) -> float:
    return float(np.abs(np.asarray(values)).max())
