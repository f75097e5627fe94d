import pytest
import torch
from pyro.distributions import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    Dirichlet,
    Gamma,
    LogNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    OneHotCategorical,
    Poisson,
    StudentT,
    Uniform,
    VonMises,
)
from torch.distributions import Distribution

from apmodels import Model, Planted, ValueOutOfRange, observation, static
from apmodels.distributions import (
    base_of,
    check_parameters,
    compact,
    family,
    log_prob_of,
    parameters,
    picked,
    tensors,
    unvalidated,
    with_tensors,
)
from apmodels.laws import Laws
from apmodels.simulation import seeded

# Laws of two positive parents, as a model may write them: with numbers, tensors, constants and transforms inside.
LAWS = {
    "Normal": lambda x, z: Normal(x, z),
    "Normal of a number": lambda x, z: Normal(x - z, 0.5),
    "Normal image": lambda x, z: Normal(x * torch.arange(6.0).reshape(2, 3), z).to_event(2),
    "Normal twice to_event": lambda x, z: Normal(x * torch.ones(2, 3), z).to_event(1).to_event(1),
    "Bernoulli": lambda x, z: Bernoulli(x / (x + z)),
    "Bernoulli logits": lambda x, z: Bernoulli(logits=x - z),
    "Bernoulli vector": lambda x, z: Bernoulli(torch.stack([x, z]) / 9).to_event(1),
    "Binomial": lambda x, z: Binomial(3, x / (x + z)),
    "Categorical": lambda x, z: Categorical(torch.stack([x, z, x * z])),
    "Categorical vector": lambda x, z: Categorical(torch.ones(2, 3) * x + z * torch.eye(2, 3)).to_event(1),
    "OneHotCategorical": lambda x, z: OneHotCategorical(logits=torch.stack([x, z])),
    "Beta": lambda x, z: Beta(x, z),
    "Dirichlet": lambda x, z: Dirichlet(torch.stack([x, z, x])),
    "Gamma": lambda x, z: Gamma(x, z),
    "Poisson": lambda x, z: Poisson(x * z),
    "LogNormal": lambda x, z: LogNormal(x, z),
    "StudentT": lambda x, z: StudentT(3.0, x, z),
    "VonMises": lambda x, z: VonMises(x, z),
    "Uniform": lambda x, z: Uniform(-x, z),
    "MultivariateNormal": lambda x, z: MultivariateNormal(x * torch.ones(2), z * torch.eye(2)),
    "MultivariateNormal factor": lambda x, z: MultivariateNormal(x * torch.ones(2), scale_tril=z * torch.eye(2)),
    "Mixture": lambda x, z: MixtureSameFamily(Categorical(torch.stack([x, z])), Normal(torch.stack([x, -x]), z)),
    "Planted": lambda x, z: Planted((x > z).long(), Normal(x, z), Normal(torch.zeros(3), z)),
    "one parent only": lambda x, z: Normal(x, 1.0),
    "no parent": lambda x, z: Normal(torch.zeros(3), 1.0).to_event(1),
}
every_law = pytest.mark.parametrize("name", LAWS)


def laws_of(law):
    cause = static(lambda self: Gamma(2.0, 1.0))
    other = static(lambda self: Gamma(2.0, 1.0))
    seen = observation(lambda self, x, z: law(x, z))
    return Laws(type(Model)("Family", (Model,), {"x": cause, "z": other, "seen": seen})())


def parents_of(shape, other):
    with seeded(0):
        return {"x": torch.rand(shape) + 0.5, "z": torch.rand(other) + 0.5}


