import inspect

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.distributions import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    Dirichlet,
    Gamma,
    LogNormal,
    MultivariateNormal,
    Normal,
    OneHotCategorical,
    Poisson,
    StudentT,
    Uniform,
)

from apmodels import (
    Binary,
    Box,
    Contingency,
    Evidence,
    Finite,
    Grid,
    Model,
    VisualSearch,
    action,
    observation,
    ones,
    shift,
    state,
    static,
    where,
    window,
    zeros,
)
from apmodels.supports import support_of
from tests.models import LearningToLook, RandomWalk, Tracking, Weather

few = settings(deadline=None, max_examples=25)


def kinds(model):
    """(parent, or prev_parent) -> child: kind."""
    return {("prev_" * a.lag + a.parent, a.child): a.kind for a in model.structure.arrows}


def plans(model):
    return {node.name: node.plan for node in model.structure.nodes.values()}


def standard():
    return Normal(0.0, 1.0)


def law_of(names, law):
    """``law(**parents)`` as a method with these arguments."""

    def method(self, **parents):
        return law(**parents)

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    method.__signature__ = inspect.Signature([inspect.Parameter(name, kind) for name in ("self", *names)])
    return method


def net(law, **priors):
    """A model in which what is seen has a law of statics with these priors."""
    statics = {name: static(law_of((), prior)) for name, prior in priors.items()}
    return type(Model)("Net", (Model,), {**statics, "seen": observation(law)})()


def kind_of(law, prior=standard):
    """The kind of the one arrow x -> seen, and what is then done with x."""
    model = net(lambda self, x: law(x), x=prior)
    (arrow,) = model.structure.arrows
    return arrow.kind, model.structure.nodes["x"].plan


# Given and finite


def test_actions_and_what_follows_from_them_are_given():
    model = Contingency()
    assert kinds(model) == {
        ("vocalize", "timer"): "given",
        ("prev_timer", "timer"): "given",
        ("timer", "sound"): "given",
        ("responsive", "sound"): "finite",
        ("rates", "sound"): "selects",
    }
    assert plans(model) == {
        "responsive": "enumerated",
        "rates": "counted",
        "vocalize": "given",
        "timer": "known",
        "sound": "observed",
    }
    assert [node.name for node in model.structure.hidden] == ["responsive", "rates"]


def test_finite_parents_are_enumerated_with_all_their_values():
    model = VisualSearch(grid=Grid(3, 4))
    assert kinds(model) == {("target", "glimpse"): "finite", ("fixation", "glimpse"): "given"}
    assert model.structure.nodes["target"].values.tolist() == list(range(12))
    assert model.structure.nodes["fixation"].values.tolist() == list(range(12))
    assert model.structure.nodes["glimpse"].shape == (12,) and model.structure.nodes["glimpse"].values is None


class Known(RandomWalk):
    """What follows from what is sensed is known too; what follows from a secret is not."""

    push = action(Box(-1.0, 1.0))

    @state
    def clock(self, prev_clock=0):
        return prev_clock + 1

    @state
    def memory(self, clock, push, prev_reading=0.0, prev_memory=0.0):
        return 0.5 * prev_memory + prev_reading + push + clock

    @state
    def secret(self, position, clock):
        return 2.0 * position + clock

    @observation
    def reading(self, secret, memory):
        return Normal(secret + memory, self.noise)


def test_known_states():
    assert plans(Known()) == {
        "push": "given",
        "clock": "known",
        "memory": "known",
        "position": "integrated",
        "secret": "integrated",
        "reading": "observed",
    }
    arrows = kinds(Known())
    assert arrows["prev_reading", "memory"] == "given" and arrows["memory", "reading"] == "given"
    assert arrows["position", "secret"] == "affine" and arrows["secret", "reading"] == "affine"


