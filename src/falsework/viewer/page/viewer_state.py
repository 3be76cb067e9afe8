"""State of the page independent of the browser: position, selection, marks, proofs and new plans."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, States, action_mask, empty_state
from falsework.errors import InputError
from falsework.replanning.since import places_under
from falsework.search.problem.rollout import follow_scores
from falsework.search.problem.task import Direction, Task
from falsework.search.task_rules import exit_rules
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion
from falsework.viewer.appearance import Appearance, SceneView, appearance_at, pick
from falsework.viewer.arms import ArmPoses, Arms, appearance_with_arms
from falsework.viewer.clock import Clock
from falsework.viewer.page.disruption import ClickMode, Disruption, chance_of_parts
from falsework.viewer.page.new_plan import NewPlan, new_plan
from falsework.viewer.palette import FIXED, SELECTED
from falsework.viewer.proof import ProofCache, StateProof
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.replanning.policy_guide import PolicyGuide
    from falsework.search.plans.plan import Plan
    from falsework.search.problem.state_graph import StateGraph


class ViewerState:
    """State of one page. Its methods are thread-safe: each takes the lock."""

    def __init__(
        self,
        timeline: Timeline,
        *,
        plan: Plan | None = None,
        policy: Any = None,
        graph: StateGraph | None = None,
        arms: Arms | None = None,
        criterion: Criterion = "contact",
        deadline: float | None = 60.0,
    ) -> None:
        """Show a timeline.

        Args:
            arms: robots that execute the plan, in the same order as the timeline.
            deadline: time limit for a new plan, s; None for no limit.
        """
        self.lock = threading.RLock()
        self.timeline = timeline
        self._unmarked = timeline
        """The timeline without places for the props that are marked."""
        self.plan = plan
        self.built = 0
        """Steps that are done and not in the plan; the timeline begins with them."""
        self.policy = policy
        self.graph = graph
        self.arms = arms
        self.position = self.seconds = 0.0
        self.rewind()
        self.tool = ClickMode.LOOK
        self.selected: int | None = None
        self.disruption = Disruption(robots=timeline.robots)
        self.view = SceneView()
        self.show_probabilities = policy is not None
        self.deadline = deadline
        self.criterion: Criterion = criterion
        self._oracles: dict[tuple[str, StabilitySettings], StabilityOracle] = {}
        self._proofs = ProofCache(contact=self.criterion == "contact")
        self._guide: PolicyGuide | None = None
        self._before: list[tuple[Timeline, Plan | None, int, Disruption, float, Arms | None]] = []

    @property
    def assembly(self) -> Assembly:
        """The structure."""
        return self.timeline.assembly

    @property
    def oracle(self) -> StabilityOracle:
        """Stability oracle of the structure under the gravity of the plan, created at first use."""
        claim = None if self.plan is None else self.plan.claim
        settings = StabilitySettings(criterion=self.criterion).under_gravity_of(claim)
        key = self.assembly.identity, settings
        if key not in self._oracles:
            self._oracles[key] = StabilityOracle(self.assembly, settings)
        return self._oracles[key]

    @property
    def direction(self) -> Direction:
        """Order in which the plan is shown."""
        return self.timeline.direction

    @property
    def state(self) -> States:
        """State that the plan has reached, shape (parts,)."""
        return self.timeline.states[self.timeline.row(self.position)]

    @property
    def site(self) -> States:
        """State on site according to the marks, shape (parts,)."""
        return self.disruption.applied_to(self.state, self.assembly)

    @property
    def clock(self) -> Clock | None:
        """Times of the motions; None without arms."""
        return None if self.arms is None else self.arms.clock

    @property
    def step(self) -> int:
        """Place that the step in progress leads to; with arms, where several are, the last that is reached."""
        return (self.timeline.row if self.clock else self.timeline.next)(self.position)

    @property
    def reading(self) -> float:
        """Position of the slider: seconds of the motions, or steps without arms."""
        return self.position if self.clock is None else self.seconds

    @property
    def last_reading(self) -> float:
        """End of the slider, seconds or steps."""
        return float(len(self.timeline)) if self.clock is None else self.clock.makespan

    @property
    def unproven(self) -> bool:
        """Whether no plan has proven the state shown: there is no plan, or marks change it."""
        return not self.disruption.empty or len(self.timeline) == 0

    def go_to(self, position: float) -> None:
        """Show another position, in steps; clipped to the ends."""
        with self.lock:
            self.position = min(max(float(position), 0.0), float(len(self.timeline)))
            self.seconds = 0.0 if self.clock is None else self.clock.seconds(self.position)

    def rewind(self) -> None:
        """Show the beginning, in the order shown; with arms, that of their motions."""
        if self.clock is None:
            self.go_to(self.timeline.begin)
        else:
            self.go_to_reading(0.0)

    def go_to_reading(self, reading: float) -> None:
        """Show another position, in seconds of the motions, or steps without arms; clipped to the ends."""
        with self.lock:
            if self.clock is None:
                self.go_to(reading)
            else:
                self.seconds = min(max(float(reading), 0.0), self.clock.makespan)
                self.position = self.clock.position(self.seconds)

    @property
    def at_end(self) -> bool:
        """Whether the place that is shown last is reached."""
        return self.reading == (self.timeline.end if self.clock is None else self.clock.makespan)

    def advance(self, amount: float) -> None:
        """Go on in the order shown, by seconds of the motions, or steps without arms."""
        with self.lock:
            back = self.clock is None and self.direction is Direction.DISASSEMBLY
            self.go_to_reading(self.reading - amount if back else self.reading + amount)

    def turn(self, direction: Direction) -> None:
        """Show the plan in the other order; the state shown stays."""
        with self.lock:
            if direction is not self.direction:
                shown = self.position if self.clock is None else self.step
                self._unmarked = self._unmarked.turned(direction)
                self._mark_places()
                self.arms = None if self.arms is None else self.arms.turned(direction)
                self.go_to(shown)

    def appearance(self) -> Appearance:
        """Return the present appearance of all parts."""
        with self.lock:
            disrupted = self.disruption.changes_state
            marks = self.sliding | dict.fromkeys(self.disruption.fixed, FIXED)
            if self.selected is not None:
                marks[self.selected] = SELECTED
            appearance = appearance_at(
                self.timeline,
                self.position,
                state=self.site if disrupted else None,
                action_probabilities=self.action_probabilities() if self.show_probabilities else None,
                marks=marks,
                travelling=self.arms is None,
            )
            arm_poses = self.arm_poses()
            seen = appearance if arm_poses is None or disrupted else appearance_with_arms(appearance, arm_poses)
            return self.view.of(seen, self.assembly)

    def arm_poses(self) -> ArmPoses | None:
        """Return the present arm poses; None where there are no arms."""
        with self.lock:
            return None if self.arms is None else self.arms.at_time(self.seconds)

    @property
    def pale(self) -> Sequence[int]:
        """Absent parts that are drawn in a pale colour, so that they can be clicked."""
        if self.tool is ClickMode.LOOK:
            return ()
        absent = (self.site == REMOVED) & ~self.view.gone(self.assembly)
        return [part for part in np.flatnonzero(absent).tolist() if part not in self.disruption.missing]

    def click(self, origin: NDArray[np.float64], ray: NDArray[np.float64]) -> int | None:
        """Select the part that a ray hits, None if none, and toggle its mark if a tool is chosen; return the part."""
        with self.lock:
            appearance = self.appearance()
            opacity = appearance.opacity.copy()
            opacity[list(self.disruption.missing)] = 1.0
            opacity[list(self.pale)] = 1.0
            if self.tool is ClickMode.THERE:  # a part that is present already needs no such mark
                opacity[self.state != REMOVED] = 0.0
            plane = self.view.plane(self.assembly)
            part = pick(self.assembly, replace(appearance, opacity=opacity), origin, ray, plane)
            if part is not None:
                self.click_part(part)
            elif self.tool is ClickMode.LOOK:
                self.selected = None
            return part

    def click_part(self, part: int) -> None:
        """Select a part, and toggle its mark if a tool is chosen."""
        with self.lock:
            self.selected = part
            before = self.disruption
            self.disruption = before.toggled(self.tool, part, self.assembly, self.state)
            try:
                self._mark_places()
            except InputError:  # there is no place for a prop
                self.disruption = before
                raise

    def clear_marks(self) -> None:
        """Clear the marks; the number of robots stays."""
        with self.lock:
            self.disruption = Disruption(robots=self.disruption.robots)
            self._mark_places()

    def _mark_places(self) -> None:
        """Give the structure shown the places of the props that are marked, and no others."""
        plain = self._unmarked
        timeline = plain.with_places(places_under(plain.assembly, sorted(self.disruption.props)))
        if timeline.assembly.identity != self.timeline.assembly.identity:
            self._proofs = ProofCache(contact=self.criterion == "contact")
            self.selected = None if (self.selected or 0) >= timeline.assembly.part_count else self.selected
        elif timeline.assembly is not self.timeline.assembly:
            timeline = replace(timeline, assembly=self.timeline.assembly)
        self.timeline = timeline

    def set_robots(self, robots: int) -> None:
        """Change the number of robots of the next plan."""
        with self.lock:
            self.disruption = replace(self.disruption, robots=int(robots))

    def proof(self) -> StateProof:
        """Return the verdict on the marked state, with its proof.

        Under `contact`, a state of the plan is judged as built, a marked one from rest.
        """
        with self.lock:
            return self._proofs.prove(self.oracle, *self._shown)

    @property
    def _shown(self) -> tuple[Plan | None, int, States]:
        """The plan, unless marks change its state; row of the state in the timeline; the marked state."""
        place = self.timeline.row(self.position) - self.built
        plan = self.plan if self.disruption.empty and place >= 0 else None
        return plan, place, self.site

    @property
    def sliding(self) -> dict[int, str]:
        """Colours of the parts that slide in the marked state, by part; empty unless `proof` was called."""
        with self.lock:
            known = self._proofs.find(*self._shown)
            return {} if known is None else known.marks

    def action_probabilities(self) -> NDArray[np.float64]:
        """Return the probability of the action that concerns each part in the state shown; shape (parts,).

        NaN where no action is legal; all NaN without a policy.
        """
        parts = self.assembly.part_count
        if self.policy is None or self.assembly.props:  # which policies do not know
            return np.full(parts, np.nan)
        with self.lock:
            if self._guide is None:
                from falsework.replanning.policy_guide import PolicyGuide

                self._guide = PolicyGuide(self.policy)
            site = self.site[None]
            legal = action_mask(site, self.assembly.boundary, self.disruption.robots)
            target = np.where(self.assembly.boundary, HELD, REMOVED).astype(np.uint8)[None]
            scores = self._guide.log_probabilities(site, legal, target)
            return chance_of_parts(np.exp(scores[0]))

    def visited(self, rollouts: int = 32) -> States:
        """Return the stable states on rollouts of the policy from the complete structure, shape (count, parts).

        The first rollout is greedy, the others are sampled; each state is returned once.
        """
        self.action_probabilities()
        guide, oracle = self._guide, self.oracle
        assert guide is not None
        start = self.timeline.states[-1]
        task = Task.from_rules(oracle.assembly.boundary, self.timeline.robots, start=start).judged_by(oracle)
        starts = np.repeat(task.start[None], rollouts, axis=0)

        def stable(_: NDArray[np.int64], states: States, parents: States) -> NDArray[np.bool_]:
            return oracle.verdicts(states, near=parents).stable

        seen = [starts[:1]]
        for several, rng in ((starts[:1], None), (starts[1:], np.random.default_rng(0))):
            owner = np.zeros(len(several), dtype=np.int64)
            played = follow_scores([task], several, owner, guide.log_probabilities, rng=rng, stable=stable)
            seen += [rollout.states[: len(rollout.states) - rollout.unstable] for rollout in played]
        return np.unique(np.concatenate(seen), axis=0)

    def replan(self) -> NewPlan:
        """Replan from the marked state, and show the new plan if there is one."""
        from falsework.replanning.replanner import replan
        from falsework.search.find import RESERVES

        begun = time.perf_counter()
        with self.lock:
            assembly, policy = self.assembly, None if self.assembly.props else self.policy
            question = self.disruption.question(assembly, self.state, self.direction)
            if len(self.timeline) == 0 and np.array_equal(question["state"], question["target"]):
                # A structure that nothing has been planned for is asked from its beginning.
                question["state"] = empty_state(assembly.boundary)
            old, building = self.plan, self.direction is Direction.ASSEMBLY
            place = self.timeline.row(self.position)
            before = place if building else 0
            planned = building and place >= self.built and np.array_equal(self.disruption.found(self.state), self.state)
            if planned and old is not None:
                # The new plan has the steps that are done, and goes on with their history.
                before = self.built
                del question["state"]
                done = {"step": place - self.built, "since": self.disruption.since(self.state)}
                ask = partial(replan, old, **done, structure=assembly, policy=policy)
            else:
                stability = StabilitySettings(criterion=self.criterion, reserve=RESERVES[self.criterion])
                if old is not None:  # what robots can do, and the ways of parts, stay as they were
                    stability = StabilitySettings.from_claim(old.claim)
                    question |= {"removable_only_if_clear": old.removable_only_if_clear, **exit_rules(old)}
                ask = partial(replan, assembly, stability=stability, policy=policy)
        answer = ask(**question, deadline=self.deadline)
        found = new_plan(answer, assembly, time.perf_counter() - begun, old, before)
        if found.plan is not None:
            with self.lock:
                self._before.append((self._unmarked, self.plan, self.built, self.disruption, self.position, self.arms))
                self.arms = None  # the new plan has no motions yet
                if building:
                    self.timeline = self.timeline.going_on(before, found.plan)
                else:
                    self.timeline = Timeline.from_plan(found.plan, assembly, answer.direction)
                self._unmarked = self.timeline
                self.plan, self.built = found.plan, before
                self.go_to(before + answer.built if building else self.timeline.begin)
                # Disruptions in the new plan are no longer marked: the states of the new plan show it.
                self.disruption = Disruption(fixed=self.disruption.fixed, robots=self.disruption.robots)
        return found

    @property
    def can_go_back(self) -> bool:
        """Whether there is an older plan."""
        return bool(self._before)

    def go_back(self) -> None:
        """Show the previous plan again, with the marks that were set then."""
        with self.lock:
            if self._before:
                self._unmarked, self.plan, self.built, self.disruption, position, self.arms = self._before.pop()
                self._mark_places()
                self.go_to(position)