@every_law
@pytest.mark.parametrize(("shape", "other"), [((4,), (4,)), ((3, 1), (1, 2)), ((3, 2), (1, 2)), ((1,), (1,))], ids=str)
def test_a_law_of_many_worlds_is_the_law_of_each(name, shape, other):
    laws, parents = laws_of(LAWS[name]), parents_of(shape, other)
    lead = torch.broadcast_shapes(shape, other)
    wide = {key: value.expand(lead) for key, value in parents.items()}
    many = laws.many("seen", parents, lead)
    with seeded(1):
        values = many.sample()
    singles = {}
    for at in map(tuple, torch.ones(lead).nonzero().tolist()):
        singles[at] = laws.one("seen", {key: value[at] for key, value in wide.items()})
    assert values.shape == (*lead, *next(iter(singles.values())).event_shape)
    with unvalidated():
        expected = torch.stack([one.log_prob(values[at]) for at, one in singles.items()]).reshape(lead)
        torch.testing.assert_close(many.log_prob(values), expected)
        # More values than worlds, and the scores of a record.
        torch.testing.assert_close(many.log_prob(values.expand(5, *values.shape)), expected.expand(5, *lead))
        torch.testing.assert_close(laws.score("seen", wide, values, lead), expected)


@every_law
def test_worlds_of_one_law_are_drawn_independently(name):
    laws = laws_of(LAWS[name])
    with seeded(1):
        drawn = laws.many("seen", parents_of((1, 1), (1, 1)), (50, 2)).sample()
    assert drawn.shape[:2] == (50, 2)
    assert len(drawn.reshape(100, -1).unique(dim=0)) > 1
    assert not torch.equal(drawn[:, 0], drawn[:, 1])


@every_law
def test_picking_worlds_is_the_law_of_those_worlds(name):
    laws, parents = laws_of(LAWS[name]), parents_of((4,), (4,))
    many, index = laws.many("seen", parents, (4,)), torch.tensor([[2, 0, 0], [3, 1, 2]])
    few = laws.many("seen", {key: value[index] for key, value in parents.items()}, (2, 3))
    with unvalidated(), seeded(1):
        values = few.sample()
        chosen = picked(many, index, (2, 3), 1)
        assert chosen.batch_shape == (2, 3)
        torch.testing.assert_close(chosen.log_prob(values), few.log_prob(values))


@every_law
def test_taking_apart_and_together_changes_nothing(name):
    law = LAWS[name](torch.tensor(0.5), torch.tensor(1.5))
    again = with_tensors(law, [part.clone() for part in tensors(law)], ())
    assert type(again) is type(law) and again is not law
    value = law.sample()
    assert torch.equal(again.log_prob(value), law.log_prob(value))


def test_the_law_that_is_copied_is_left_alone():
    law = Normal(torch.zeros(3), 1.0).to_event(1)
    with_tensors(law, [part + 9.0 for part in tensors(law)], (2,))
    assert law.batch_shape == () and not law.base_dist.loc.any()


@pytest.mark.parametrize(
    ("law", "added", "named"),
    [
        (Normal(torch.zeros(2, 3), 1.0), 0, "Normal"),
        (Normal(torch.zeros(2, 3), 1.0).to_event(2), 2, "Normal"),
        (Normal(torch.zeros(2, 3), 1.0).to_event(1).to_event(1), 2, "Normal"),
        (MultivariateNormal(torch.zeros(2, 3), torch.eye(3)).to_event(1), 1, "MultivariateNormal"),
    ],
)
def test_what_a_law_is_made_of(law, added, named):
    base, count = base_of(law)
    assert (type(base).__name__, count, family(law)) == (named, added, named)


