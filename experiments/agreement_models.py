"""Small models, one for every kind of structure, on which engines are held against each other."""

# A prev_ argument is a random variable, whatever the type of its first value.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false

from __future__ import annotations

import torch
from pyro.distributions import Bernoulli, Beta, Categorical, Dirichlet, Gamma, Normal, Poisson
from torch import Tensor, ones, tensor, where, zeros

from apmodels import Binary, Box, Finite, Grid, Model, VisualSearch, action, observation, shift, state, static


class Tiger(Model):
    """Behind which door is the tiger?"""

    door = action(Finite(3, ("listen", "open left", "open right")))

    @static
    def tiger(self) -> Bernoulli:
        """0 is left, 1 is right."""
        return Bernoulli(0.5)

    @observation
    def growl(self, tiger, door):
        """From which side."""
        return Bernoulli(where(door == 0, where(tiger == 1, 0.85, 0.15), 0.5))

    interest = tiger


class Street(Model):
    """Is a car coming?  (thesis Fig. 5.2)"""

    look = action(Finite(3, ("left", "right", "cross")))

    @static
    def busy(self) -> Bernoulli:
        """Whether many cars come."""
        return Bernoulli(0.5)

    @state
    def coming(self, busy):
        """Whether a car comes now."""
        return Bernoulli(where(busy == 1, 0.6, 0.1))

    @observation
    def car(self, look, coming, prev_coming=0):
        """Seen ahead, or having passed."""
        there = where(look == 1, coming, prev_coming)
        return Bernoulli(where(look == 2, 0.0, where(there == 1, 0.9, 0.1)))

    interest = coming


class Levers(Model):
    """How often does each of three levers pay?"""

    pull = action(Finite(3))

    @static
    def rates(self):
        """P(win) of each."""
        return Beta(ones(3), 2 * ones(3)).to_event(1)

    @observation
    def win(self, rates, pull):
        """Whether it paid."""
        return Bernoulli(rates[pull])

    interest = rates


class Answers(Model):
    """Is anybody answering me?  (thesis ch. 4)"""

    vocalize = action(Binary())

    @static
    def responsive(self) -> Bernoulli:
        """Whether somebody answers."""
        return Bernoulli(0.4)

    @static
    def rates(self):
        """Sensor rates: my own echo, an answer, the background."""
        return Beta(ones(3), ones(3)).to_event(1)

    @state
    def timer(self, vocalize, prev_timer=4):
        """Steps since I called."""
        return where(vocalize == 1, 0, (prev_timer + 1).clamp(max=4))

    @observation
    def sound(self, responsive, rates, timer):
        """Whether something was heard."""
        answering = (timer >= 1) & (timer <= 3) & (responsive == 1)
        return Bernoulli(rates[where(timer == 0, 0, where(answering, 1, 2))])

    interest = responsive


class Line(Model):
    """Where does a line run?  (Lindley 1956)"""

    at = action(Box(-1.0, 1.0))

    @static
    def line(self):
        """Height and slope."""
        return Normal(zeros(2), tensor([2.0, 1.0])).to_event(1)

    @observation
    def reading(self, line, at):
        """The height where one measures."""
        return Normal(line[0] + line[1] * at, 0.5)

    interest = line


class Drifting(Model):
    """A point that is pushed and drifts, of one of two kinds; affine and Gaussian given its kind."""

    push = action(Box(-1.0, 1.0, (2,)))

    @static
    def heavy(self) -> Bernoulli:
        """Whether pushing moves it little."""
        return Bernoulli(0.5)

    @static
    def start(self):
        """Where it was first."""
        return Normal(zeros(2), 2.0).to_event(1)

    @state
    def place(self, push, heavy, prev_place=start):
        """Where it is."""
        return Normal(0.9 * prev_place + where(heavy == 1, 0.2, 1.0) * push, 0.3).to_event(1)

    @observation
    def seen(self, place):
        """Where it seems to be."""
        return Normal(place, 0.5).to_event(1)

    interest = (heavy, place)


class Ship(Model):
    """Where is a ship that is seen by bearing only?"""

    turn = action(Finite(3, ("port", "ahead", "starboard")))

    @static
    def start(self):
        """Where it was first."""
        return Normal(tensor([2.0, 6.0]), 2.0).to_event(1)

    @state
    def me(self, turn, prev_me=(0.0, 0.0)):
        """Where I am."""
        return prev_me + tensor([[-1.0, 0.5], [0.0, 1.0], [1.0, 0.5]])[turn]

    @state
    def ship(self, prev_ship=start):
        """Where it is."""
        return Normal(prev_ship + tensor([0.3, 0.0]), 0.1).to_event(1)

    @observation
    def bearing(self, ship, me):
        """In which direction it is seen."""
        return Normal(torch.atan2(ship[0] - me[0], ship[1] - me[1]), 0.1)

    interest = ship


class Weather(Model):
    """What is the weather like, by colours whose meaning is unknown, and by drops?"""

    @static
    def palette(self):
        """P(colour | weather), a row each."""
        return Dirichlet(ones(2, 3)).to_event(1)

    @static
    def rate(self):
        """Drops a step."""
        return Gamma(2.0, 1.0)

    @state
    def weather(self, prev_weather=0):
        """0 is dry, 1 is wet."""
        return Bernoulli(where(prev_weather == 1, 0.8, 0.3))

    @observation
    def colour(self, palette, weather):
        """The sky's."""
        return Categorical(palette[weather.long()])

    @observation
    def drops(self, rate):
        """How many."""
        return Poisson(rate)

    interest = (weather, rate)


class Gaze(Model):
    """How do my commands move my eye, and what is out there?  (thesis ch. 6, in small)"""

    blank: Tensor = zeros(2, 3)

    command = action(Finite(2))

    @static
    def actuation(self):
        """Pixels by command, horizontal and vertical."""
        return Normal(zeros(2, 2), 1.0).to_event(2)

    @static
    def picture(self):
        """What is there to see."""
        return Normal(self.blank, 1.0).to_event(2)

    @state
    def motion(self, actuation, command):
        """How far the eye went."""
        return Normal(actuation @ (torch.arange(2) == command).to(actuation.dtype), 0.5).to_event(1)

    @state
    def scene(self, motion, prev_scene=picture):
        """What is before the eye."""
        return Normal(shift(prev_scene, motion), 0.1).to_event(2)

    @observation
    def image(self, scene):
        """What is seen of it."""
        return Normal(shift(scene, zeros(2)), 0.8).to_event(2)

    interest = actuation


def models() -> dict[str, Model]:
    """Return all of them by name."""
    return {
        "tiger": Tiger(),
        "street": Street(),
        "visual_search": VisualSearch(grid=Grid(3, 3)),
        "levers": Levers(),
        "answers": Answers(),
        "line": Line(),
        "drifting": Drifting(),
        "ship": Ship(),
        "weather": Weather(),
        "gaze": Gaze(),
    }
