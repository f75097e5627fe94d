"""Small models that several tests share; at the top of a module, so that they pickle."""

import torch
from pyro.distributions import Bernoulli, Categorical, Dirichlet, Gamma, Normal, Poisson
from torch import Tensor

from apmodels import (
    Binary,
    Box,
    Finite,
    Model,
    action,
    interest,
    observation,
    ones,
    shift,
    state,
    static,
    where,
    window,
    zeros,
)

BLANK = zeros(4, 5)


class RandomWalk(Model):
    """Where has it drifted to?  Nothing to do but look."""

    drift: float = 0.5
    noise: float = 1.0

    @state
    def position(self, prev_position=0.0):
        return Normal(prev_position, self.drift)

    @observation
    def reading(self, position):
        return Normal(position, self.noise)

    interest = position


class Tracking(Model):
    """A point on a plane, from an unknown place, pushed by an action and seen through a matrix."""

    view: Tensor = torch.tensor([[1.0, 0.5], [0.0, 2.0], [1.0, -1.0]])

    push = action(Box(-1.0, 1.0, (2,)))

    @static
    def start(self):
        return Normal(zeros(2), 2.0).to_event(1)

    @state
    def place(self, push, prev_place=start):
        return Normal(0.9 * prev_place + push, 0.3).to_event(1)

    @observation
    def seen(self, place):
        return Normal(self.view @ place, 0.5).to_event(1)

    interest = place


class Weather(Model):
    """A hidden Markov chain with unknown tables: what is counted, and what is enumerated."""

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
        return Bernoulli(where(prev_weather == 1, 0.8, 0.3))

    @observation
    def colour(self, palette, weather):
        return Categorical(palette[weather.long()])

    @observation
    def drops(self, rate):
        return Poisson(rate)


class LearningToLook(Model):
    """How do my commands move my eye, and what is out there?  (thesis ch. 6, in small)"""

    command = action(Finite(3))

    @static
    def first_actuation(self):
        return Normal(zeros(2, 3), 5.0).to_event(2)

    @state
    def actuation(self, prev_actuation=first_actuation):
        return Normal(prev_actuation, 0.1).to_event(2)

    @state
    def motion(self, actuation, command):
        return Normal(actuation @ (torch.arange(3) == command).to(actuation.dtype), 0.5).to_event(1)

    @state
    def scene(self, motion, prev_scene=BLANK):
        return Normal(shift(prev_scene, motion), 0.01).to_event(2)

    @observation
    def image(self, scene):
        return Normal(self.view(scene), 0.1).to_event(2)

    def view(self, scene):
        return window(scene, torch.tensor([1, 1]), (2, 3))

    interest = actuation


class Coin(Model):
    """Is the coin biased, and how is it read? Two statics, one under the other; two observations; no action."""

    @static
    def biased(self):
        return Bernoulli(0.3)

    @static
    def reader(self, biased):
        return Categorical(where(biased == 1, torch.tensor([0.1, 0.2, 0.7]), torch.tensor([0.5, 0.3, 0.2])))

    @observation
    def toss(self, biased):
        return Bernoulli(0.5 + 0.4 * biased)

    @observation
    def reading(self, reader, biased):
        return Normal(reader * (1 + biased), 1.5)

    interest = biased


class Seasons(Model):
    """One hidden Markov state and a Gaussian observation; no action."""

    stay: float = 0.8

    @state
    def weather(self, prev_weather=1):
        other = (1 - self.stay) / 2
        return Categorical(torch.where(torch.arange(3) == prev_weather, self.stay, other))

    @observation
    def warmth(self, weather):
        return Normal(2.0 * weather, 1.0 + 0.5 * weather)


class Door(Model):
    """A hidden state that an action moves, seen through Bernoulli noise."""

    push = action(Binary())

    @state
    def is_open(self, push, prev_is_open=0):
        return Bernoulli(where(push == 1, 0.9, 0.1 + 0.7 * prev_is_open))

    @observation
    def light(self, is_open):
        return Bernoulli(0.2 + 0.7 * is_open)

    interest = is_open


