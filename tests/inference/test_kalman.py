"""The Kalman filter against one conditioning of the joint Gaussian of a whole record."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pyro.distributions import Normal
from torch import Tensor

from apmodels import Box, Finite, Model, ValueOutOfRange, action, observation, shift, state, static, window
from apmodels.probing import Probe
from apmodels.simulation import as_given
from inference import Kalman, RaoBlackwell
from tests.inference.affine_models import affine_models, record_of
from tests.inference.joint_gaussian import JointGaussian
from tests.inference.oracle import plain
from tests.models import LearningToLook, RandomWalk


class Scenery(Model):
    """A field that begins unknown, is pushed about by an action, and is seen twice: a part, and another part."""

    motion = action(Box(-3.0, 3.0, (2,)))
    corner = action(Finite(3))

    @static
    def forgotten(self):
        return Normal(torch.arange(20.0).reshape(4, 5) / 10, 1.0).to_event(2)

    @state
    def scene(self, motion, prev_scene=forgotten):
        return Normal(shift(prev_scene, motion, fill=0.7), 0.3 + 0.1 * torch.arange(5.0).expand(4, 5)).to_event(2)

    @observation
    def image(self, scene, corner):
        return Normal(window(scene, torch.stack([corner, corner - 1]), (2, 3), fill=0.2), 0.4).to_event(2)

    @observation
    def other(self, scene):
        return Normal(window(scene, torch.tensor([1, 1]), (3, 3)), 0.5 + torch.arange(3.0).expand(3, 3)).to_event(2)

    interest = scene


class Map(Model):
    """A field that stays where it is, and is seen through a window that an action moves."""

    corner = action(Finite(3))
    scene = static(lambda self: Normal(torch.arange(12.0).reshape(3, 4), 1.0).to_event(2))

    @observation
    def image(self, scene, corner):
        return Normal(window(scene, torch.stack([corner, corner]), (2, 2)), 0.4).to_event(2)

    interest = scene


class Gaze(Model):
    """A field that stays where it is, of which a noisy copy is made at every step: no two images are enough."""

    motion = action(Box(-3.0, 3.0, (2,)))
    scene = static(lambda self: Normal(torch.arange(6.0).reshape(2, 3), 1.0).to_event(2))

    @state
    def copy(self, scene, motion):
        return Normal(shift(scene, motion), 0.5).to_event(2)

    @observation
    def image(self, copy):
        return Normal(window(copy, torch.zeros(2), (2, 2)), 0.4).to_event(2)

    interest = scene


class Pushed(Model):
    """The field of LearningToLook where it is known how the eye moves, and not known what is there."""

    motion = action(Box(-3.0, 3.0, (2,)))
    scene = LearningToLook.scene
    image = LearningToLook.image
    view = LearningToLook.view
    interest = scene


# Shrinking a random matrix tells little and takes long.
QUICK = settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])
EXACT = {"rtol": 1e-6, "atol": 1e-6}


def after(engine, actions, seen, batch=None):
    belief = engine.start(batch)
    for act, see in zip(actions, seen, strict=True):
        belief = engine.update(belief, as_given(act), as_given(see))
    return belief


def gaussians(model):
    return [n.name for n in model.structure.hidden if n.plan == "integrated"]


def moments(law):
    """Mean and covariance of a Gaussian, or of a mixture of them; of a scalar or an array only the diagonal."""
    mean, shape = law.mean, law.event_shape
    if hasattr(law, "covariance_matrix"):
        return mean.numpy(), law.covariance_matrix.numpy()
    if hasattr(law, "component_distribution") and len(shape) == 1:
        parts, weights = law.component_distribution, law.mixture_distribution.probs.numpy()
        off = (parts.mean - mean).numpy()
        return mean.numpy(), np.einsum(
            "k,kij->ij", weights, parts.covariance_matrix.numpy() + off[:, :, None] * off[:, None]
        )
    return mean.numpy().reshape(-1), law.variance.numpy().reshape(-1)


def assert_moments(law, expected):
    mean, spread = moments(law)
    np.testing.assert_allclose(mean, expected[0], **EXACT)
    np.testing.assert_allclose(spread, expected[1] if spread.ndim == 2 else np.diag(expected[1]), **EXACT)


def assert_probabilities(law, expected):
    for value, prob in zip(law.values, law.probs, strict=True):
        assert float(prob) == pytest.approx(expected.get(plain(value), 0.0), abs=1e-6)


def assert_agrees(engine, model, actions, seen, action):
    """Everything that a belief says, against the joint."""
    joint, belief = JointGaussian(model, actions, seen), after(engine, actions, seen)
    assert float(belief.log_evidence) == pytest.approx(joint.evidence(), abs=1e-6, rel=1e-6)
    for name in gaussians(model):
        if name != "forgotten":
            assert_moments(belief.marginal(name), joint.moments(name))
    for node in model.structure.planned("enumerated"):
        assert_probabilities(belief.marginal(node.name), joint.probabilities(node.name))
    laws, ahead = engine.forecast(belief, as_given(action)), joint.ahead(action)
    laws = laws if isinstance(laws, dict) else {model.observation_names[0]: laws}
    for name, law in laws.items():
        if model.structure.nodes[name].values is None:
            np.testing.assert_allclose(law.mean.numpy().reshape(-1), ahead.moments(name)[0], **EXACT)
            np.testing.assert_allclose(law.variance.numpy().reshape(-1), np.diag(ahead.moments(name)[1]), **EXACT)
        else:
            for value in model.structure.nodes[name].values:
                assert float(law.log_prob(value).exp()) == pytest.approx(ahead.chance(name, value), abs=1e-6)
    return joint, belief


@QUICK
@given(affine_models(), st.integers(0, 1000), st.sampled_from([0.0, 0.3]))
def test_any_affine_model_is_filtered_like_the_joint_gaussian(model, seed, lose):
    actions, seen = record_of(model, seed, lose)
    joint, belief = assert_agrees(Kalman(model, torch.float64), model, actions, seen, actions[0])
    interest = model.structure.interest
    if len(joint.paths) == 1:
        assert float(belief.entropy()) == pytest.approx(joint.entropy(interest), abs=1e-6)
    elif "kind" in model.structure.nodes and "mood" not in model.structure.nodes:
        assert float(belief.entropy(("kind", *interest))) == pytest.approx(joint.entropy(interest, ["kind"]), abs=1e-6)


def whole(record):
    """A list of dicts by name as a dict of tensors whose first dimension is time."""
    return as_given({name: torch.stack([step[name] for step in record]) for name in record[0]})


@settings(QUICK, max_examples=15)
@given(affine_models(), st.integers(0, 1000))
def test_any_affine_record_is_smoothed_like_the_joint_gaussian(model, seed):
    actions, seen = record_of(model, seed, 0.2)
    engine, joint = Kalman(model, torch.float64), JointGaussian(model, actions, seen)
    if engine.plan.finite:
        with pytest.raises(ValueOutOfRange, match="mood cannot be smoothed"):
            engine.smooth(whole(actions), whole(seen))
        return
    for step, belief in enumerate(engine.smooth(whole(actions), whole(seen)), 1):
        for name in gaussians(model):
            assert_moments(belief.marginal(name), joint.moments(name, step))
        if engine.plan.worlds:
            assert_probabilities(belief.marginal("kind"), joint.probabilities("kind"))


@settings(QUICK, max_examples=15)
@given(affine_models(), st.integers(0, 1000), st.sampled_from([0.0, 0.3]))
def test_beliefs_along_a_record_are_those_of_one_step_after_another(model, seed, lose):
    actions, seen = record_of(model, seed, lose)
    engine = Kalman(model, torch.float64)
    along = engine.filter(whole(actions), whole(seen))
    for step in (1, 2, 3):
        stepped = after(engine, actions[:step], seen[:step])
        assert float(along[step - 1].log_evidence) == pytest.approx(float(stepped.log_evidence), abs=1e-9)
        for name in [node.name for node in model.structure.hidden if node.random]:
            here, there = along[step - 1].marginal(name), stepped.marginal(name)
            np.testing.assert_allclose(here.mean, there.mean, atol=1e-9)


@settings(QUICK, max_examples=15)
@given(affine_models(finite=False), st.integers(0, 1000))
def test_particles_that_need_not_be_drawn_are_filtered_like_the_joint_gaussian(model, seed):
    actions, seen = record_of(model, seed, 0.2)
    engine = RaoBlackwell(model, dtype=torch.float64)
    joint, belief = assert_agrees(engine, model, actions, seen, actions[0])
    assert float(belief.entropy()) == pytest.approx(joint.entropy(model.structure.interest), abs=1e-6)
    assert belief.log_weights.shape == (1, 1)


@settings(QUICK, max_examples=15)
@given(affine_models(finite=False), st.integers(0, 1000), st.sampled_from([Kalman, RaoBlackwell]))
def test_the_gain_of_any_affine_model_is_half_the_log_ratio_of_determinants(model, seed, kind):
    actions, seen = record_of(model, seed, 0.2)
    engine = kind(model, dtype=torch.float64)
    belief = after(engine, actions[:2], seen[:2])
    joint = JointGaussian(model, actions[:2], seen[:2])
    compared = {name: torch.stack([act[name] for act in actions]) for name in actions[0]}
    gains = engine.gain(belief, as_given(compared))
    expected = [joint.gain(model.structure.interest, act) for act in (actions if compared else actions[:1])]
    np.testing.assert_allclose(gains.numpy(), expected, **EXACT)


@settings(QUICK, max_examples=10)
@given(affine_models(), st.integers(0, 1000))
def test_a_batch_of_different_actions_is_as_many_single_runs(model, seed):
    runs = [record_of(model, seed + i, 0.2) for i in range(3)]
    together = [
        [{n: torch.stack([run[k][t][n] for run in runs]) for n in runs[0][k][t]} for t in range(3)] for k in (0, 1)
    ]
    engine = Kalman(model, torch.float64)
    belief = after(engine, *together, batch=3)
    for i, run in enumerate(runs):
        single = after(engine, *run)
        assert float(belief.log_evidence[i]) == pytest.approx(float(single.log_evidence), abs=1e-9)
        assert float(belief.entropy("kind" if "kind" in single.values else None)[i]) == pytest.approx(
            float(single.entropy("kind" if "kind" in single.values else None)), abs=1e-9
        )
        for name in gaussians(model):
            here, there = belief.marginal(name), single.marginal(name)
            np.testing.assert_allclose(here.mean[i], there.mean, atol=1e-9)
            np.testing.assert_allclose(here.variance[i], there.variance, atol=1e-9)


@pytest.mark.parametrize("model", [Scenery(), Map(), Pushed()], ids=repr)
@pytest.mark.parametrize("kind", [Kalman, RaoBlackwell])
@pytest.mark.parametrize("lose", [0.0, 0.4])
def test_fields_that_are_pushed_about_are_filtered_like_the_joint_gaussian(model, kind, lose):
    actions, seen = record_of(model, 3, lose)
    engine = kind(model, dtype=torch.float64)
    assert engine.plan.fields and not engine.plan.gaussian
    joint, belief = assert_agrees(engine, model, actions, seen, actions[0])
    assert float(belief.entropy()) == pytest.approx(joint.entropy(["scene"]), abs=1e-6)
    assert float(engine.gain(belief, as_given({n: v[None] for n, v in actions[1].items()}))) == pytest.approx(
        joint.gain(["scene"], actions[1]), abs=1e-6
    )


def test_what_a_field_began_as_is_not_kept():
    belief = Kalman(Scenery()).start()
    assert belief.marginal("forgotten").mean.shape == (4, 5)
    record = Scenery().simulate(1, seed=0)
    seen = {name: record[name][0] for name in ("image", "other")}
    belief = belief.engine.update(belief, {"motion": record["motion"][0], "corner": 0}, seen)
    with pytest.raises(ValueOutOfRange, match="not kept after the first step"):
        belief.marginal("forgotten")


@pytest.mark.parametrize("kind", [Kalman, RaoBlackwell])
def test_images_that_depend_on_each_other_are_filtered_like_the_joint_gaussian(kind):
    model = Gaze()
    actions, seen = record_of(model, 5, 0.2)
    engine = kind(model, dtype=torch.float64)
    assert not engine.plan.fields
    joint, belief = assert_agrees(engine, model, actions, seen, actions[0])
    assert float(belief.entropy()) == pytest.approx(joint.entropy(["scene"]), abs=1e-6)


class Steered(RandomWalk):
    """An action that goes through a matrix, in whatever precision the matrix has."""

    gears: Tensor = torch.tensor([0.3, -0.7])
    push = action(Box(-1.0, 1.0, (2,)))

    @state
    def position(self, push, prev_position=0.0):
        return Normal(prev_position + self.gears @ push, self.drift)


def test_a_law_that_multiplies_an_action_is_probed_in_double_precision():
    assert Probe(Steered()).laws.dtype == torch.float64
