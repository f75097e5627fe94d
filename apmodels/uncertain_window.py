"""Is anybody answering me, however briefly?  Contingency where it is not known how long answers last."""

from __future__ import annotations

import torch
from pyro.distributions.torch import Bernoulli, Categorical  # type: ignore[attr-defined]

from apmodels.contingency import Contingency
from apmodels.transforms import where
from apmodels.variables import observation, static


class UncertainWindow(Contingency):
    """As ``Contingency``, but answers may be over before the window is: nobody knows how long they last.

    Short answers fill little of a long window, so that there their rate is low and hard to tell from the background's.
    Here the last step in which they are heard is found out with the rest; all are equally probable.
    """

    @static
    def lasting(self):
        """For how many steps more than one answers may be heard."""
        return Categorical(torch.ones(self.window[1] - self.window[0] + 1))

    @observation
    def sound(self, responsive, rates, timer, lasting):
        """Whether there was a sound."""
        echoing = (self.echo[0] <= timer) & (timer <= self.echo[1])
        answering = (self.window[0] <= timer) & (timer <= self.window[0] + lasting) & (responsive == 1)
        return Bernoulli(rates[where(echoing, 0, where(answering, 1, 2))])