def test_a_state_that_begins_with_a_secret_is_a_secret():
    class Counter(Model):
        first = static(lambda self: Categorical(ones(3)))
        clock = state(lambda self, prev_clock=first: (prev_clock + 1) % 3)
        seen = observation(lambda self, clock: Normal(1.0 * clock, 1.0))

    assert plans(Counter()) == {"first": "enumerated", "clock": "enumerated", "seen": "observed"}
    assert kinds(Counter())["first", "clock"] == "finite"


@pytest.mark.parametrize(
    ("law", "values"),
    [
        (Bernoulli(torch.tensor(0.5)), [0.0, 1.0]),
        (Categorical(ones(3)), [0, 1, 2]),
        (Binomial(2, torch.tensor(0.5)), [0.0, 1.0, 2.0]),
        (OneHotCategorical(ones(2)), [[1.0, 0.0], [0.0, 1.0]]),
        (Bernoulli(0.5 * ones(2)).to_event(1), [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]),
        (Categorical(ones(1, 2)).to_event(1), [[0], [1]]),
        (Bernoulli(0.5 * ones(14)).to_event(1), 1 << 14),
        (Bernoulli(0.5 * ones(15)).to_event(1), None),
        (Normal(0.0, 1.0), None),
        (Poisson(torch.tensor(1.0)), None),
        (torch.tensor(1.0), None),
        (Evidence(lambda seen: seen), None),
        pytest.param(
            OneHotCategorical(ones(1, 2)).to_event(1),
            [[[1.0, 0.0]], [[0.0, 1.0]]],
        ),
    ],
    ids=str,
)
def test_support(law, values):
    support = support_of(law)
    if isinstance(values, int):
        assert len(support.unique(dim=0)) == len(support) == values
    else:
        assert (support if support is None else support.tolist()) == values


def test_what_is_finite_but_too_large_to_list_is_sampled():
    assert kind_of(lambda x: Normal(x, 1.0).to_event(1), lambda: Bernoulli(0.5 * ones(15)).to_event(1))[1] == "sampled"


@st.composite
def finite_graphs(draw):
    """A model of a few categorical statics and states with random tables, all of them seen."""
    names = "abcd"[: draw(st.integers(1, 4))]
    sizes = {name: draw(st.integers(1, 3)) for name in names}
    roles = {name: draw(st.sampled_from([static, state])) for name in names}
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    body, edges = {}, {}
    for i, name in enumerate(names):
        parents = [p for p in names[:i] if (roles[p] is static or roles[name] is state) and draw(st.booleans())]
        table = torch.rand(*(sizes[p] for p in parents), sizes[name], generator=generator) + 0.1
        body[name] = roles[name](
            law_of(parents, lambda table=table, parents=parents, **given: Categorical(table[tuple(given.values())]))
        )
        edges |= {(p, name): "finite" for p in parents}
    body["seen"] = observation(law_of(names, lambda **given: Normal(1.0 * sum(given.values()), 1.0)))
    edges |= {(name, "seen"): "finite" for name in names}
    return type(Model)("Graph", (Model,), body)(), sizes, edges


@few
@given(finite_graphs())
def test_finite_graphs_are_enumerated(graph):
    model, sizes, edges = graph
    assert kinds(model) == edges
    assert plans(model) == {**dict.fromkeys(sizes, "enumerated"), "seen": "observed"}
    assert all(len(model.structure.nodes[name].values) == size for name, size in sizes.items())


# Selects


def beta():
    return Beta(2.0, 3.0)


def betas():
    return Beta(ones(3), ones(3)).to_event(1)


def dirichlets():
    return Dirichlet(ones(2, 3)).to_event(1)


def gamma():
    return Gamma(2.0, 3.0)


def gammas():
    return Gamma(ones(3), 1.0).to_event(1)


