import pytest
import torch

import inference
from inference import Exact, Refusal
from tests.models import Coin, RandomWalk


def test_the_best_bid_is_chosen_and_built():
    engine = inference.choose(Coin())
    assert isinstance(engine, Exact) and engine.model == Coin()
    assert max(bid.competence for bid in inference.bids(Coin()).values()) == inference.bids(Coin())["Exact"].competence


def test_options_reach_the_engine():
    assert inference.choose(Coin(), dtype=torch.float64).dtype == torch.float64
    assert inference.choose(Coin()).dtype == torch.float32


@pytest.mark.parametrize("model", [Coin(), RandomWalk()], ids=["Coin", "RandomWalk"])
def test_bids_come_best_first_with_reasons(model):
    bids = inference.bids(model)
    competences = [bid.competence for bid in bids.values()]
    assert competences == sorted(competences, reverse=True) and all(0 <= c <= 1 for c in competences)
    lines = inference.explain(model).splitlines()
    assert len(lines) == len(bids)
    for line, (name, bid) in zip(lines, bids.items(), strict=True):
        assert line.startswith(name) and bid.reason in line and bool(bid) == (bid.competence > 0)


def test_the_exact_engine_counts_what_it_enumerates():
    assert "2 x 3 values" in inference.bids(Coin())["Exact"].reason


def test_where_none_can_serve_the_refusal_has_all_reasons(monkeypatch):
    # The package's name for the function hides the module.
    monkeypatch.setitem(inference.choose.__globals__, "ENGINES", [Exact])
    with pytest.raises(Refusal, match=r"no engine can serve RandomWalk:\n.*Exact.*not enumerated"):
        inference.choose(RandomWalk())
