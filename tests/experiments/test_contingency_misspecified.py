"""The study of worlds that are not as believed: by the command, and its worlds against counting by hand."""

import numpy as np
import pytest
import torch
from scipy.special import betaln, expit, logit

from apmodels import Contingency, ValueOutOfRange
from experiments.contingency_worlds import Bursty, Chatterbox, Twice
from hardware import Simulated
from inference import Exact
from tests.experiments.test_cli import apmodels, one_sentence
from tests.experiments.test_contingency_studies import run

RATES = torch.tensor([0.9, 0.8, 0.25])


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return run(tmp_path_factory.mktemp("misspecified"), "misspecified", "quick=true")


def test_where_the_world_is_as_believed_the_belief_is_calibrated(study):
    found, data, _ = study
    assert abs(found["calibration.excess"]) < 4 * found["calibration.excess.se"]
    assert found["calibration.entropy"] < -(0.01 * np.log2(0.01) + 0.99 * np.log2(0.99))
    own = data.truth.sel(rates="drawn", agent="planned")
    somebody, nobody = own.sel(world="own.somebody"), 1 - own.sel(world="own.nobody")
    # Over the prior, P(responsive) stays what it was.
    error = (0.01**2 * somebody.var() + 0.99**2 * nobody.var()) / somebody.size
    assert abs(0.01 * somebody.mean() + 0.99 * nobody.mean() - 0.01) < 4 * error**0.5


def test_who_is_not_late_is_as_believed_and_an_echo_can_be_an_answer(study):
    _, data, _ = study
    planned = data.sel(rates="fixed", agent="planned")
    for name in ("truth", "calls", "surprise"):
        assert np.array_equal(planned[name].sel(world="late.0"), planned[name].sel(world="own.somebody"))
    # An echo of three steps more, as loud as answers would be, is what answers are: the agent believes the same.
    np.testing.assert_allclose(1 - planned.truth.sel(world="echo.3"), planned.truth.sel(world="own.somebody"))
    for world in ("own.somebody", "own.nobody", "talker", "late.0"):
        there = data.truth.sel(rates="fixed", world=world)
        assert np.array_equal(there.sel(agent="knower"), there.sel(agent="planned"))
        np.testing.assert_allclose(there.sel(agent="listener"), there.sel(agent="planned"))


def test_bursts_of_chance_are_no_bursts(study):
    found, data, _ = study
    chance, other = data.truth.sel(rates="drawn", agent="planned", world=["bursty.1", "own.nobody"])
    assert abs(chance.mean() - other.mean()) < 4 * ((chance.var() + other.var()) / chance.size) ** 0.5
    assert found["answered_bursty.1.planned.truth"] < found["own.somebody.planned.truth"]


def test_it_is_the_inference_that_is_wrong_and_not_the_control(study):
    found, data, said = study
    # Who hears the same, and knows the world, is mistaken less often.
    for world in ("late.1", "late.2", "late.3", "twice", "echo.2", "echo.3"):
        planned, listener = found[f"{world}.planned.mistaken"], found[f"{world}.listener.mistaken"]
        assert planned - listener > 3 * found[f"{world}.planned.mistaken.se"], world
    assert found["lost_by_inference"] > 10 * found["lost_by_control"] > 0
    # Of the mistaken hardly any fall silent; they call as often as those who know.
    assert 0 <= found["planned.in_the_sand"] < 0.1 * found["planned.mistaken"]
    assert found["planned.calls"] > 0.9 * found["knower.calls"]
    assert "head in the sand" in said and "late 0/1/2/3/4/5" in said
    fixed = data.sel(rates="fixed", agent="planned")
    assert np.array_equal(fixed.in_the_sand, fixed.mistaken * (fixed.late_calls == 0))
    assert np.array_equal(fixed.right + fixed.wrong + fixed.undecided, np.ones_like(fixed.right))
    rhythm = data.sel(rates="fixed", agent="every_5").calls
    assert (rhythm == len(range(0, int(data.attrs["steps"]), 5))).all()


@pytest.mark.slow
def test_a_seed_says_all(tmp_path):
    words = ("quick=true", "late=[2]", "bursts=[4]", "echoes=[1]", "chats=[]", "every=[6]")
    first, again, other = (run(tmp_path, "misspecified", *words, f"seed={seed}")[0] for seed in (3, 3, 4))
    assert first == again != other and first.keys() == other.keys()
    assert "late.2.every_6.mistaken" in first and not any(key.startswith("chatterbox") for key in first)


