"""Engines: a model and a history become a belief."""

from inference.beliefs import Belief as Belief
from inference.beliefs import FiniteBelief as FiniteBelief
from inference.beliefs import Marginal as Marginal
from inference.check import Report as Report
from inference.check import check as check
from inference.choose import bids as bids
from inference.choose import choose as choose
from inference.choose import explain as explain
from inference.engine import Bid as Bid
from inference.engine import Engine as Engine
from inference.engine import Refusal as Refusal
from inference.exact import Exact as Exact
from inference.fit import Fit as Fit
from inference.fit import fit as fit
from inference.kalman import Kalman as Kalman
from inference.particles import Particles as Particles
from inference.rao_blackwell import DepletionWarning as DepletionWarning
from inference.rao_blackwell import RaoBlackwell as RaoBlackwell
from inference.variational import Variational as Variational
