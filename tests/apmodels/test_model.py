import itertools
import pickle
import xml.etree.ElementTree as ET
from dataclasses import field, replace

import numpy as np
import pytest
import torch
from pyro.distributions import Bernoulli, LogNormal, MultivariateNormal, Normal
from scipy import stats

from apmodels import (
    Calibrated,
    Contingency,
    CountModel,
    DetectorSearch,
    Evidence,
    Finite,
    Grid,
    Model,
    ValueOutOfRange,
    VisualSearch,
    action,
    laws,
    observation,
    ones,
    static,
)
from apmodels.simulation import seeded
from tests.models import LearningToLook, RandomWalk, Tracking, Weather

SMALL = Grid(3, 4)
COUNTS = CountModel(
    torch.tensor([[[1.0, 2.0, 5.0], [2.0, 2.0, 3.0]]]), torch.tensor([[[6.0, 2.0, 1.0], [4.0, 2.0, 3.0]]])
)
MODELS = [
    VisualSearch(grid=SMALL),
    DetectorSearch(grid=SMALL, counts=COUNTS),
    Contingency(presence=0.5),
    RandomWalk(),
    Tracking(),
    Weather(),
    LearningToLook(),
]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)


class Odd(Model):
    """Fields of every sort."""

    table: torch.Tensor = ones(2)
    array: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pair: tuple = (ones(2), 3)
    _scale: float = 1.0

    @static
    def cause(self):
        return Normal(0.0, 1.0)

    @observation
    def seen(self, cause):
        return Normal(cause, self._scale)


class Patch(Model):
    """What is scored, but not drawn."""

    @static
    def place(self):
        return Grid(1, 4).uniform()

    @observation
    def ratios(self, place):
        return Evidence(lambda ratios: ratios[place])


# Drawing


@every_model
@pytest.mark.parametrize("batch", [None, 1, 5])
def test_simulate_returns_every_variable_in_its_shape(model, batch):
    record = model.simulate(3, batch=batch, seed=0)
    assert list(record) == list(model.declaration.variables)
    lead = () if batch is None else (batch,)
    for name, node in model.structure.nodes.items():
        time = () if node.role == "static" else (3,)
        assert record[name].shape == (*lead, *time, *node.shape), name


