"""Actions on site after the last executed step of a plan: props placed, parts held and released."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_id, part_ids
from falsework.assembly.props import keep_props, prop_place, with_props
from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, held_count
from falsework.errors import StateError
from falsework.replanning.executed_steps import ExecutedSteps
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Route
from falsework.stability.verdict import Proof, Verdict


@dataclass(frozen=True)
class SiteSteps:
    """Steps done on site that a plan does not have.

    Props are placed first. Then robots take hold of parts as long as one is free, and let go of others where none is.
    """

    props: Sequence[int | str] = ()
    """Parts under each of which a prop was placed, numbers or names."""
    held: Sequence[int | str] = ()
    """Parts that stand, of which a robot has taken hold."""
    released: Sequence[int | str] = ()
    """Held parts of which the robot has let go."""

    def __len__(self) -> int:
        return len(self.props) + len(self.held) + len(self.released)

    def after(self, plan: Plan, step: int, assembly: Assembly, robots: int | None = None) -> tuple[Plan, Assembly]:
        """Return the steps of a plan that are done, and these after them, all of which are done.

        Args:
            plan: plan that is being carried out.
            step: last of its steps that is done.
            assembly: its structure, with its props.
            robots: parts that can be held at a time; those of the plan if not given.

        Returns:
            A plan without proofs, whose every step is done, and the structure with the new props as its last parts.

        Raises:
            InputError: a part that does not exist, a step that the plan does not have, a part without a place for a
                prop or with one already, or one that cannot be held or released; the message names it.
        """
        ExecutedSteps(plan, step)
        props, held, released = (
            [part_id(part, assembly.names, f"{what} is part") for part in part_ids(parts, assembly.names, what)]
            for what, parts in (("props", self.props), ("held", self.held), ("released", self.released))
        )
        for part in props:
            if plan.states[step, part] == REMOVED:
                name = assembly.names[part]
                raise StateError(
                    f"part {name} is not placed yet, so no prop can stand under it; name one that is there"
                )
        wide = places_under(assembly, props)
        plan = with_places(plan, wide)
        robots = plan.robots if robots is None else robots
        states = [plan.states[step]]
        for part in props:
            states.append(_propped(states[-1], part, wide))
        while held or released:
            busy = int(held_count(states[-1][None], wide.immovable)[0])
            if held and (busy < robots or not released):
                states.append(_turned(states[-1], held.pop(0), INSTALLED, HELD, wide, busy < robots))
            else:
                states.append(_turned(states[-1], released.pop(0), HELD, INSTALLED, wide))
        done = np.concatenate([plan.states[:step], np.array(states, dtype=np.uint8)])
        new = len(states) - 1
        standing = (done[:, _first_prop(wide) :] != REMOVED).sum(axis=1)
        whole = replace(
            plan,
            states=done,
            actions=Route.from_states(done).actions,
            verdicts=(*plan.verdicts[: step + 1], *(Verdict.UNDECIDED,) * new),
            proofs=(*plan.proofs[: step + 1], *(Proof.NONE,) * new),
            residuals=np.append(plan.residuals[: step + 1], np.zeros(new)),
            robots=max(plan.robots, robots),
            allow_regrasp=True,
            prop_limit=max(plan.prop_limit, int(standing.max(initial=0))),
            presses=(*(plan.presses or ((),) * len(plan))[:step], *((),) * new),
            loads=(),
            replay=None,
            exit_paths=(*plan.exit_paths[:step], *((),) * new) if plan.exit_paths else (),
        )
        return whole, wide


def with_places(plan: Plan, assembly: Assembly) -> Plan:
    """Return a plan with the places for props of a structure that has more of them; it uses none of the new ones."""
    more = assembly.part_count - len(plan.boundary)
    if not more:
        return plan
    states = np.pad(plan.states, ((0, 0), (0, more)))
    return replace(
        plan,
        states=states,
        actions=Route.from_states(states).actions,
        identity=assembly.identity,
        part_names=tuple(assembly.names),
        boundary=assembly.boundary,
        props=assembly.props,
        forces=None,
        displacement=None,
        torn=None,
    )


def _first_prop(assembly: Assembly) -> int:
    return assembly.part_count - len(assembly.props)


def places_under(assembly: Assembly, parts: Sequence[int]) -> Assembly:
    """Return a structure with a place for a prop under each of some parts; the new ones are its last parts."""
    known = {prop.part for prop in assembly.props}
    plain = keep_props(assembly, ())
    new = [prop_place(plain, part) for part in dict.fromkeys(parts) if part not in known]
    return with_props(plain, [*assembly.props, *new]) if new else assembly


def _propped(state: States, part: int, assembly: Assembly) -> States:
    """Return a state with the prop under a part in place."""
    name, place = assembly.names[part], _first_prop(assembly) + [prop.part for prop in assembly.props].index(part)
    if state[place] != REMOVED:
        raise StateError(f"a prop stands under part {name} already; name another part")
    after = state.copy()
    after[place] = HELD
    return after


def _turned(state: States, part: int, old: int, new: int, assembly: Assembly, free: bool = True) -> States:
    """Return a state in which a robot has taken hold of a part, or let go of it."""
    name = assembly.names[part]
    if state[part] != old or assembly.immovable[part]:
        is_ = "fixed" if assembly.immovable[part] else ("not placed yet", "not held", "held already")[state[part]]
        raise StateError(f"part {name} is {is_}, so no robot can {_DOES[new]} it; leave it out")
    if not free:
        others = ", ".join(assembly.names[k] for k in np.flatnonzero((state == HELD) & ~assembly.immovable))
        raise StateError(f"no robot is free to hold part {name}: {others} are held; release one of them too")
    after = state.copy()
    after[part] = new
    return after


_DOES = {HELD: "take hold of", INSTALLED: "let go of"}
