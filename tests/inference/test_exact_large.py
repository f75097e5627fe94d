"""The exact engine with many places, many beliefs and many contexts."""

import pytest
import torch
from pyro.distributions import Bernoulli, Categorical, Normal

import inference.exact
import inference.tables.contexts
from apmodels import Grid, Planted, VisualSearch, WanderingSearch, observation
from inference import Exact

NAN = float("nan")


class Flashes(VisualSearch):
    """Places flash or not; ``outcomes`` are 2 or 3."""

    grid: Grid = Grid(3, 4)
    outcomes: int = 2

    @observation
    def glimpse(self, target, fixation):
        chance = 0.2 + 0.6 * (-self.grid.distance(target, fixation)).exp()
        usual = torch.full((self.grid.size,), 0.2)
        if self.outcomes == 2:
            return Planted(target, Bernoulli(chance), Bernoulli(usual))
        shares = torch.tensor([0.5, 0.5])
        here = torch.cat([(1 - chance)[..., None], chance[..., None] * shares], -1)
        elsewhere = torch.cat([(1 - usual)[..., None], usual[..., None] * shares], -1)
        return Planted(target, Categorical(here), Categorical(elsewhere))


def drawn(model, batch, seed=0):
    torch.manual_seed(seed)
    looks, targets = torch.randint(model.grid.size, (2, batch))
    return looks, model.glimpse(targets, looks).sample().float()


@pytest.mark.parametrize(
    "model", [Flashes(), Flashes(outcomes=3), VisualSearch(grid=Grid(3, 4))], ids=["2", "3", "real"]
)
@pytest.mark.parametrize("missing", [False, True])
def test_batches_of_looks_are_weighed_as_the_law_says(model, missing):
    looks, seen = drawn(model, 7)
    if missing:
        seen[:, ::2] = NAN
        seen[3] = NAN
    belief = Exact(model).update(Exact(model).start(7), looks, seen)
    cells = model.grid.values()
    scores = torch.stack([model.glimpse(cells, looks[i].expand(12)).log_prob(seen[i]) for i in range(7)])
    torch.testing.assert_close(belief.marginal("target").probs, scores.softmax(1))
    torch.testing.assert_close(belief.log_evidence, scores.logsumexp(1) - torch.tensor(12.0).log())
    single = Exact(model).update(Exact(model).start(), looks[0], seen[0])
    torch.testing.assert_close(single.marginal("target").probs, scores[0].softmax(0))


@pytest.mark.parametrize("model", [Flashes(), VisualSearch(grid=Grid(3, 4)), WanderingSearch(grid=Grid(3, 4))])
def test_batches_are_weighed_in_pieces(model, monkeypatch):
    looks, seen = drawn(model, 11)
    engine = Exact(model)
    whole = engine.update(engine.update(engine.start(11), looks, seen), 3, seen)
    monkeypatch.setattr(inference.exact, "CHUNK", 50)
    pieces = engine.update(engine.update(engine.start(11), looks, seen), 3, seen)
    torch.testing.assert_close(pieces.log_probs, whole.log_probs)
    torch.testing.assert_close(pieces.log_evidence, whole.log_evidence)


def test_what_all_contexts_share_is_kept_once():
    engine = Exact(VisualSearch(grid=Grid(3, 4)))
    looks, seen = drawn(engine.model, 5)
    for part in range(5):
        engine.update(engine.start(), looks[part], seen[part])
    table = engine.tabulation.tables["glimpse"]
    assert len(table.location) == len(table.slope) == len(set(looks.tolist()))
    assert table.location.stride(0) == table.index.stride(0) == 0 and table.slope.stride(0) > 0


def test_what_contexts_do_not_share_is_kept_for_each():
    class Shaded(VisualSearch):
        """The background depends on the fixation, too."""

        @observation
        def glimpse(self, target, fixation):
            shade = self.grid.one_hot(fixation)
            return Planted(target, Normal(2.0 + 0.0 * target, 1.0), Normal(shade, 1.0))

    model = Shaded(grid=Grid(2, 3))
    looks, seen = drawn(model, 6)
    engine = Exact(model)
    scores = [model.glimpse(model.grid.values(), looks[i].expand(6)).log_prob(seen[i]) for i in range(6)]
    for i in range(6):
        belief = engine.update(engine.start(), looks[i], seen[i])
        torch.testing.assert_close(belief.marginal("target").probs, scores[i].softmax(0))
    belief = engine.update(engine.start(6), looks, seen)
    torch.testing.assert_close(belief.marginal("target").probs, torch.stack(scores).softmax(1))


def test_tables_do_not_outgrow_what_there_is_room_for(monkeypatch):
    monkeypatch.setattr(inference.tables.contexts, "NUMBERS", 12 * 4)
    model = VisualSearch(grid=Grid(3, 4))
    engine, plenty = Exact(model), Exact(model)
    looks, seen = drawn(model, 12)
    for i in range(12):
        found = engine.update(engine.start(), looks[i], seen[i])
        plain = plenty.update(plenty.start(), looks[i], seen[i])
        torch.testing.assert_close(found.log_probs, plain.log_probs)
        assert len(engine.tabulation.contexts.seen) <= 4 + 1


def test_a_photograph_of_places():
    model = VisualSearch(grid=Grid(101, 101))
    looks, seen = drawn(model, 3)
    engine = Exact(model)
    belief = engine.update(engine.start(3), looks, seen)
    cells = model.grid.values()
    for i in range(3):
        signal = model.acuity(model.grid.distance(cells, looks[i]))
        by_hand = (signal * (seen[i] - signal / 2)).softmax(0)
        torch.testing.assert_close(belief.marginal("target").probs[i], by_hand)
