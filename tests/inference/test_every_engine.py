"""Random small models, finite or affine or both: every engine that bids, against enumeration or the joint Gaussian."""

import warnings

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from apmodels.simulation import as_given
from inference import DepletionWarning, RaoBlackwell, Variational
from inference.brute_force.reference import reference
from inference.check import error_of, simulated
from inference.choose import ENGINES, bids
from inference.rao_blackwell import effective
from tests.inference.affine_models import affine_models
from tests.inference.test_exact_random import models

OPTIONS = {
    "Particles": {"particles": 3_000, "dtype": torch.float64},
    "RaoBlackwell": {"particles": 1_000, "dtype": torch.float64},
    "Variational": {"iterations": 200, "draws": 4_000, "dtype": torch.float64},
}
# The same models every time: five standard errors are exceeded once in many thousand comparisons.
few = {"derandomize": True, "deadline": None, "suppress_health_check": list(HealthCheck), "phases": [Phase.generate]}


def hold(model, seed, only):
    """Compare beliefs after three steps with brute force, as closely as each engine allows."""
    actions, seen = simulated(model, 3, seed)
    names = [node.name for node in model.structure.hidden if node.random]
    truth = reference(model, actions, seen, names)
    assert not truth.evidence_error, "brute force must be exact here"
    for name, bid in bids(model).items():
        if not bid or name not in only:
            continue
        kind = next(engine for engine in ENGINES if engine.__name__ == name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DepletionWarning)
            engine = kind(model, **OPTIONS.get(name, {"dtype": torch.float64}))
            beliefs = list(engine.filter(as_given(actions), as_given(seen)))
        allowed = tolerance(engine, beliefs)
        if allowed > 0.5:
            # So few particles carry the weight that nothing can be said; the engine has said so.
            continue
        assert float(beliefs[-1].log_evidence) == pytest.approx(truth.log_evidence, abs=allowed), name
        for variable in names:
            assert error_of(beliefs[-1], variable, truth)[0] < allowed, (name, variable)


def tolerance(engine, beliefs):
    """Five standard errors, by the effective number of draws in each step; rounding where nothing is drawn."""
    if isinstance(engine, Variational):
        nodes = engine.structure.nodes
        if any(nodes[a.parent].values is not None is nodes[a.child].values for a in engine.structure.arrows):
            # There may be several peaks, of which one Gaussian finds one, and does not know of the others.
            return torch.inf
        return 0.02 + 5 / float(effective(engine.posterior(beliefs[-1]).log_weights)) ** 0.5
    if not isinstance(engine, RaoBlackwell) or not engine.plan.worlds:
        return 1e-6
    return 5 * sum(1 / float(effective(belief.log_weights)) for belief in beliefs) ** 0.5


@settings(max_examples=10, **few)
@given(models(), st.integers(0, 1000))
def test_any_finite_model(model, seed):
    hold(model, seed, {"Exact", "RaoBlackwell", "Particles", "Variational"})


@settings(max_examples=12, **few)
@given(affine_models(), st.integers(0, 1000))
def test_any_affine_model(model, seed):
    hold(model, seed, {"Kalman", "RaoBlackwell", "Particles"})


@pytest.mark.slow
@settings(max_examples=60, **few)
@given(st.one_of(affine_models(), models()), st.integers(0, 1000))
def test_any_small_model_under_every_engine(model, seed):
    hold(model, seed, {engine.__name__ for engine in ENGINES})
