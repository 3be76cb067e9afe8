"""Independent stability methods from other fields, which share no code with the solvers."""

from __future__ import annotations

from falsework.stability.judgement import Judgement as Judgement
from falsework.stability.judges.build_judge import BuildJudge as BuildJudge
from falsework.stability.judges.build_judge import matched_sink as matched_sink
from falsework.stability.judges.discrete_elements import DiscreteElementSettings as DiscreteElementSettings
from falsework.stability.judges.discrete_elements import Settling as Settling
from falsework.stability.judges.discrete_elements import replay_by_discrete_elements as replay_by_discrete_elements
from falsework.stability.judges.discrete_elements import settle as settle
from falsework.stability.judges.lmgc90 import Lmgc90Answer as Lmgc90Answer
from falsework.stability.judges.lmgc90 import judge_by_lmgc90 as judge_by_lmgc90
