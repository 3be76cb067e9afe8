from falsework.stability.contact.press_oracle import PressOracle as PressOracle
from falsework.stability.holds import HoldSettings as HoldSettings
from falsework.stability.margins.state_margins import StateMargins as StateMargins
from falsework.stability.reference.clarabel import ExactSolver as ExactSolver
from falsework.stability.settings import CpuSettings as CpuSettings
from falsework.stability.settings import GpuSettings as GpuSettings
from falsework.stability.verdict import Proof as Proof
from falsework.stability.verdict import Verdicts as Verdicts