@every_model
def test_a_seed_repeats_a_record_and_leaves_the_global_generator_alone(model):
    before = torch.random.get_rng_state()
    first, again, other = (model.simulate(3, batch=4, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_without_a_seed_the_global_generator_draws():
    with seeded(3):
        first = RandomWalk().simulate(2)["reading"]
        second = RandomWalk().simulate(2)["reading"]
    with seeded(3):
        assert torch.equal(RandomWalk().simulate(2)["reading"], first)
    assert not torch.equal(first, second)


def test_a_seed_is_put_back_after_an_error():
    before = torch.random.get_rng_state()
    with pytest.raises(ValueOutOfRange):
        RandomWalk(noise=-1.0).simulate(2, seed=0)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_worlds_of_a_batch_are_independent_and_follow_the_laws():
    record = RandomWalk(drift=2.0, noise=3.0).simulate(2, batch=20_000, seed=0)
    place, seen = record["position"], record["reading"]
    steps = torch.stack([place[:, 0], place[:, 1] - place[:, 0], seen[:, 0] - place[:, 0], seen[:, 1] - place[:, 1]])
    torch.testing.assert_close(torch.cov(steps), torch.diag(torch.tensor([4.0, 4.0, 9.0, 9.0])), atol=0.3, rtol=0)
    assert Contingency(presence=0.3).simulate(1, batch=20_000, seed=0)["responsive"].mean() == pytest.approx(
        0.3, abs=0.02
    )


def test_first_values_may_be_drawn():
    record = Tracking().simulate(1, actions=torch.zeros(1, 2), batch=5_000, seed=0)
    assert (record["place"][:, 0] - 0.9 * record["start"]).std() == pytest.approx(0.3, abs=0.02)


def test_a_deterministic_state_follows_the_actions():
    calls = torch.tensor([0, 1, 0, 0, 0, 0, 0, 1])
    for batch in (None, 3):
        timer = Contingency().simulate(8, actions=calls, batch=batch, seed=0)["timer"]
        assert timer.expand(1 if batch is None else 3, 8).tolist() == [[4, 0, 1, 2, 3, 4, 4, 0]] * (batch or 1)


def test_actions_given_by_name_one_or_a_batch():
    model = VisualSearch(grid=SMALL)
    one = torch.tensor([0, 11, 5])
    assert torch.equal(model.simulate(3, actions=one)["fixation"], one)
    assert torch.equal(model.simulate(3, actions={"fixation": one.tolist()})["fixation"], one)
    assert torch.equal(model.simulate(3, actions=one, batch=2)["fixation"], torch.stack([one, one]))
    both = torch.stack([one, one.flip(0)])
    assert torch.equal(model.simulate(3, actions=both, batch=2)["fixation"], both)


def test_actions_are_drawn_from_the_whole_space_where_none_are_given():
    drawn = VisualSearch(grid=SMALL).simulate(500, seed=0)["fixation"]
    assert drawn.unique().tolist() == list(range(12))


def test_several_actions_and_none():
    class Two(RandomWalk):
        left = action(SMALL)
        right = action(SMALL)

    model = Two()
    assert model.action_names == ["left", "right"] and model.space("right") == SMALL
    given = {"left": torch.zeros(2), "right": torch.ones(2)}
    assert model.simulate(2, actions=given)["right"].tolist() == [1, 1]
    for wrong, words in [
        (torch.zeros(2), "several actions"),
        ({"left": torch.zeros(2)}, "missing: .'right'"),
        ({**given, "up": torch.zeros(2)}, "unknown: .'up'"),
    ]:
        with pytest.raises(ValueOutOfRange, match=words):
            model.simulate(2, actions=wrong)
    with pytest.raises(ValueOutOfRange, match="no action"):
        RandomWalk().simulate(2, actions=torch.zeros(2))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ([0, 12, 0], "VisualSearch.fixation is 12, outside Grid"),
        ([0, -1, 0], "fixation is -1"),
        ([0.0, 0.5, 0.0], "fraction"),
        ([0.0, float("nan"), 0.0], "NaN"),
        ([0, 1], r"3 actions fixation.*\(2,\)"),
        (4, "3 actions fixation"),
        ({"fixatoin": [0, 1, 2]}, "unknown: .'fixatoin'"),
    ],
)
@pytest.mark.parametrize("batch", [None, 2])
def test_wrong_actions(wrong, words, batch):
    with pytest.raises(ValueOutOfRange, match=words):
        VisualSearch(grid=SMALL).simulate(3, actions=wrong, batch=batch)


@pytest.mark.parametrize(("shape", "batch"), [((5, 3), None), ((5, 3), 4), ((2, 5, 3), 5)])
def test_actions_for_another_batch(shape, batch):
    with pytest.raises(ValueOutOfRange, match="fixation"):
        VisualSearch(grid=SMALL).simulate(3, actions=torch.zeros(shape, dtype=torch.int64), batch=batch)


def test_one_record_of_actions_serves_a_batch():
    record = VisualSearch(grid=SMALL).simulate(3, actions=torch.zeros(1, 3), batch=4, seed=0)
    assert record["fixation"].shape == (4, 3)


def test_statics_given():
    model = VisualSearch(grid=SMALL, acuity=Calibrated(peak=100.0))
    looks = torch.tensor([5, 5])
    assert model.simulate(2, looks, given={"target": 5}, seed=0)["glimpse"].argmax(-1).tolist() == [5, 5]
    several = model.simulate(2, looks, batch=3, given={"target": torch.tensor([4, 5, 6])}, seed=0)
    assert several["target"].tolist() == [4, 5, 6]
    assert several["glimpse"].argmax(-1).tolist() == [[4, 4], [5, 5], [6, 6]]
    rates = torch.tensor([[0.0, 0.5, 1.0]])
    assert Contingency().simulate(4, torch.zeros(4), given={"rates": rates})["sound"].tolist() == [1.0] * 4


@pytest.mark.parametrize("given", [{"targt": 3}, {"target": 99}, {"target": torch.zeros(7, dtype=torch.int64)}])
def test_wrong_statics_given(given):
    with pytest.raises(ValueOutOfRange, match=r"targe?t"):
        VisualSearch(grid=SMALL).simulate(2, given=given, batch=3)


def test_an_array_given_to_one_record():
    drawn = Contingency().simulate(2, given={"rates": torch.tensor([0.1, 0.2, 0.3])}, seed=0)
    assert drawn["rates"].tolist() == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("batch", [None, 3])
def test_drawing_an_evidence_says_so(batch):
    with pytest.raises(Exception, match=r"Patch.ratios.*scored but not drawn"):
        Patch().simulate(2, batch=batch)


# Scoring