@pytest.mark.parametrize(
    ("prior", "law"),
    [
        (beta, lambda x: Bernoulli(x)),
        (beta, lambda x: Bernoulli(x.expand(4)).to_event(1)),
        (betas, lambda x: Bernoulli(x[1])),
        (betas, lambda x: Bernoulli(x).to_event(1)),
        (betas, lambda x: Bernoulli(x.flip(0)).to_event(1)),
        (betas, lambda x: Bernoulli(torch.stack([x[2], torch.full_like(x[2], 0.5)])).to_event(1)),
        (lambda: Dirichlet(ones(3)), lambda x: Categorical(x)),
        (dirichlets, lambda x: Categorical(x[1])),
        (dirichlets, lambda x: Categorical(x).to_event(1)),
        (gamma, lambda x: Poisson(x)),
        (gammas, lambda x: Poisson(x[[0, 0, 2]]).to_event(1)),
    ],
)
def test_a_probability_that_is_a_component_selects(prior, law):
    assert kind_of(law, prior) == ("selects", "counted")


@pytest.mark.parametrize(
    ("prior", "law"),
    [
        (beta, lambda x: Bernoulli(0.9 * x)),
        (beta, lambda x: Bernoulli(1.0 - x)),
        (beta, lambda x: Bernoulli(x.sqrt())),
        (betas, lambda x: Bernoulli(x.mean())),
        (betas, lambda x: Bernoulli(x.max())),
        (betas, lambda x: Bernoulli(torch.stack([x[0], 0.5 * x[1]])).to_event(1)),
        (lambda: Dirichlet(ones(3)), lambda x: Categorical(x.flip(0))),
        (lambda: Dirichlet(ones(3)), lambda x: Categorical(x * torch.arange(1.0, 4.0))),
        (dirichlets, lambda x: Categorical(x.mean(0))),
        (gamma, lambda x: Poisson(2.0 * x)),
        (gammas, lambda x: Poisson(x.sum())),
        (lambda: Uniform(0.0, 1.0), lambda x: Bernoulli(x)),
        (lambda: Gamma(20.0, 100.0), lambda x: Bernoulli(x.clamp(max=1.0))),
        (lambda: LogNormal(0.0, 1.0), lambda x: Poisson(x)),
        (beta, lambda x: Binomial(3, x)),
    ],
)
def test_any_other_probability_does_not(prior, law):
    assert kind_of(law, prior) == ("nonlinear", "sampled")


def test_a_choice_between_components_selects():
    both = net(lambda self, x, z, k: Bernoulli(where(k == 1, x, z)), x=beta, z=beta, k=lambda: Bernoulli(0.5))
    assert kinds(both) == {("x", "seen"): "selects", ("z", "seen"): "selects", ("k", "seen"): "finite"}
    half = net(lambda self, x, k: Bernoulli(where(k == 1, x, 0.5 * x)), x=beta, k=lambda: Bernoulli(0.5))
    assert kinds(half)["x", "seen"] == "nonlinear"
    product = net(lambda self, x, z: Bernoulli(x * z), x=beta, z=beta)
    assert kinds(product) == {("x", "seen"): "nonlinear", ("z", "seen"): "nonlinear"}


@pytest.mark.parametrize(
    ("wetness", "kind"),
    [(lambda self, rate: Normal(rate.sqrt(), 1.0), "nonlinear"), (lambda self, rate: Normal(rate, 1.0), "affine")],
)
def test_selected_and_asked_otherwise_is_sampled(wetness, kind):
    body = {
        "rate": static(lambda self: Gamma(2.0, 1.0)),
        "drops": observation(lambda self, rate: Poisson(rate)),
        "wetness": observation(wetness),
    }
    model = type(Model)("Both", (Model,), body)()
    assert kinds(model) == {("rate", "drops"): "selects", ("rate", "wetness"): kind}
    assert plans(model)["rate"] == "sampled"


def test_tables_and_a_hidden_chain():
    assert kinds(Weather()) == {
        ("prev_weather", "weather"): "finite",
        ("palette", "colour"): "selects",
        ("weather", "colour"): "finite",
        ("rate", "drops"): "selects",
    }
    assert plans(Weather())["palette"] == plans(Weather())["rate"] == "counted"


