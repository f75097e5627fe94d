"""What is replayed gives the numbers that calling gives; what cannot be recorded is called."""

import pytest
import torch
from pyro.distributions import Categorical, Normal

from apmodels import Model, ValueOutOfRange, observation, state
from inference import Particles
from inference.records import recording
from inference.records.recording import Recorder, recorded


def arithmetic(x, y):
    noise = torch.randn(3)
    still = torch.zeros(3).expand(2, 3) + 1
    return (x.view(3) * 2 + still).exp(), noise + y.sum()


def test_a_recording_gives_the_same_numbers_and_draws():
    x, y = torch.tensor([[0.1, 0.2, 0.3]]), torch.ones(4)
    replay = recorded(arithmetic, (x, y))
    assert replay is not None
    for seed in (1, 2):
        torch.manual_seed(seed)
        expected = arithmetic(x + seed, y)
        torch.manual_seed(seed)
        assert all(torch.equal(a, b) for a, b in zip(replay(x + seed, y), expected, strict=True))


def test_what_asks_for_a_value_is_not_recorded():
    assert recorded(lambda x: (x * 2 if float(x.sum()) > 0 else x,), (torch.ones(2),)) is None


def test_a_recorder_replays_after_a_while_and_tells_shapes_apart(monkeypatch):
    monkeypatch.setattr(recording, "PATIENCE", 0.0)
    calls = []

    def double(x):
        calls.append(x.shape)
        return (x * 2,)

    recorder = Recorder(double)
    for _ in range(5):
        assert torch.equal(recorder(torch.ones(2))[0], torch.full((2,), 2.0))
    many = len(calls)
    recorder(torch.ones(2))
    assert len(calls) == many
    assert recorder(torch.ones(3))[0].shape == (3,)
    weight = torch.ones(2, requires_grad=True)
    assert recorder(weight)[0].requires_grad


class Wandering(Model):
    """A place and a mood, both of them drawn; the spread of the place gets out of range in the end."""

    last: float = 1000.0

    @state
    def clock(self, prev_clock=0.0):
        return prev_clock + 1.0

    @state
    def mood(self, prev_mood=0):
        return Categorical(torch.tensor([[0.8, 0.2], [0.3, 0.7]])[prev_mood])

    @state
    def place(self, mood, clock, prev_place=0.0):
        return Normal(prev_place.sin() + mood, 1.0 - clock / self.last)

    @observation
    def reading(self, place):
        return Normal(place, 2.0)


def test_particles_led_by_a_recording_are_those_of_step_by_step(monkeypatch):
    monkeypatch.setattr(recording, "PATIENCE", 0.0)
    engine = Particles(Wandering(), particles=50, guided=False)
    seen = torch.randn(12, generator=torch.Generator().manual_seed(0))
    for _ in range(2):
        along = engine.filter(None, seen)
    assert all(r is not None for s in engine._swarm.recorders.values() for r in s.replays.values())
    belief = engine.start()
    for t in range(12):
        belief = engine.update(belief, None, seen[t])
        assert torch.equal(along[t].values["place"], belief.values["place"])
        assert torch.equal(along[t].log_evidence, belief.log_evidence)


def test_a_spread_that_gets_out_of_range_is_told_of_as_ever(monkeypatch):
    monkeypatch.setattr(recording, "PATIENCE", 0.0)
    wild = Particles(Wandering(last=100.0), particles=200, guided=False)
    for _ in range(2):
        with pytest.raises(ValueOutOfRange, match=r"Wandering.place is Normal with scale"):
            wild.filter(None, torch.zeros(120))