def agree(model, steps, oracle, batch=4, seed=0, spoil=None):
    record = model.simulate(steps, batch=batch, seed=seed)
    if spoil is not None:
        spoil(record)
    expected = [oracle({name: value[i].double().numpy() for name, value in record.items()}) for i in range(batch)]
    scores = model.log_prob(record)
    assert scores.shape == (batch,)
    np.testing.assert_allclose(scores.numpy(), expected, rtol=2e-5)
    # One record without a batch dimension scores as the same record among others.
    one = model.log_prob({name: value[1] for name, value in record.items()})
    assert one.shape == () and float(one) == pytest.approx(expected[1], rel=2e-5)


def scatter_nan(name, share=0.3):
    def spoil(record):
        with seeded(7):
            record[name][torch.rand(record[name].shape) < share] = torch.nan

    return spoil


def distance(model, cell, origin):
    columns = model.grid.columns
    return np.hypot(cell // columns - origin // columns, cell % columns - origin % columns)


@pytest.mark.parametrize("spoil", [None, scatter_nan("glimpse"), scatter_nan("glimpse", 1.1)])
def test_visual_search_against_numpy(spoil):
    model = VisualSearch(grid=SMALL, acuity=Calibrated(3.0, 2.0, 1.5))

    def oracle(record):
        total = -np.log(12)
        for fixation, glimpse in zip(record["fixation"], record["glimpse"], strict=True):
            mean = np.zeros(12)
            mean[int(record["target"])] = 3.0 * np.exp(-((distance(model, record["target"], fixation) / 2.0) ** 1.5))
            total += np.nansum(stats.norm.logpdf(glimpse, mean, 1.0))
        return total

    agree(model, 3, oracle, spoil=spoil)


@pytest.mark.parametrize("missing", [False, True])
def test_detector_search_against_numpy(missing):
    model = DetectorSearch(grid=SMALL, counts=COUNTS)
    present, absent = COUNTS.present.double().numpy(), COUNTS.absent.double().numpy()

    def oracle(record):
        total = -np.log(12)
        for fixation, glimpse in zip(record["fixation"], record["glimpse"], strict=True):
            for cell, count in enumerate(glimpse):
                weights = (present if cell == record["target"] else absent)[0, int(cell % 4 != fixation % 4)]
                total += 0.0 if np.isnan(count) else np.log(weights[int(count)] / weights.sum())
        return total

    def spoil(record):
        if missing:
            record["glimpse"] = record["glimpse"].float()
            scatter_nan("glimpse")(record)

    agree(model, 3, oracle, spoil=spoil)


@pytest.mark.parametrize("spoil", [None, scatter_nan("sound")])
def test_contingency_against_numpy(spoil):
    def oracle(record):
        responsive, rates = record["responsive"], record["rates"]
        total = stats.bernoulli.logpmf(responsive, 0.4) + stats.beta.logpdf(rates, 1, 1).sum()
        timer = 4
        for call, sound in zip(record["vocalize"], record["sound"], strict=True):
            timer = 0 if call else min(timer + 1, 4)
            source = 0 if timer == 0 else 1 if responsive and 1 <= timer <= 3 else 2
            total += 0.0 if np.isnan(sound) else np.log(rates[source] if sound else 1 - rates[source])
        return total

    agree(Contingency(presence=0.4), 12, oracle, batch=8, spoil=spoil)


@pytest.mark.parametrize("spoil", [None, scatter_nan("reading")])
def test_random_walk_against_scipy(spoil):
    def oracle(record):
        steps = np.diff(record["position"], prepend=0.0)
        seen = stats.norm.logpdf(record["reading"], record["position"], 0.7)
        return stats.norm.logpdf(steps, 0.0, 0.5).sum() + np.nansum(seen)

    agree(RandomWalk(noise=0.7), 6, oracle, spoil=spoil)


def test_tracking_against_scipy():
    def oracle(record):
        before = np.concatenate([record["start"][None], record["place"][:-1]])
        moved = stats.norm.logpdf(record["place"], 0.9 * before + record["push"], 0.3).sum()
        seen = stats.norm.logpdf(record["seen"], record["place"] @ Tracking.view.double().numpy().T, 0.5).sum()
        return stats.norm.logpdf(record["start"], 0.0, 2.0).sum() + moved + seen

    agree(Tracking(), 4, oracle)


def test_weather_against_scipy():
    def oracle(record):
        total = sum(stats.dirichlet.logpdf(row / row.sum(), [1, 1, 1]) for row in record["palette"])
        total += stats.gamma.logpdf(record["rate"], 2.0) + stats.poisson.logpmf(record["drops"], record["rate"]).sum()
        before = np.concatenate([[0], record["weather"][:-1]])
        total += stats.bernoulli.logpmf(record["weather"], np.where(before == 1, 0.8, 0.3)).sum()
        return total + np.log(record["palette"][record["weather"].astype(int), record["colour"].astype(int)]).sum()

    agree(Weather(), 5, oracle)


def test_deterministic_variables_may_be_left_out_and_random_ones_not():
    model = Contingency(presence=0.4)
    record = model.simulate(5, seed=0)
    score = model.log_prob(record)
    assert model.log_prob({name: value for name, value in record.items() if name != "timer"}) == score
    for name in ("responsive", "rates", "sound"):
        with pytest.raises(ValueOutOfRange, match=rf"\b{name}\b"):
            model.log_prob({key: value for key, value in record.items() if key != name})


@pytest.mark.parametrize(
    "change",
    [
        {"fixation": None},
        {"fixation": torch.full((3,), 99)},
        {"glimps": torch.zeros(3, 12)},
        {"glimpse": torch.zeros(3, 1)},
        {"glimpse": torch.zeros(2, 12)},
        {"glimpse": torch.zeros(6, 12)},
        {"glimpse": torch.full((3, 12), torch.inf)},
        {"target": torch.tensor(99)},
    ],
    ids=lambda change: str({name: value if value is None else tuple(value.shape) for name, value in change.items()}),
)
def test_a_wrong_record(change):
    model = VisualSearch(grid=SMALL)
    record = {**model.simulate(3, seed=0), **change}
    with pytest.raises(ValueOutOfRange, match=next(iter(change))):
        model.log_prob({name: value for name, value in record.items() if value is not None})


def test_only_observations_may_be_missing():
    record = RandomWalk().simulate(3, seed=0)
    record["position"][1] = torch.nan
    with pytest.raises(ValueOutOfRange, match="position is NaN"):
        RandomWalk().log_prob(record)


class Joint(RandomWalk):
    @observation
    def reading(self, position):
        return MultivariateNormal(position * ones(2), torch.eye(2))


def test_a_missing_vector_of_a_joint_law():
    record = Joint().simulate(2, seed=0)
    record["reading"][1] = torch.nan
    assert torch.isfinite(Joint().log_prob(record))


class Waiting(Model):
    slow: torch.Tensor = torch.tensor(2.0)

    @static
    def fast(self):
        return Bernoulli(0.5)

    @observation
    def wait(self, fast):
        return LogNormal(self.slow - fast, 1.0)


def test_what_is_missing_leaves_the_gradient_alone():
    slow = torch.tensor(2.0, requires_grad=True)
    model = Waiting(slow=slow)
    model.log_prob({"fast": torch.tensor(1.0), "wait": torch.tensor([0.5, torch.nan])}).backward()
    assert torch.isfinite(slow.grad)


def test_an_evidence_is_scored():
    ratios = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0]])
    score = Patch().log_prob({"place": torch.tensor(1), "ratios": ratios})
    assert float(score) == pytest.approx(3.0 - np.log(4))