def test_a_clamped_probability_does_not_select():
    assert kind_of(lambda x: Bernoulli(x.clamp(0.4, 0.6)), lambda: Beta(500.0, 500.0))[0] == "nonlinear"


# Affine and moves


def test_gaussian_chains_are_integrated():
    assert kinds(Tracking()) == {
        ("push", "place"): "given",
        ("prev_place", "place"): "affine",
        ("start", "place"): "affine",
        ("place", "seen"): "affine",
    }
    assert plans(Tracking())["start"] == plans(Tracking())["place"] == "integrated"
    assert set(kinds(RandomWalk()).values()) == {"affine"}


def matrix(draw, rows, columns, entries):
    return torch.tensor(draw(st.lists(entries, min_size=rows * columns, max_size=rows * columns))).reshape(
        rows, columns
    )


@st.composite
def affine_laws(draw):
    """A law of one to three Gaussian vectors, its slope decided by an action, and perhaps a joint spread."""
    entries = st.floats(-100.0, 100.0, width=32)
    rows = draw(st.integers(1, 3))
    sizes = {name: draw(st.integers(1, 3)) for name in "xyz"[: draw(st.integers(1, 3))]}
    slopes = {name: torch.stack([matrix(draw, rows, n, entries) for _ in "01"]) for name, n in sizes.items()}
    offset = matrix(draw, rows, 1, entries)[:, 0]
    joint = draw(st.booleans())

    def law(push, **parents):
        loc = sum((slopes[name].to(value.dtype)[push] @ value for name, value in parents.items()), offset)
        spread = torch.eye(rows, dtype=loc.dtype)
        return MultivariateNormal(loc, spread) if joint else Normal(loc, 0.1).to_event(1)

    body = {name: static(law_of((), lambda n=n: Normal(zeros(n), 1.0).to_event(1))) for name, n in sizes.items()}
    seen = observation(law_of(("push", *sizes), law))
    return type(Model)("Affine", (Model,), {**body, "push": action(Binary()), "seen": seen})()


@few
@given(affine_laws())
def test_affine_laws_are_integrated(model):
    assert {kind for (parent, _), kind in kinds(model).items() if parent != "push"} == {"affine"}
    assert {node.plan for node in model.structure.hidden} == {"integrated"}


@few
@given(st.data(), st.integers(1, 3), st.integers(1, 3))
def test_quadratic_laws_are_sampled(data, rows, columns):
    entries = st.floats(-100.0, 100.0, width=32)
    slope = matrix(data.draw, rows, columns, entries)
    row, i, j = (data.draw(st.integers(0, n - 1)) for n in (rows, columns, columns))
    curve = data.draw(st.floats(0.01, 100.0)) * data.draw(st.sampled_from([-1, 1]))

    def law(x):
        loc = slope.to(x.dtype) @ x
        return Normal(loc + curve * x[i] * x[j] * (torch.arange(rows) == row), 0.1).to_event(1)

    assert kind_of(law, lambda: Normal(zeros(columns), 1.0).to_event(1)) == ("nonlinear", "sampled")


def test_shift_and_window_move():
    image = zeros(4, 5)
    for law, kind in [
        (lambda x: Normal(shift(x, torch.tensor([1.0, -2.0])), 0.1), "moves"),
        (lambda x: Normal(window(x, torch.tensor([1, 0]), (2, 2)), 0.1), "moves"),
        (lambda x: Normal(window(shift(x, torch.tensor([1, 1])), torch.tensor([1, 0]), (2, 2)), 0.1), "affine"),
        (lambda x: Normal(0.5 * shift(x, torch.tensor([1, 1])), 0.1), "affine"),
        (lambda x: Normal(shift(0.5 * x, torch.tensor([1, 1])), 0.1), "affine"),
        (lambda x: Normal(shift(x, torch.tensor([1, 1])) + x, 0.1), "affine"),
    ]:
        assert kind_of(lambda x, law=law: law(x).to_event(2), lambda: Normal(image, 1.0).to_event(2))[0] == kind