# What a step can tell of, by hand: 0 the echo, 1 an answer, 2 the background; if somebody is there, and if nobody is.


def told(calls, sounds, answered, chatters):
    kinds = np.full(calls.shape, 2)
    for i, (row, heard) in enumerate(zip(calls, sounds, strict=True)):
        for t in range(len(row)):
            ago = next((k for k in range(t + 1) if row[t - k]), None)
            sound = next((k for k in range(1, t + 1) if heard[t - k]), None)
            if ago in answered or (chatters and sound in answered):
                kinds[i, t] = 1
            if ago == 0:
                kinds[i, t] = 0
    return kinds


def by_hand(calls, sounds, kinds, presence):
    """P(responsive) in the end, by the Beta functions of what was counted."""
    evidence = []
    for of in (np.where(kinds == 1, 2, kinds), kinds):
        ones = np.stack([((of == k) & (sounds == 1)).sum(1) for k in range(3)], 1)
        zeros = np.stack([((of == k) & (sounds == 0)).sum(1) for k in range(3)], 1)
        evidence.append(betaln(1 + ones, 1 + zeros).sum(1))
    return expit(logit(presence) + evidence[1] - evidence[0])


@pytest.mark.parametrize(
    ("model", "answered", "chatters"),
    [
        (Contingency(), {1, 2, 3}, False),
        (Contingency(window=(3, 5)), {3, 4, 5}, False),
        (Twice(), {1, 2, 3, 5, 6, 7}, False),
        (Twice(again=(4, 4)), {1, 2, 3, 4}, False),
        (Chatterbox(), {1, 2, 3}, True),
    ],
)
def test_worlds_sound_and_are_inferred_as_declared(model, answered, chatters):
    torch.manual_seed(0)
    calls = (torch.rand(400, 50) < 0.12).long()
    record = model.simulate(50, calls, 400, seed=1, given={"responsive": 1.0, "rates": RATES})
    sounds, calls = record["sound"].numpy(), calls.numpy()
    kinds = told(calls, sounds, answered, chatters)
    for kind, rate in enumerate(RATES.tolist()):
        heard = sounds[kinds == kind]
        assert abs(heard.mean() - rate) < 4 * (rate * (1 - rate) / heard.size) ** 0.5
    beliefs = Exact(model, torch.float64).filter(torch.as_tensor(calls), torch.as_tensor(sounds), batch=400)
    expected = by_hand(calls, sounds, kinds, model.presence)
    np.testing.assert_allclose(beliefs[-1].marginal("responsive").probs[:, 1], expected, rtol=1e-8)


@pytest.mark.parametrize("burst", [1.0, 2.0, 8.0])
def test_bursts_are_as_long_as_said_and_as_often(burst):
    body = Simulated(Bursty(burst=burst), 4000, {"responsive": 0.0, "rates": torch.tensor([1.0, 1.0, 0.3])})
    body.reset(2)
    sounds = torch.stack([body.step(torch.tensor(0)) for _ in range(40)], 1).numpy()
    assert abs(sounds.mean(1).mean() - 0.3) < 4 * sounds.mean(1).std() / 4000**0.5
    # A burst ends with probability 0.7 / burst.
    ends = 1 - sounds[:, 1:][sounds[:, :-1] == 1]
    rate = 0.7 / burst
    assert abs(ends.mean() - rate) < 4 * (rate * (1 - rate) / ends.size) ** 0.5


def test_worlds_that_cannot_be():
    with pytest.raises(ValueOutOfRange, match="second answer must come after step 3"):
        Twice(again=(3, 5))
    with pytest.raises(ValueOutOfRange, match="1 or more times"):
        Bursty(burst=0.5)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("episodes=1",), "2 episodes"),
        (("every=[0]",), "every must be"),
        (("rates=[0.9,0.9]",), "rates must be three"),
        (("noise=1.5",), "rates must be three"),
        (("decided=0.3",), "decided must lie"),
        (("late=[-1]",), "0 or more"),
        (("again=[2,5]",), "second answer"),
        (("bursts=[0.5]",), "bursts are 1 or more"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(tmp_path, words, says):
    code, _, complaint = apmodels(tmp_path, "experiment=contingency/misspecified", *words)
    assert code == 2 and one_sentence(complaint) and says in complaint