# A model as a value


@every_model
def test_models_pickle_compare_and_print(model):
    model.structure  # noqa: B018  (what was read is no part of the value)
    copy = pickle.loads(pickle.dumps(model))
    assert copy == model and hash(copy) == hash(model) and repr(copy) == repr(model)
    assert torch.equal(copy.log_prob(model.simulate(2, seed=1)), model.log_prob(model.simulate(2, seed=1)))


def test_models_of_other_values_or_classes_differ():
    assert RandomWalk(drift=2.0) != RandomWalk()
    assert RandomWalk() != Joint()
    assert DetectorSearch(grid=SMALL) != DetectorSearch(grid=SMALL, counts=COUNTS)
    assert len({RandomWalk(), RandomWalk(), Joint()}) == 2
    assert repr(RandomWalk(drift=2.0)) == "RandomWalk(drift=2.0, noise=1.0)"


@pytest.mark.parametrize("name", ["table", "array", "pair"])
def test_fields_that_are_arrays_compare(name):
    value = getattr(Odd(), name)
    same, other = ((ones(2), 3), (torch.zeros(2), 3)) if name == "pair" else (value * 1, value + 1)
    assert Odd(**{name: same}) == Odd()
    assert Odd(**{name: other}) != Odd()


def test_private_fields_pickle():
    assert pickle.loads(pickle.dumps(Odd(_scale=3.0)))._scale == 3.0