def test_learning_to_look():
    model = LearningToLook()
    assert kinds(model) == {
        ("prev_actuation", "actuation"): "affine",
        ("first_actuation", "actuation"): "affine",
        ("command", "motion"): "given",
        ("actuation", "motion"): "affine",
        ("prev_scene", "scene"): "moves",
        ("motion", "scene"): "nonlinear",
        ("scene", "image"): "moves",
    }
    assert plans(model) == {
        "first_actuation": "integrated",
        "command": "given",
        "actuation": "integrated",
        "motion": "sampled",
        "scene": "integrated",
        "image": "observed",
    }
    assert "scene depends on it nonlinearly" in model.structure.nodes["motion"].why


# Nonlinear

NONLINEAR = {
    "square": lambda x: Normal(x.square(), 1.0),
    "slight curve": lambda x: Normal(x + 1e-5 * x**2, 1.0),
    "root": lambda x: Normal(x.abs().sqrt(), 1.0),
    "sine": lambda x: Normal(x.sin(), 1.0),
    "abs": lambda x: Normal(x.abs(), 1.0),
    "abs off the centre": lambda x: Normal((x - 9.0).abs(), 1.0),
    "relu": lambda x: Normal(x.relu(), 1.0),
    "relu off the centre": lambda x: Normal((x - 30.0).relu(), 1.0),
    "relu off the other side": lambda x: Normal((-30.0 - x).relu(), 1.0),
    "clamp": lambda x: Normal(x.clamp(-50.0, 50.0), 1.0),
    "clamp from above": lambda x: Normal(x.clamp(max=40.0), 1.0),
    "rounding": lambda x: Normal(x.round(), 1.0),
    "step": lambda x: Normal((x > 5.0).to(x.dtype), 1.0),
    "bump": lambda x: Normal(torch.exp(-(x**2) / 1e-3), 1.0),
    "exponential": lambda x: Normal(x.exp(), 1.0),
    "infinite beyond": lambda x: Normal(torch.log(x + 10.0), 1.0),
    "spread": lambda x: Normal(x, 1.0 + x.square()),
    "spread that goes negative": lambda x: Normal(0.0, x + 10.0),
    "spread with a kink": lambda x: Normal(x, where(x > 20.0, 2.0, 1.0)),
    "joint spread": lambda x: MultivariateNormal(x * ones(2), scale_tril=torch.eye(2) * (1.0 + x.square())),
    "joint precision": lambda x: MultivariateNormal(x * ones(2), precision_matrix=torch.eye(2) * (1.0 + x.square())),
    "one component": lambda x: Normal(torch.stack([x, x.abs()]), 1.0).to_event(1),
    "another family": lambda x: StudentT(3.0, x, 1.0),
    "a choice": lambda x: Bernoulli(x.sigmoid()),
    "a displacement": lambda x: Normal(shift(torch.eye(5), x * ones(2)), 1.0).to_event(2),
}


@pytest.mark.parametrize("name", NONLINEAR)
def test_nonlinear_laws_are_sampled(name):
    assert kind_of(NONLINEAR[name]) == ("nonlinear", "sampled")


@few
@given(st.floats(-30.0, 30.0), st.floats(0.1, 10.0), st.floats(-3.0, 3.0))
def test_kinks_are_found_wherever_they_are(kink, scale, slope):
    assert kind_of(lambda x: Normal(slope * x + scale * (x - kink).relu(), 1.0))[0] == "nonlinear"


@pytest.mark.parametrize("law", ["square", "spread", "abs"])
def test_the_units_of_a_law_do_not_matter(law):
    def small(x):
        law_ = NONLINEAR[law](x)
        return Normal(1e-12 * law_.loc, 1e-12 * law_.scale)

    assert kind_of(small)[0] == "nonlinear"


