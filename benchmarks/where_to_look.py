"""Searching: beliefs about 121 places, beside pymdp's and pomdp-py's on the same models, and what a choice costs.

Peers (install them: make bench) are used as their own documentation does, and given every shortcut that the model
allows: pymdp is told where the eye looks (its tensors are those of that fixation alone), and pomdp-py only reads one
element of a glimpse, and not 121. pomdp-py's own ``update_particles_belief`` keeps particles whose drawn observation
equals the real one, which never happens here: its particles are weighted instead, as its ``WeightedParticles`` are for.
"""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import numpy as np
import torch
from pyro.distributions import Bernoulli

from apmodels import Grid, Planted, VisualSearch, observation
from benchmarks.timing import milliseconds
from controllers import ConvolutionalPolicy, PercentCorrect, PolicyGradient
from inference import Exact
from inference.tables.best_guess import best

BATCH, MANY, LARGE = 1000, 10_000, 101
PYMDP = 100
# Particles of pomdp-py; the error of each number is measured.
PARTICLES = (1000, 10_000)
STEPS = 8
# Against so many points, and so many draws, the expectation of PercentCorrect is checked.
POINTS, DRAWS = 8192, 20_000


def measure() -> dict[str, float]:
    return _updates() | _pymdp() | _pomdp_py() | _percent_correct() | _large()


