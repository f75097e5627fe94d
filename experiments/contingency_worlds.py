"""Worlds that are not as an agent believes: who answers late, twice or to everything, and backgrounds in bursts."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from pyro.distributions.torch import Bernoulli  # type: ignore[attr-defined]

from apmodels import Contingency, ValueOutOfRange, observation, state, static
from apmodels.transforms import where

TRUTHS = ("nobody", "somebody")
BURSTY = ("bursty", "answered_bursty")


class Twice(Contingency):
    """Whoever answers does so a second time, as often as the first.

    Args:
        again: first and last step after a call in which the second answer may come; after the window.
    """

    again: tuple[int, int] = (5, 7)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.window[1] < self.again[0] <= self.again[1]:
            raise ValueOutOfRange(f"the second answer must come after step {self.window[1]}, not in {self.again}")

    @state
    def timer(self, vocalize, prev_timer=lambda self: self.again[1] + 1):
        """Steps since the last call, up to the first in which no second answer can come any more."""
        return where(vocalize == 1, 0, (prev_timer + 1).clamp(max=self.again[1] + 1))

    @observation
    def sound(self, responsive, rates, timer):
        """Whether there was a sound."""
        again = (self.again[0] <= timer) & (timer <= self.again[1])
        return super().sound(responsive, rates, where(again, self.window[0], timer))


class Chatterbox(Contingency):
    """Whoever answers does so to every sound: to calls, to the background and to what they said themselves."""

    @state
    def since(self, prev_sound: Any = 0.0, prev_since=lambda self: self.window[1] + 1):
        """Steps since the last sound, up to the first in which no answer to it can come any more."""
        return where(prev_sound == 1, 1, (prev_since + 1).clamp(max=self.window[1] + 1))

    @observation
    def sound(self, responsive, rates, timer, since):
        """Whether there was a sound; the robot's echo covers the rest, as in the model."""
        answering = (timer > self.echo[1]) & (self.window[0] <= since) & (since <= self.window[1])
        return super().sound(responsive, rates, where(answering, self.window[0], timer))


class Bursty(Contingency):
    """The background is a Markov chain of the same rate: bursts and lulls are longer than by chance.

    Args:
        burst: how many times longer; 1 is chance. The chain's autocorrelation is 1 - 1 / burst.
    """

    burst: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.burst < 1:
            raise ValueOutOfRange(f"bursts are 1 or more times as long as by chance, not {self.burst}")

    @static
    def began(self, rates):
        """Whether the background sounded before time began: as often as ever."""
        return Bernoulli(rates[2])

    @state
    def noisy(self, rates, prev_noisy=began):
        """Whether the background sounds."""
        return Bernoulli(rates[2] / self.burst + (1 - 1 / self.burst) * prev_noisy)

    @observation
    def sound(self, responsive, rates, timer, noisy):
        """Whether there was a sound."""
        return super().sound(responsive, torch.cat([rates[:2], noisy[None]]), timer)


@dataclass(frozen=True)
class World:
    """What a session happens in: a model, whether somebody is there, the rates (echo, answers, background).

    ``heard``: an engine can infer by this model; ``planned``: a plan can be made for it; ``strange``: it is not as the
    agent believes.
    """

    name: str
    model: Any
    truth: int
    rates: tuple[float, ...]
    heard: bool = True
    planned: bool = True
    strange: bool = True


def worlds_of(config: Any, model: Any) -> list[World]:
    """Return the worlds of a study; who answers late has another window, and who hears an echo a longer echo."""
    plain = {field.name: getattr(model, field.name) for field in fields(model)}
    rates = tuple(config.rates)
    noisy, talking = (*rates[:2], config.noise), (*rates[:2], config.talk)
    found = [World(f"own.{name}", model, truth, rates, strange=False) for truth, name in enumerate(TRUTHS)]
    found += [World("talker", model, 0, talking, strange=False)]
    found += [World(f"late.{n}", _later(model, n), 1, rates, strange=n > 0) for n in config.late]
    found += [World("twice", Twice(again=tuple(config.again), **plain), 1, rates)]
    # No plan can be made for who remembers sounds, and no engine counts a background that is a chain.
    for chat in config.chats:
        chatting = (rates[0], chat, rates[2])
        found.append(World(f"chatterbox.{chat:g}", Chatterbox(**plain), 1, chatting, planned=False))
    for truth, name in enumerate(BURSTY):
        for burst in config.bursts:
            world = Bursty(burst=float(burst), **plain)
            found.append(World(f"{name}.{burst:g}", world, truth, noisy, False, False, burst > 1))
    return found + [World(f"echo.{n}", _later(model, n, True), 0, rates, strange=n > 0) for n in config.echoes]


def _later(model: Any, steps: int, echoing: bool = False) -> Any:
    """Answers come so much later; the echo ends as much later, or when it did."""
    window, (begin, end) = tuple(step + steps for step in model.window), model.echo
    return model.replace(window=window, echo=(begin, end + steps * echoing))
