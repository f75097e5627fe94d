"""Controllers: a belief becomes an action."""

from controllers.belief_mdp import belief_mdp as belief_mdp
from controllers.constant import Constant as Constant
from controllers.controller import Controller as Controller
from controllers.dynamic_programming import DynamicProgramming as DynamicProgramming
from controllers.greedy_infomax import GreedyInfomax as GreedyInfomax
from controllers.handover import Handover as Handover
from controllers.most_probable import MostProbable as MostProbable
from controllers.playback import Playback as Playback
from controllers.random import Random as Random
from controllers.receding_horizon import RecedingHorizon as RecedingHorizon
from controllers.rewards import Information as Information
from controllers.rollout import rollout as rollout
from controllers.temporal_difference import TemporalDifference as TemporalDifference
