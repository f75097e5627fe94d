"""Policies: against plain loops, against hand-derived gradients, and through files."""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

import controllers
from apmodels import Grid, ValueOutOfRange, VisualSearch
from controllers import ConvolutionalPolicy, LogisticPolicy, PolicyGradient
from inference import Exact, Refusal
from tests.models import Caller, Coin, Dial, Twins

matplotlib.use("agg")
EVERY = ("belief", "squared", "flattened", "surprise", "even")


def beliefs(size, batch=4, seed=0):
    return torch.rand(batch, size, generator=torch.Generator().manual_seed(seed)).softmax(-1)


def looped(policy, probs):
    """Σ_f Σ_i K_f(|i - k|) φ_f(b)_i, cell by cell."""
    grid, weights = policy.grid, policy.weights.detach()
    known = {round(float(d), 5): r for r, d in enumerate(policy.distances)}
    features = policy.featured(probs)
    found = torch.zeros(len(probs), grid.size)
    for k in range(grid.size):
        for i in range(grid.size):
            ring = known.get(round(float(grid.distance(torch.tensor(i), torch.tensor(k))), 5))
            if ring is not None:
                found[:, k] += features[:, :, i] @ weights[:, ring]
    return found


@pytest.mark.parametrize(("side", "count"), [(7, 27), (11, 61)])
def test_as_many_weights_as_distances(side, count):
    assert ConvolutionalPolicy(Grid(side, side)).weights.shape == (1, count)
    assert LogisticPolicy(side**2, side**2).weights.numel() == side**4


