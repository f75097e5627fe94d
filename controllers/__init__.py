"""Controllers: a belief becomes an action."""

from controllers.constant import Constant as Constant
from controllers.controller import Controller as Controller
from controllers.greedy_infomax import GreedyInfomax as GreedyInfomax
from controllers.most_probable import MostProbable as MostProbable
from controllers.playback import Playback as Playback
from controllers.random import Random as Random
from controllers.rollout import rollout as rollout