def test_replace_and_its_misspellings():
    model = RandomWalk(drift=2.0)
    assert model.replace(noise=3.0) == RandomWalk(drift=2.0, noise=3.0) == replace(model, noise=3.0)
    assert model == RandomWalk(drift=2.0)
    with pytest.raises(ValueOutOfRange, match=r"RandomWalk has no parameter driftt \(nearest: drift\)"):
        model.replace(driftt=1.0)
    with pytest.raises(ValueOutOfRange, match=r"no parameter zzz \(there are: drift, noise\)"):
        model.replace(zzz=1.0)


def test_what_was_read_from_a_model_is_read_anew_for_another_value():
    model = VisualSearch(grid=SMALL)
    assert model.structure is model.structure
    assert len(model.structure.nodes["target"].values) == 12
    assert len(model.replace(grid=Grid(2, 2)).structure.nodes["target"].values) == 4


def test_parameters_are_given_by_name():
    with pytest.raises(ValueOutOfRange, match="by name: drift, noise"):
        RandomWalk(1.0)


# Showing itself


def texts(svg):
    return {element.text for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")}


@every_model
def test_the_drawing_is_xml_and_shows_every_variable_and_arrow(model):
    svg = model._repr_html_()
    assert set(model.structure.nodes) <= texts(svg)
    titles = [element.text for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}title")]
    assert titles[0] == type(model).__name__
    for arrow in model.structure.arrows:
        assert f"{arrow.kind}: {arrow.why}" in titles


def test_the_drawing_is_xml_whatever_the_names():
    class Shop(RandomWalk):
        choose = action(Finite(2, ('<cheap> & "good"', "]]>")))

    assert any("<cheap> & " in (element.text or "") for element in ET.fromstring(Shop()._repr_html_()).iter())


@every_model
def test_no_two_variables_stand_in_one_place(model):
    svg = ET.fromstring(model._repr_html_())
    names = [e for e in svg.iter("{http://www.w3.org/2000/svg}text") if e.get("font-size") not in ("9", "10")]
    places = [(float(e.get("x")), float(e.get("y"))) for e in names]
    for (x0, y0), (x1, y1) in itertools.combinations(places, 2):
        assert np.hypot(x1 - x0, y1 - y0) >= 60, type(model).__name__
    width, height = float(svg.get("width")), float(svg.get("height"))
    assert all(30 <= x <= width - 30 and 20 <= y <= height - 30 for x, y in places)


@every_model
def test_the_explanation_names_every_variable_and_arrow(model):
    lines = [line.split() for line in str(model.explain()).splitlines()]
    for node in model.structure.nodes.values():
        assert any(line[:2] == [node.name, node.role] and node.plan in line for line in lines), node
    for arrow in model.structure.arrows:
        parent = [arrow.parent, "(a", "step", "ago)"] if arrow.lag else [arrow.parent]
        assert any(line[: len(parent) + 3] == [*parent, "→", arrow.child, arrow.kind] for line in lines), arrow
    expected = {(p.name, p.lag, v.name) for v in model.declaration.variables.values() for p in v.parents}
    assert expected <= {(a.parent, a.lag, a.child) for a in model.structure.arrows}


def test_the_explanation_says_what_the_model_is_and_what_is_done():
    text = str(Weather().explain())
    assert text.splitlines()[:2] == [
        "Weather()",
        "  A hidden Markov chain with unknown tables: what is counted, and what is enumerated.",
    ]
    assert (
        "  enumerated: weather\n  integrated by counting: palette, rate\n  of interest: palette, rate, weather" in text
    )
    assert "known to the agent, by computing: timer" in str(Contingency().explain())
    assert "Joint(drift" in str(Joint().explain()).splitlines()[0]
    ET.fromstring(f"<div>{RandomWalk().explain()._repr_html_()}</div>")


class Nested(RandomWalk):
    # A table of a table: what holds floating-point tensors at any depth is cast once, and only once.
    rates: tuple = ((0.1, ones(2)), (0.3, ones(2)))


def test_tuples_of_tuples_are_fields():
    assert len(Nested().simulate(3, seed=0)["reading"]) == 3
    doubled = laws.cast(Nested(), torch.float64)
    assert doubled.rates[0][1].dtype == torch.float64 and doubled.rates[1][0] == 0.3
    assert laws.cast(doubled, torch.float64) is doubled