class Coupled(Model):
    """Two states that drive each other, under a static, an action and what was done and heard before."""

    move = action(Finite(3))

    @static
    def kind(self):
        return Bernoulli(0.4)

    @state
    def near(self, kind, move, prev_near=0, prev_far=1, prev_move=0):
        return Bernoulli(0.1 + 0.2 * prev_near + 0.1 * prev_far + 0.1 * move + 0.1 * kind + 0.05 * prev_move)

    @state
    def far(self, near, prev_far=1, prev_sound=0):
        return Bernoulli(0.15 + 0.3 * near + 0.2 * prev_far + 0.25 * prev_sound)

    @observation
    def sound(self, near, far):
        return Bernoulli(0.1 + 0.3 * near + 0.5 * far)

    interest = (near, kind)


class Counter(Model):
    """A hidden deterministic state that is remembered, and one that is not; hidden noise that nobody remembers."""

    @state
    def tick(self):
        return Bernoulli(0.6)

    @state
    def count(self, tick, prev_count=0):
        return (prev_count + tick.long()) % 3

    @state
    def odd(self, count):
        return count % 2

    @observation
    def sign(self, count, odd):
        return Categorical(torch.tensor([[0.7, 0.2, 0.1], [0.2, 0.5, 0.3], [0.1, 0.1, 0.8]])[count] + 0.2 * odd)

    interest = count


class Caller(Model):
    """Is anybody answering? A known timer between an action and what is heard (chapter 4, rates known)."""

    presence: float = 0.5

    vocalize = action(Binary())

    @static
    def responsive(self):
        return Bernoulli(self.presence)

    @state
    def timer(self, vocalize, prev_timer=4):
        return where(vocalize == 1, 0, (prev_timer + 1).clamp(max=4))

    @observation
    def sound(self, responsive, timer):
        answering = (timer >= 1) & (timer <= 3) & (responsive == 1)
        return Bernoulli(where(timer == 0, 0.9, where(answering, 0.6, 0.2)))

    interest = responsive


class Drift(Model):
    """A hidden state that begins as a static, and an observation of the change since a step ago."""

    @static
    def home(self):
        return Categorical(torch.tensor([0.2, 0.5, 0.3]))

    @state
    def place(self, home, prev_place=home):
        return Categorical(1.0 + 3.0 * (torch.arange(3) == prev_place) + (torch.arange(3) == home))

    @observation
    def jump(self, place, prev_place=home):
        return Normal(1.0 * (place - prev_place), 0.5)

    interest = (home, place)


class Twins(Model):
    """Two actions and two observations, so that dicts go in and out; the interest is a function of variables."""

    left = action(Binary())
    right = action(Finite(3))

    @static
    def a(self):
        return Categorical(torch.tensor([0.5, 0.3, 0.2]))

    @static
    def b(self):
        return Bernoulli(0.5)

    @observation
    def here(self, a, left):
        return Bernoulli(where(left == 1, 0.2 + 0.3 * a, 0.5))

    @observation
    def there(self, b, a, right):
        return Categorical(1.0 + b * (torch.arange(3) == right) + a * (torch.arange(3) == 0))

    @interest
    def interest(self, a, b):
        return (a + b.long()) % 2


class Lamp(Model):
    """Which cell is lit? The observation is finite, and one look tells the more the nearer it is."""

    cells: int = 4

    look = action(lambda self: Finite(self.cells))

    @static
    def lit(self):
        return Categorical(1.0 + torch.arange(self.cells))

    @observation
    def flash(self, lit, look):
        return Bernoulli(where(lit == look, 0.9, 0.2 + 0.05 * look))

    interest = lit


class Dial(Model):
    """A continuous action: how far to turn towards a source that is left or right."""

    turn = action(Box(-1.0, 1.0))

    @static
    def side(self):
        return Bernoulli(0.5)

    @observation
    def loudness(self, side, turn):
        return Normal(turn * (2 * side - 1), 0.5)