@pytest.mark.parametrize("dense", [500, 0], ids=["matrix", "fft"])
@pytest.mark.parametrize("width", [None, 0, 1.5, 3, 50])
@pytest.mark.parametrize(("rows", "columns"), [(4, 6), (1, 5), (1, 1)])
def test_convolution_is_a_sum_over_cells(dense, width, rows, columns, monkeypatch):
    monkeypatch.setattr(ConvolutionalPolicy, "DENSE", dense)
    policy = ConvolutionalPolicy(Grid(rows, columns), width, EVERY, spread=1.0, seed=3)
    probs = beliefs(rows * columns)
    torch.testing.assert_close(policy(probs).detach(), looped(policy, probs), atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(policy(probs[0]), policy(probs)[0], atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("dense", [500, 0], ids=["matrix", "fft"])
@pytest.mark.parametrize("spacing", [0.5, 1, 1.7, 100.0])
@pytest.mark.parametrize("width", [None, 3])
def test_between_knots_kernels_are_straight_lines(dense, spacing, width, monkeypatch, tmp_path):
    monkeypatch.setattr(ConvolutionalPolicy, "DENSE", dense)
    few = ConvolutionalPolicy(Grid(4, 6), width, EVERY, spread=1.0, seed=3, spacing=spacing)
    assert few.weights.shape == (5, len(few.knots)) and float(few.knots[-1]) >= float(few.distances[-1])
    every = ConvolutionalPolicy(Grid(4, 6), width, EVERY)
    with torch.no_grad():
        for kernel, weights in zip(every.weights, few.weights.numpy(), strict=True):
            kernel.copy_(torch.tensor(np.interp(few.distances.numpy(), few.knots.numpy(), weights)))
    torch.testing.assert_close(few(beliefs(24)), every(beliefs(24)), atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(few.filters, every.filters)
    few.save(tmp_path / "few.npz")
    again = controllers.load(tmp_path / "few.npz")
    assert torch.equal(again(beliefs(24)), few(beliefs(24))) and again.spacing == spacing


def test_both_ways_to_convolve_have_the_same_gradient(monkeypatch):
    found = []
    for dense in (500, 0):
        monkeypatch.setattr(ConvolutionalPolicy, "DENSE", dense)
        policy = ConvolutionalPolicy(Grid(5, 4), 3, EVERY, spread=1.0)
        policy(beliefs(20)).log_softmax(-1)[:, 7].sum().backward()
        found.append(policy.weights.grad)
    torch.testing.assert_close(*found, atol=1e-4, rtol=1e-4)


def test_ten_thousand_places():
    policy = ConvolutionalPolicy(Grid(101, 101), width=4, spread=1.0)
    probs = torch.zeros(2, 10201)
    probs[0, 5100], probs[1, 0] = 1.0, 1.0
    logits = policy(probs).detach()
    grid, near = policy.grid, policy.weights.detach()[0]
    torch.testing.assert_close(logits[0, 5100 + 101], near[1], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(logits[1, 101 + 1], near[2], atol=1e-4, rtol=1e-4)
    assert float(logits[1, grid.cell(5, 0)].abs()) < 1e-4 and float(logits[1, -1].abs()) < 1e-4


def test_gradients_are_the_thesis_s_corrected():
    """Of p_k: b_i p_k (1 - p_k) for its own weights (eq. 5.34), -b_i p_k p_j for the others (eq. 5.35, (1 + C_j))."""
    policy = LogisticPolicy(6, 4, spread=2.0, seed=1).double()
    probs, k = beliefs(6, 1)[0].double(), 2
    policy(probs).softmax(-1)[k].backward()
    p = policy(probs).softmax(-1).detach()
    own = probs * p[k] * (1 - p[k])
    scores = (policy.weights.detach()[0] @ probs).exp()
    for j in range(4):
        # C_j of eq. 5.33: what is neither k's nor j's, over k's.
        rest = (scores.sum() - scores[k] - scores[j]) / scores[k]
        other = -probs * p[k] * (1 - (1 + rest) * p[k])
        torch.testing.assert_close(policy.weights.grad[0, j], own if j == k else other)
        if j != k:
            torch.testing.assert_close(other, -probs * p[k] * p[j])


def test_tied_weights_sum_the_free_gradients():
    """A tied weight's gradient is the sum of those that it ties (thesis section 5.5.3)."""
    grid = Grid(3, 4)
    tied = ConvolutionalPolicy(grid, spread=1.0)
    free = LogisticPolicy(12, 12)
    with torch.no_grad():
        free.weights.copy_(torch.stack([tied(row) for row in torch.eye(12)], 1)[None])
    assert torch.allclose(free.tied(grid).weights, tied.weights, atol=1e-6)
    probs = beliefs(12)
    for policy in (tied, free):
        policy(probs).log_softmax(-1)[:, 5].sum().backward()
    cells = grid.values()
    distance = grid.distance(cells[:, None], cells)
    for r, at in enumerate(tied.distances):
        torch.testing.assert_close(tied.weights.grad[0, r], free.weights.grad[0][(distance - at).abs() < 1e-4].sum())


def test_first_weights_are_flat_or_drawn():
    assert float(ConvolutionalPolicy(Grid(3, 3)).weights.detach().abs().max()) == 0
    one, same, other = (ConvolutionalPolicy(Grid(5, 5), spread=0.1, seed=s).weights.detach() for s in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other) and 0 < float(one.std()) < 0.3


@pytest.mark.parametrize("make", [lambda: LogisticPolicy(9, 9, EVERY, 1.0), lambda: ConvolutionalPolicy(Grid(3, 3), 2)])
def test_files_keep_policies(make, tmp_path):
    policy = make()
    policy.save(tmp_path / "policy")
    found = controllers.load(tmp_path / "policy")
    assert torch.equal(found(beliefs(9)), policy(beliefs(9))) and found.header() == policy.header()


def test_loading_runs_no_code_and_knows_its_own(tmp_path):
    np.savez(tmp_path / "evil.npz", header=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        controllers.load(tmp_path / "evil.npz")
    np.savez(tmp_path / "other.npz", header=np.array('{"policy": {"kind": "os.system"}}'), weights=np.zeros(1))
    with pytest.raises(ValueOutOfRange, match="holds no policy"):
        controllers.load(tmp_path / "other.npz")
    policy = ConvolutionalPolicy(Grid(3, 3))
    controllers.policy_files.keep(tmp_path / "bad", {"policy": policy.header()}, {"weights": np.zeros((1, 2))})
    with pytest.raises(ValueOutOfRange, match="its header describes"):
        controllers.load(tmp_path / "bad")


@pytest.mark.parametrize("features", [("belief",), ("belief", "flattened")])
def test_pictures(features):
    policy = ConvolutionalPolicy(Grid(3, 5), 2, features, spread=1.0)
    assert policy.filters.shape == (len(features), 5, 9)
    assert torch.equal(policy.filters[:, 2, 4], policy.weights.detach()[:, 0])
    assert torch.equal(policy.filters, policy.filters.flip(1, 2)) and float(policy.filters[0, 0, 0]) == 0
    for drawn in (policy.plot(), LogisticPolicy(3, 4, features).plot()):
        assert len(drawn.axes) >= len(features)
        plt.close(drawn)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ConvolutionalPolicy(Grid(3, 3), features=("beleif",)), "did you mean|belief"),
        (lambda: ConvolutionalPolicy(Grid(3, 3), features=()), "needs a feature"),
        (lambda: ConvolutionalPolicy(Grid(3, 3), width=-1), "wide"),
        (lambda: ConvolutionalPolicy(Grid(3, 3), spread=-1.0), "spread"),
        (lambda: ConvolutionalPolicy(Grid(3, 3), spacing=0), "apart"),
        (lambda: ConvolutionalPolicy(Grid(3, 3), spacing=float("nan")), "apart"),
        (lambda: LogisticPolicy(0, 2), "1 value"),
        (lambda: LogisticPolicy(4, 4).tied(Grid(3, 3)), "9 cells"),
    ],
)
def test_bad_policies(make, words):
    with pytest.raises(ValueOutOfRange, match=words):
        make()


@pytest.mark.parametrize(
    ("model", "policy", "words"),
    [
        (VisualSearch(grid=Grid(3, 3)), ConvolutionalPolicy(Grid(3, 4)), "fixation is of Grid"),
        (VisualSearch(grid=Grid(3, 3)), LogisticPolicy(8, 9), "8 values"),
        (Caller(), ConvolutionalPolicy(Grid(1, 2)), "is of Binary"),
        (Twins(), LogisticPolicy(2, 2), "one action"),
        (Coin(), LogisticPolicy(2, 2), "one action"),
        (Dial(), LogisticPolicy(2, 2), "finitely many actions|continuum"),
    ],
)
def test_policies_of_other_models(model, policy, words):
    with pytest.raises(Refusal, match=words):
        PolicyGradient(Exact(model), policy)