def test_parameters_are_those_that_were_given():
    assert list(parameters(Normal(0.0, 2.0).to_event(0))) == ["loc", "scale"]
    assert list(parameters(Bernoulli(torch.tensor(0.5)))) == ["probs"]
    assert list(parameters(Bernoulli(logits=torch.tensor(0.5)))) == ["logits"]
    law = MultivariateNormal(torch.zeros(2), precision_matrix=4 * torch.eye(2))
    assert torch.equal(parameters(law)["precision_matrix"], 4 * torch.eye(2))
    assert parameters(LogNormal(torch.tensor(1.0), torch.tensor(2.0))) == {"loc": 1.0, "scale": 2.0}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda nan: Normal(nan, 1.0), "Normal with loc = nan, .*finite"),
        (lambda nan: Normal(nan.new_tensor(torch.inf), 1.0), "loc = inf"),
        (lambda nan: Normal(0.0, nan), "scale = nan"),
        (lambda nan: Normal(torch.zeros(3), torch.tensor([1.0, -2.0, 3.0])).to_event(1), "scale = -2.*positive"),
        (lambda nan: Bernoulli(torch.tensor([0.2, 1.5])).to_event(1), r"probs = 1.5.*\[0, 1\]"),
        (lambda nan: Bernoulli(logits=nan), "logits = nan"),
        (lambda nan: Categorical(torch.tensor([-1.0, 3.0])), "probs = -0.5.*sum to 1"),
        (lambda nan: Categorical(torch.zeros(2)), "probs = nan"),
        (lambda nan: Gamma(torch.tensor(-1.0), 1.0), "concentration = -1.*positive"),
        (lambda nan: Poisson(torch.tensor(-1.0)), "rate = -1"),
        (lambda nan: LogNormal(0.0, torch.tensor(-3.0)), "scale = -3"),
        (lambda nan: Planted(torch.tensor(0), Poisson(torch.tensor(-2.0)), Poisson(torch.ones(2))), "rate = -2"),
        (lambda nan: MixtureSameFamily(Categorical(torch.ones(2)), Normal(torch.zeros(2), nan)), "scale = nan"),
        (lambda nan: MultivariateNormal(torch.zeros(2), scale_tril=-torch.eye(2)), "scale_tril"),
    ],
)
def test_parameters_are_checked(make, words):
    with unvalidated():
        law = make(torch.tensor(torch.nan))
    with pytest.raises(ValueOutOfRange, match=f"World.thing is .*{words}"):
        check_parameters(law, "World.thing")


@every_law
def test_good_parameters_pass(name):
    check_parameters(LAWS[name](torch.tensor(0.5), torch.tensor(1.5)), "World.thing")
    check_parameters(laws_of(LAWS[name]).many("seen", parents_of((3, 1), (1, 2)), (3, 2)), "World.thing")


@pytest.mark.parametrize("inside", [True, False])
def test_checks_are_as_before_afterwards(inside):
    before = Distribution._validate_args
    try:
        Distribution.set_default_validate_args(inside)
        with pytest.raises(ZeroDivisionError), unvalidated():
            assert not Distribution._validate_args
            raise ZeroDivisionError
        assert Distribution._validate_args is inside
    finally:
        Distribution.set_default_validate_args(before)


ELEMENTWISE = [
    "Normal",
    "Normal image",
    "Normal twice to_event",
    "Bernoulli vector",
    "Categorical",
    "LogNormal",
    "Gamma",
]


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_missing_elements_say_nothing(name):
    law = LAWS[name](torch.tensor(0.5), torch.tensor(1.5))
    base, added = base_of(law)
    with unvalidated(), seeded(0):
        values = law.sample((9,)).float()
        missing = torch.rand(values.shape) < 0.4
        each = torch.where(missing, 0.0, base.log_prob(values))
        expected = each.sum(tuple(range(-added, 0))) if added else each
        torch.testing.assert_close(log_prob_of(law, torch.where(missing, torch.nan, values)), expected)
        torch.testing.assert_close(log_prob_of(law, values), law.log_prob(values))
        assert missing.any() and not log_prob_of(law, torch.full_like(values, torch.nan)).any()


def test_compact_drops_what_only_repeats():
    value = torch.rand(2, 1, 3).expand(4, 2, 5, 3)
    assert compact(value).shape == (1, 2, 1, 3) and torch.equal(compact(value).expand(4, 2, 5, 3), value)
    assert compact(torch.rand(2, 3)).shape == (2, 3)
