"""apmodels: declare a generative model once; infer, control and act with it.

A model is a class, a random variable is a method, its parents are its arguments. The models of the thesis are
here too, one file each.
"""

from apmodels.acuity import Acuity as Acuity
from apmodels.acuity import Calibrated as Calibrated
from apmodels.acuity import Camera as Camera
from apmodels.acuity import Exponential as Exponential
from apmodels.acuity import Human as Human
from apmodels.acuity import HumanContrast as HumanContrast
from apmodels.blinding_search import BlindingSearch as BlindingSearch
from apmodels.contingency import Contingency as Contingency
from apmodels.detector_search import CountModel as CountModel
from apmodels.detector_search import DetectorSearch as DetectorSearch
from apmodels.errors import DeclarationError as DeclarationError
from apmodels.errors import ValueOutOfRange as ValueOutOfRange
from apmodels.evidence import Evidence as Evidence
from apmodels.kidnapped import Kidnapped as Kidnapped
from apmodels.learning_to_look import LearningToLook as LearningToLook
from apmodels.model import Model as Model
from apmodels.motor_dynamics import MotorDynamics as MotorDynamics
from apmodels.motor_noise import MotorErrors as MotorErrors
from apmodels.motor_noise import MotorNoise as MotorNoise
from apmodels.motor_noise import NoisyMotors as NoisyMotors
from apmodels.planted import Planted as Planted
from apmodels.spaces import Binary as Binary
from apmodels.spaces import Box as Box
from apmodels.spaces import Finite as Finite
from apmodels.spaces import Grid as Grid
from apmodels.spaces import Space as Space
from apmodels.transforms import ones as ones
from apmodels.transforms import shift as shift
from apmodels.transforms import where as where
from apmodels.transforms import window as window
from apmodels.transforms import zeros as zeros
from apmodels.uncertain_window import UncertainWindow as UncertainWindow
from apmodels.variables import action as action
from apmodels.variables import interest as interest
from apmodels.variables import observation as observation
from apmodels.variables import state as state
from apmodels.variables import static as static
from apmodels.visual_search import VisualSearch as VisualSearch
from apmodels.wandering_search import WanderingSearch as WanderingSearch