def _glimpses(model: Any, batch: int, seed: int, target: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Fixations (batch,), and what is seen from them, (batch, cells): of one target, or of a target each."""
    torch.manual_seed(seed)
    looks, targets = torch.randint(model.grid.size, (2, batch))
    return looks, model.glimpse(targets if target is None else torch.full_like(targets, target), looks).sample()


def _updates() -> dict[str, float]:
    """As many beliefs as one has room for, and one."""
    engine = Exact(VisualSearch()).prepare()
    figures = {}
    for batch in (1, BATCH, MANY):
        looks, seen = _glimpses(engine.model, batch, 1)
        start = engine.start(batch)
        (took,) = milliseconds(lambda s=start, a=looks, y=seen: engine.update(s, a, y), repeats=40)
        figures[f"updates_per_second.{batch}"] = batch / took * 1e3
    return {"updates_per_second": max(figures.values())} | figures


class FlashSearch(VisualSearch):
    """Every place flashes or does not; the target's does more often, the nearer it is to the fixation."""

    @observation
    def glimpse(self, target, fixation):
        signal = self.acuity(self.grid.distance(target, fixation))
        chance, usual = torch.special.ndtr(signal - 1), torch.special.ndtr(torch.tensor(-1.0))
        return Planted(target, Bernoulli(chance), Bernoulli(usual.expand(self.grid.size)))


def _pymdp() -> dict[str, float]:
    """A modality a place, all of one hidden factor; exact for pymdp too."""
    import equinox
    import jax
    import jax.numpy as jnp
    from pymdp.agent import Agent

    model = FlashSearch()
    cells = model.grid.size
    engine = Exact(model).prepare()
    looks, seen = _glimpses(model, PYMDP, 2)
    many_looks, many_seen = looks.repeat(BATCH // PYMDP), seen.repeat(BATCH // PYMDP, 1)
    start = engine.start(BATCH)
    here = torch.special.ndtr(model.acuity(model.grid.distance(model.grid.values(), looks[:, None])) - 1).numpy()
    tables = []
    for place in range(cells):
        chance = np.full((PYMDP, cells), float(torch.special.ndtr(torch.tensor(-1.0))), np.float32)
        chance[:, place] = here[:, place]
        tables.append(jnp.asarray(np.stack([1 - chance, chance], 1)))
    still = [jnp.broadcast_to(jnp.eye(cells)[..., None], (PYMDP, cells, cells, 1))]
    prior = [jnp.full((PYMDP, cells), 1 / cells)]
    agent = Agent(A=tables, B=still, D=prior, batch_size=PYMDP, num_iter=1)
    outcomes = [jnp.asarray(seen[:, place].numpy().astype(np.int32))[:, None] for place in range(cells)]
    infer = equinox.filter_jit(lambda agent, outcomes, prior: agent.infer_states(outcomes, empirical_prior=prior))
    infer_exactly = lambda: jax.block_until_ready(infer(agent, outcomes, prior))  # noqa: E731
    theirs = np.asarray(infer_exactly()[0])[:, -1]
    probs = engine.update(start, many_looks, many_seen).marginal("target").probs[:PYMDP].numpy()
    ours, peer = milliseconds(lambda: engine.update(start, many_looks, many_seen), infer_exactly, repeats=10, inner=20)
    return {
        "flashes_per_second": BATCH / ours * 1e3,
        "pymdp_per_second": PYMDP / peer * 1e3,
        "updates_vs_pymdp": (peer / PYMDP) / (ours / BATCH),
        "difference.pymdp": float(np.abs(probs - theirs).max()),
    }


def _pomdp_py() -> dict[str, float]:
    """Searches of some steps, by particles and by pomdp-py's own exact belief."""
    import pomdp_py

    class Place(pomdp_py.SimpleState):
        """A target's place."""

    class Seen(pomdp_py.ObservationModel):
        """The ratio of likelihoods with and without the target: all that a belief needs."""

        def __init__(self, distance: list[list[float]]):
            self.distance = distance

        def probability(self, observation: Any, next_state: Any, action: Any) -> float:
            d = self.distance[action][next_state.data]
            return math.exp(d * (observation[next_state.data] - d / 2))

    model = VisualSearch()
    engine, grid = Exact(model).prepare(), model.grid
    looks, seen = _glimpses(model, STEPS, 3, target=60)
    belief = engine.start()
    for look, glimpse in zip(looks, seen, strict=True):
        belief = engine.update(belief, look, glimpse)
    exact = belief.marginal("target").probs.numpy()
    cells = grid.values()
    eye = Seen(model.acuity(grid.distance(cells, cells[:, None])).tolist())
    record = list(zip(looks.tolist(), seen.tolist(), strict=True))
    places = [Place(i) for i in range(grid.size)]

    def particles(count: int, seed: int = 0) -> Any:
        drawn = np.random.default_rng(seed).integers(grid.size, size=count).tolist()
        found = pomdp_py.WeightedParticles([(places[i], 1.0) for i in drawn])
        for look, glimpse in record:
            weighed = [(s, w * eye.probability(glimpse, s, look)) for s, w in found.particles]
            found = pomdp_py.WeightedParticles(weighed)
        return found.particles

    def histogram() -> Any:
        found = pomdp_py.Histogram({place: 1 / grid.size for place in places})
        for look, glimpse in record:
            found = pomdp_py.update_histogram_belief(found, look, glimpse, eye, None, static_transition=True)
        return found

    def error(count: int) -> float:
        """Total variation from the exact belief, in the mean."""
        apart = []
        for seed in range(10):
            states, weights = zip(*particles(count, seed), strict=True)
            probs = np.bincount([s.data for s in states], weights, grid.size)
            apart.append(float(np.abs(probs / probs.sum() - exact).sum()) / 2)
        return statistics.fmean(apart)

    many_looks, many_seen = _glimpses(model, BATCH, 4)
    start = engine.start(BATCH)
    single = engine.start()
    ours, one, table, *swarms = milliseconds(
        lambda: engine.update(start, many_looks, many_seen),
        lambda: engine.update(single, looks[0], seen[0]),
        histogram,
        *(lambda count=count: particles(count) for count in PARTICLES),
    )
    ours /= BATCH
    figures = {"pomdp_py_histogram_per_second": STEPS / table * 1e3, "updates_vs_histogram": table / STEPS / ours}
    for count, swarm in zip(PARTICLES, swarms, strict=True):
        figures |= {
            f"pomdp_py_per_second.{count}": STEPS / swarm * 1e3,
            f"updates_vs_pomdp_py.{count}": swarm / STEPS / ours,
            f"single_vs_pomdp_py.{count}": swarm / STEPS / one,
            f"pomdp_py_error.{count}": error(count),
        }
    theirs = histogram()
    difference = float(np.abs(np.array([theirs[place] for place in places]) - exact).max())
    # The particles that are the more exact are still less so than ours.
    return (
        {"updates_vs_pomdp_py": figures[f"updates_vs_pomdp_py.{PARTICLES[-1]}"]}
        | figures
        | {"difference.pomdp_py_histogram": difference}
    )


def _percent_correct() -> dict[str, float]:
    """What a choice costs, and how wrong the expectation is that it is made by, along some searches."""
    engine = Exact(VisualSearch(grid=Grid(7, 7))).prepare()
    figures, beliefs = {}, [engine.start()]
    looks, seen = _glimpses(engine.model, STEPS, 5, target=24)
    for look, glimpse in zip(looks, seen, strict=True):
        beliefs.append(engine.update(beliefs[-1], look, glimpse))
    true = [engine.best_guess(belief, samples=POINTS) for belief in beliefs]
    for points in (32, 64):
        controller = PercentCorrect(engine, samples=points)
        found = [engine.best_guess(belief, samples=points) for belief in beliefs]
        wrong = [float(((a - b) / b).abs().max()) for a, b in zip(found, true, strict=True)]
        (figures[f"percent_correct_ms.{points}"],) = milliseconds(lambda c=controller: c.act(beliefs[2]), inner=5)
        figures[f"percent_correct_error.{points}"] = max(wrong)
    drawn = float(engine.expect(beliefs[2], best, torch.tensor([24]), samples=DRAWS, seed=1)[0])
    figures["percent_correct_error.drawn"] = abs(drawn / float(true[2][24]) - 1)
    return {"percent_correct_ms": figures["percent_correct_ms.64"]} | figures


def _large() -> dict[str, float]:
    """A grid of 10,201 places: beliefs by what is seen of each, a policy by FFT."""
    engine = Exact(VisualSearch(grid=Grid(LARGE, LARGE)))
    begin = time.perf_counter()
    engine.prepare()
    prepared = time.perf_counter() - begin
    looks, seen = _glimpses(engine.model, 100, 6)
    policy = ConvolutionalPolicy(engine.model.grid)
    learner = PolicyGradient(engine, policy, steps=10, batch=100)
    start = engine.start(100)
    update, learn = milliseconds(lambda: engine.update(start, looks, seen), lambda: learner.learn(1), repeats=5)
    return {
        "prepare_seconds.101x101": prepared,
        "updates_per_second.101x101": 100 / update * 1e3,
        "learning_steps_per_second.101x101": 1000 / learn * 1e3,
    }
