import pickle

import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal, Poisson
from torch.distributions import Independent

from apmodels import Planted
from apmodels.simulation import seeded

N, BATCH = 5, (2, 3)


def table(*shape):
    with seeded(sum(shape)):
        return torch.rand(shape) + 0.2


FAMILIES = {
    "Normal": (lambda p: Normal(3 * p, p), ()),
    "Bernoulli": (lambda p: Bernoulli(p / 2), ()),
    "Poisson": (Poisson, ()),
    "Categorical": (Categorical, (4,)),
}
every_family = pytest.mark.parametrize("family", FAMILIES)
every_batch = pytest.mark.parametrize("batch", [(), (3,), BATCH], ids=str)


def planted(family, batch):
    """A planted law, and the same one written densely."""
    make, row = FAMILIES[family]
    here, elsewhere = table(*batch, *row), table(*batch, N, *row)
    with seeded(3):
        index = torch.randint(N, batch)
    is_here = (torch.arange(N) == index[..., None]).reshape(*batch, N, *[1] * len(row))
    dense = torch.where(is_here, here.unsqueeze(len(batch)), elsewhere)
    return Planted(index, make(here), make(elsewhere)), Independent(make(dense), 1)


@every_family
@every_batch
def test_planted_scores_as_the_dense_law(family, batch):
    law, dense = planted(family, batch)
    assert law.batch_shape == dense.batch_shape == batch and law.event_shape == dense.event_shape == (N,)
    with seeded(0):
        values = dense.sample((7,))
    torch.testing.assert_close(law.log_prob(values), dense.log_prob(values))
    assert law.log_prob(values).shape == (7, *batch)


@every_family
@every_batch
def test_missing_elements_say_nothing(family, batch):
    law, dense = planted(family, batch)
    with seeded(0):
        values = dense.sample((7,)).float()
        missing = torch.rand(values.shape) < 0.5
    missing[0] = True
    expected = torch.where(missing, 0.0, dense.base_dist.log_prob(values)).sum(-1)
    scores = law.log_prob(torch.where(missing, torch.nan, values))
    torch.testing.assert_close(scores, expected)
    assert not scores[0].any()


@every_family
@every_batch
def test_planted_draws_as_the_dense_law(family, batch):
    law, dense = planted(family, batch)
    with seeded(1):
        drawn, others = law.sample((20_000,)).float(), dense.sample((20_000,)).float()
    assert drawn.shape == others.shape
    for moment in (lambda x: x.mean(0), lambda x: x.var(0)):
        torch.testing.assert_close(moment(drawn), moment(others), atol=0.15, rtol=0.1)
    # Elements are independent: the variance of a sum is the sum of the variances.
    torch.testing.assert_close(drawn.sum(-1).var(0), drawn.var(0).sum(-1), atol=0.1, rtol=0.1)
    assert law.sample().shape == (*batch, N)


@pytest.mark.parametrize("family", ["Normal", "Bernoulli", "Poisson"])
@every_batch
def test_the_mean_is_the_dense_one(family, batch):
    law, dense = planted(family, batch)
    torch.testing.assert_close(law.mean, dense.mean)


def test_one_law_scores_many_values_and_many_laws_one_value():
    law, dense = planted("Normal", BATCH)
    value = torch.arange(float(N))
    torch.testing.assert_close(law.log_prob(value), dense.log_prob(value))
    single, dense = planted("Normal", ())
    values = torch.randn(4, 3, N)
    torch.testing.assert_close(single.log_prob(values), dense.log_prob(values))


@every_family
def test_planted_vectorises(family):
    law, dense = planted(family, (3,))
    values = dense.sample()

    def score(index, here, elsewhere, value):
        make, _ = FAMILIES[family]
        return Planted(index, make(here), make(elsewhere)).log_prob(value)

    _, row = FAMILIES[family]
    with seeded(3):
        index = torch.randint(N, (3,))
    scores = torch.func.vmap(score)(index, table(3, *row), table(3, N, *row), values)
    torch.testing.assert_close(scores, law.log_prob(values))


def test_planted_pickles():
    law, _ = planted("Categorical", BATCH)
    copy = pickle.loads(pickle.dumps(law))
    values = law.sample()
    assert torch.equal(copy.log_prob(values), law.log_prob(values)) and copy.event_shape == (N,)


@pytest.mark.parametrize(
    ("here", "elsewhere"),
    [
        (Normal(0.0, 1.0), Poisson(torch.ones(N))),
        (Normal(torch.zeros(2), 1.0).to_event(1), Normal(torch.zeros(N), 1.0)),
    ],
)
def test_planted_wants_one_family(here, elsewhere):
    with pytest.raises(TypeError, match="one family for both"):
        Planted(torch.tensor(0), here, elsewhere)


def test_what_is_elsewhere_may_be_one_law_for_a_whole_batch():
    index, here = torch.tensor([0, 3, 3]), Normal(torch.tensor([5.0, 6.0, 7.0]), 0.1)
    law = Planted(index, here, Normal(torch.zeros(N), 0.1))
    assert law.batch_shape == (3,) and law.mean[1].tolist() == [0, 0, 0, 6, 0]
    with seeded(0):
        values = law.sample((50,))
    assert values.shape == (50, 3, N) and (values - law.mean).abs().max() < 1
    wide = Planted(index, here, Normal(torch.zeros(3, N), 0.1))
    torch.testing.assert_close(law.log_prob(values), wide.log_prob(values))