def test_a_large_component_hides_no_small_one():
    assert kind_of(lambda x: Normal(torch.stack([1e9 * x, x.abs()]), 1.0).to_event(1))[0] == "nonlinear"


def test_a_table_of_a_bounded_parent():
    table = torch.tensor([1.0, 5.0, 2.0])
    assert kind_of(lambda x: Normal(table[x.long()], 1.0), lambda: Uniform(0.0, 3.0)) == ("nonlinear", "sampled")


class Cells(Model):
    """A deterministic whole number between a continuum and what is seen."""

    table: torch.Tensor = torch.tensor([1.0, 5.0, 2.0])
    place = state(lambda self: Normal(1.0, 1.0))
    cell = state(lambda self, place: place.round().long().clamp(0, 2))

    @observation
    def seen(self, cell):
        return Normal(self.table[cell], 1.0)


def test_whole_numbers_that_follow_from_a_continuum():
    assert kinds(Cells()) == {("place", "cell"): "nonlinear", ("cell", "seen"): "nonlinear"}
    assert plans(Cells())["place"] == "sampled"


def test_a_rare_hypothesis_is_looked_at():
    model = net(lambda self, k, x: Normal(where(k == 1, x**2, x), 1.0), k=lambda: Bernoulli(1e-4), x=standard)
    assert kinds(model)["x", "seen"] == "nonlinear"


def test_a_rare_action_is_looked_at():
    class Rare(Model):
        push = action(Finite(500))
        x = static(lambda self: Normal(0.0, 1.0))
        seen = observation(lambda self, push, x: Normal(where(push == 499, x**2, x), 1.0))

    assert kinds(Rare())["x", "seen"] == "nonlinear"


@pytest.mark.parametrize("when", [1, 2, 20])
def test_other_steps_are_looked_at(when):
    class Timed(Model):
        x = static(lambda self: Normal(0.0, 1.0))
        clock = state(lambda self, prev_clock=0: prev_clock + 1)
        seen = observation(lambda self, clock, x: Normal(where(clock == when, x**2, x), 1.0))

    assert kinds(Timed())["x", "seen"] == "nonlinear"


# Several parents together


def gaussians(n):
    return lambda: Normal(zeros(n), 1.0).to_event(1)


def test_of_a_product_exactly_one_is_sampled():
    model = net(lambda self, a, b: Normal(a * b, 1.0), a=standard, b=standard)
    assert sorted(kinds(model).values()) == ["affine", "nonlinear"]
    assert sorted(plans(model).values()) == ["integrated", "observed", "sampled"]
    one = next(a for a in model.structure.arrows if a.kind == "nonlinear")
    other = next(a for a in model.structure.arrows if a.kind == "affine")
    assert other.why == f"given {one.parent}" and one.why == f"multiplies {other.parent}"


@pytest.mark.parametrize("sizes", [(2, 6), (6, 2)])
def test_of_a_product_the_smaller_one_is_sampled(sizes):
    model = net(
        lambda self, a, b: Normal((a[:, None] * b).flatten(), 1.0).to_event(1),
        a=gaussians(sizes[0]),
        b=gaussians(sizes[1]),
    )
    assert plans(model)["a" if sizes[0] == 2 else "b"] == "sampled"
    assert sorted(kinds(model).values()) == ["affine", "nonlinear"]


def test_of_three_that_multiply_as_few_as_possible_are_sampled():
    star = net(lambda self, a, b, c: Normal(a * (b + c), 1.0), b=standard, c=standard, a=standard)
    assert kinds(star) == {("a", "seen"): "nonlinear", ("b", "seen"): "affine", ("c", "seen"): "affine"}
    triple = net(lambda self, a, b, c: Normal(a * b * c, 1.0), a=standard, b=standard, c=standard)
    assert sorted(kinds(triple).values()) == ["affine", "nonlinear", "nonlinear"]


