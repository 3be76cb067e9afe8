"""Does a partial structure stand while robots hold some of its parts? With a proof either way."""

from falsework.stability.certificate import Claim as Claim
from falsework.stability.certificate import accept as accept
from falsework.stability.contact.replay import Replay as Replay
from falsework.stability.contact.replay import Replayer as Replayer
from falsework.stability.contact.replay import ReplaySettings as ReplaySettings
from falsework.stability.oracle import Counters as Counters
from falsework.stability.oracle import Stability as Stability
from falsework.stability.problem import Problem as Problem
from falsework.stability.problem import build_problem as build_problem
from falsework.stability.reference.clarabel import ExactSolver as ExactSolver
from falsework.stability.reference.gurobi import GurobiSolver as GurobiSolver
from falsework.stability.settings import CpuSettings as CpuSettings
from falsework.stability.settings import StabilitySettings as StabilitySettings
from falsework.stability.verdict import Criterion as Criterion
from falsework.stability.verdict import Proof as Proof
from falsework.stability.verdict import Solver as Solver
from falsework.stability.verdict import Verdict as Verdict
from falsework.stability.verdict import Verdicts as Verdicts
