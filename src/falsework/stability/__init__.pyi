from falsework.stability.contact.press_oracle import PressOracle as PressOracle
from falsework.stability.exact_solver import ExactSolver as ExactSolver
from falsework.stability.holds import HoldSettings as HoldSettings
from falsework.stability.margins.state_margins import StateMargins as StateMargins
from falsework.stability.settings import NumericalSettings as NumericalSettings
from falsework.stability.verdict import Proof as Proof
from falsework.stability.verdict import Verdicts as Verdicts