def test_one_that_decides_the_spread_leaves_the_other_affine():
    model = net(lambda self, a, b: Normal(a, b.exp()), a=standard, b=standard)
    assert kinds(model) == {("a", "seen"): "affine", ("b", "seen"): "nonlinear"}


def test_what_is_nonlinear_together_is_sampled_together():
    model = net(lambda self, a, b: Normal(torch.maximum(a, b), 1.0), a=standard, b=standard)
    assert set(kinds(model).values()) == {"nonlinear"}


def test_a_finite_factor_leaves_its_partner_affine():
    model = net(lambda self, k, x: Normal(k * x, 1.0), k=lambda: Bernoulli(0.5), x=standard)
    assert kinds(model) == {("k", "seen"): "finite", ("x", "seen"): "affine"}


def test_one_nonlinear_child_is_enough():
    class Two(Model):
        x = static(lambda self: Normal(0.0, 1.0))
        plain = observation(lambda self, x: Normal(x, 1.0))
        bent = observation(lambda self, x: Normal(x.abs(), 1.0))

    assert kinds(Two()) == {("x", "plain"): "affine", ("x", "bent"): "nonlinear"}
    assert plans(Two())["x"] == "sampled" and "bent" in Two().structure.nodes["x"].why


@pytest.mark.parametrize("prior", [beta, gamma, lambda: Poisson(3.0), lambda: StudentT(3.0, 0.0, 1.0)])
def test_families_without_an_algebra_are_sampled(prior):
    assert kind_of(lambda x: Normal(x, 1.0), prior) == ("affine", "sampled")


# Pins, evidence, queries


def test_pins_are_taken_at_their_word():
    class Pinned(RandomWalk):
        @state(kinds={"prev_position": "nonlinear"})
        def position(self, prev_position=0.0):
            return Normal(prev_position, self.drift)

        @observation(kinds={"position": "affine"})
        def reading(self, position):
            return Normal(position.sin(), self.noise)

    arrows = {(a.lag, a.child): a for a in Pinned().structure.arrows}
    assert arrows[1, "position"].kind == "nonlinear" and arrows[0, "reading"].kind == "affine"
    assert {a.why for a in arrows.values()} == {"pinned by the author"}


def test_a_pin_leaves_the_other_arrows_to_be_read():
    class Pinned(Model):
        a = static(lambda self: Normal(0.0, 1.0))
        b = static(lambda self: Normal(0.0, 1.0))
        seen = observation(kinds={"b": "nonlinear"})(lambda self, a, b: Normal(a * b, 1.0))

    assert kinds(Pinned()) == {("a", "seen"): "affine", ("b", "seen"): "nonlinear"}


def test_an_evidence_of_a_finite_parent():
    model = net(lambda self, x: Evidence(lambda seen: seen[x]), x=lambda: Categorical(ones(4)))
    assert kinds(model) == {("x", "seen"): "finite"} and model.structure.nodes["seen"].family == "Evidence"


def test_queries():
    structure = Contingency().structure
    assert [a.parent for a in structure.into("sound")] == ["responsive", "timer", "rates"]
    assert [a.child for a in structure.out_of("timer")] == ["timer", "sound"]
    assert [n.name for n in structure.planned("known", "counted")] == ["rates", "timer"]
    assert structure.interest == ("responsive",) and structure.model == "Contingency"
    assert [n.name for n in structure.nodes.values() if n.random] == ["responsive", "rates", "sound"]


def test_reading_leaves_the_global_generator_and_precision_alone():
    before = torch.random.get_rng_state()
    assert LearningToLook().structure
    assert torch.equal(torch.random.get_rng_state(), before) and torch.get_default_dtype() == torch.float32


def test_a_field_that_keeps_its_own_precision_is_no_obstacle():
    class Network(RandomWalk):
        net: torch.nn.Module = torch.nn.Linear(1, 1)

        @observation
        def reading(self, position):
            return Normal(self.net(position[None])[0], 1.0)

    assert kinds(Network())["position", "reading"] == "affine"
