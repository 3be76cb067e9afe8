"""Plan of loose parts for a plan in which groups of parts are one part each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework.assembly.groups import Groups
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Route
from falsework.stability.holds import HoldMode, Press
from falsework.stability.verdict import Proof, Verdict


def loose_plan(plan: Plan, groups: Groups) -> Plan:
    """Return the plan, without proofs, in which a step that inserts a joined part inserts all parts of the group.

    A robot then holds the first of them and carries the others: whether they stay where they are, and whether the
    states stand, is for a check of this plan to say.

    Args:
        plan: of the structure with joined parts.
        groups: `Assembly.groups` of that.
    """
    loose, carrier = groups.loose, groups.carrier.tolist()
    states, count = groups.loosen(plan.states), len(plan.states)
    largest = int(np.bincount(groups.joined).max())
    members = [tuple(np.flatnonzero(groups.joined == part).tolist()) for part in range(len(carrier))]
    ways = tuple(
        tuple(replace(move, parts=tuple(one for part in move.parts for one in members[part])) for move in way)
        for way in plan.exit_paths
    )

    def loosened(press: Press) -> Press:
        force, moment = np.array(press.wrench[:3]), np.array(press.wrench[3:])
        if plan.claim.holds.mode is HoldMode.FORCE:  # else moments are what keeps the pose across the force
            own, mass = loose.mass, loose.mass.mass[list(members[press.part])]
            center = mass @ own.center[list(members[press.part])] / mass.sum()
            moment = moment + np.cross(center - own.center[carrier[press.part]], force)
        return Press(carrier[press.part], (*force.tolist(), *moment.tolist()))

    return replace(
        plan,
        states=states,
        actions=Route.from_states(states[::-1]).actions[::-1].copy(),
        verdicts=(Verdict.UNDECIDED,) * count,
        proofs=(Proof.NONE,) * count,
        residuals=plan.residuals,
        identity=loose.identity,
        part_names=tuple(loose.names),
        boundary=loose.boundary,
        fixed=tuple(part for part in range(loose.part_count) if int(groups.joined[part]) in plan.fixed),
        missing=tuple(carrier[part] for part in plan.missing),
        removable_only_if_clear=True,
        parts_at_once=max(largest, plan.parts_at_once),
        exit_paths=ways,
        presses=tuple(tuple(map(loosened, presses)) for presses in plan.presses),
        loads=(),
        replay=None,
        margins=None,
        forces=None,
        displacement=None,
        torn=None,
        source=None,
    )
