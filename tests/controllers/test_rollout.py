"""The loop, and the data set that it leaves."""

import numpy as np
import pytest
import torch
import xarray as xr

from apmodels import Calibrated, Grid, VisualSearch
from controllers import Constant, Controller, GreedyInfomax, Random, rollout
from hardware import Simulated
from inference import Exact
from tests.models import Caller, Coin, Coupled, Door, Drift, Lamp, Twins


def made(model, batch=None, steps=4, seed=1, controller=Random, **options):
    engine = Exact(model, torch.float64)
    return rollout(Simulated(model, batch), engine, controller(engine), steps, seed, **options), engine


@pytest.mark.parametrize("batch", [None, 1, 5])
def test_every_variable_has_its_dimensions(batch):
    data, _ = made(VisualSearch(grid=Grid(2, 3)), batch)
    rows = batch or 1
    assert data.sizes["episode"] == rows and data.sizes["time"] == 4
    assert data.fixation.dims == data.entropy.dims == data.log_evidence.dims == ("episode", "time")
    assert data.truth_target.dims == ("episode", "time")
    assert data.glimpse.dims == ("episode", "time", "glimpse_value") and data.glimpse.shape == (rows, 4, 6)
    assert data.marginal.shape == (rows, 4, 6)
    assert data.time.values.tolist() == [1, 2, 3, 4]
    for part in ("act", "body", "update"):
        assert data[f"{part}_seconds"].dims == ("time",) and bool((data[f"{part}_seconds"] >= 0).all())


@pytest.mark.parametrize(
    "model", [Door(), Coupled(), Caller(), Drift(), Lamp(), Coin(), Twins()], ids=lambda m: type(m).__name__
)
def test_the_engine_says_the_same_of_the_recorded_actions_and_observations(model):
    data, engine = made(model, batch=3)
    acts = {name: torch.as_tensor(data[name].values) for name in model.action_names}
    seen = {name: torch.as_tensor(data[name].values) for name in model.observation_names}
    beliefs = engine.filter(acts or None, seen, batch=3)
    for t, belief in enumerate(beliefs):
        now = data.isel(time=t)
        assert np.allclose(now.entropy, belief.entropy()) and np.allclose(now.log_evidence, belief.log_evidence)
        # An interest that is a function of variables is kept as such.
        names = ("interest",) if model.declaration.interest else engine.structure.interest
        several = len(names) > 1
        for name in names:
            found = now[f"marginal_{name}"] if several else now.marginal
            assert np.allclose(found, belief.marginal(name).probs)


def test_seeds_repeat_everything_but_the_time_it_took():
    first, again, other = (made(Coupled(), batch=6, seed=s)[0] for s in (1, 1, 2))
    seconds = [name for name in first if str(name).endswith("_seconds")]
    assert len(seconds) == 3
    xr.testing.assert_identical(first.drop_vars(seconds), again.drop_vars(seconds))
    assert not first.sound.equals(other.sound)


def test_a_seed_starts_the_body_and_the_controller_again():
    model = VisualSearch(grid=Grid(3, 3))
    engine, body = Exact(model), Simulated(model, 20)
    controller = GreedyInfomax(engine, samples=4)
    first, again = (rollout(body, engine, controller, 3, seed=4) for _ in range(2))
    assert first.glimpse.equals(again.glimpse) and first.fixation.equals(again.fixation)


def test_the_truth_of_a_static_is_constant_and_that_of_a_state_moves():
    data, _ = made(Coupled(), batch=20, steps=6)
    assert bool((data.truth_kind == data.truth_kind.isel(time=0)).all())
    assert bool((data.truth_near != data.truth_near.isel(time=0)).any())
    assert data.truth_kind.values.std() > 0


def test_it_stops_when_all_episodes_are_done():
    model = VisualSearch(grid=Grid(3, 3), acuity=Calibrated(peak=4.0))
    engine, body = Exact(model), Simulated(model, 8)
    data = rollout(body, engine, GreedyInfomax(engine, samples=8), 50, 0, until=lambda b, _: b.entropy() < 0.3)
    done = data.entropy.values < 0.3
    assert data.sizes["time"] < 50 and done[:, -1].all() and not done[:, :-1].all(0).any()
    once = rollout(body, engine, Constant(engine, 4), 50, 0, until=lambda belief, action: True)
    assert once.sizes["time"] == 1


def test_until_sees_the_action_that_led_to_the_belief():
    data, _ = made(Lamp(), seed=0, steps=40, until=lambda belief, action: action == 3)
    assert data.look.values[0, -1] == 3 and not (data.look.values[0, :-1] == 3).any()


def test_it_can_be_kept(tmp_path):
    data, _ = made(Coupled(), batch=2)
    data.to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as kept:
        xr.testing.assert_equal(kept.load(), data)
        assert kept.attrs["interest"] == "near, kind" and "Coupled" in kept.attrs["model"]


def test_an_agent_may_be_wrong_about_its_world():
    wrong = VisualSearch(grid=Grid(3, 3), acuity=Calibrated(peak=3.0))
    right = wrong.replace(acuity=Calibrated(peak=0.5))
    runs = []
    for model in (wrong, right):
        engine = Exact(model)
        runs.append(rollout(Simulated(right, 200), engine, Constant(engine, 4), 6, seed=0))
    assert runs[0].glimpse.equals(runs[1].glimpse)
    # Who thinks its eyes are better than they are is surer, and explains what it sees less well.
    assert runs[0].entropy[:, -1].mean() < runs[1].entropy[:, -1].mean()
    assert runs[0].log_evidence[:, -1].mean() < runs[1].log_evidence[:, -1].mean()
    assert "0.5" not in runs[0].attrs["model"] and "0.5" in runs[1].attrs["model"]


def test_beliefs_are_calibrated_where_the_agent_is_right():
    data, _ = made(Lamp(), batch=4000, steps=5, seed=3)
    belief = data.marginal.isel(time=-1).values
    hit = np.take_along_axis(belief, data.truth_lit.isel(time=-1).values[:, None], 1).mean()
    assert hit == pytest.approx((belief**2).sum(1).mean(), abs=0.03)


def test_a_body_of_anybodys_own_will_do():
    class Dull:
        def reset(self, seed=None):
            self.steps = 0

        def step(self, action):
            self.steps += 1
            return torch.tensor(float(self.steps % 2))

    engine = Exact(Lamp())
    data = rollout(Dull(), engine, Constant(engine, 1), 3)
    assert data.flash.values.tolist() == [[1.0, 0.0, 1.0]]
    assert not [name for name in data if str(name).startswith("truth")]


def test_torchs_own_generator_is_left_alone():
    state = torch.get_rng_state()
    made(Coupled(), batch=2)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_controllers_one_action_may_go_for_the_whole_batch():
    class Still(Controller):
        def act(self, belief):
            return torch.tensor(2)

    data, _ = made(Lamp(), batch=3, controller=Still)
    assert data.look.shape == (3, 4) and bool((data.look == 2).all())
