"""`falsework margins`: distance of friction, tilt, loads and pushes from the limit of stability."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, ConeOption, CriterionOfPlan, StatesOption, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.margins_table import print_margins
from falsework.errors import InputError
from falsework.utils.quantity import format_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.cli.output import Output
    from falsework.search.plans.plan import Plan
    from falsework.stability import StateMargins
    from falsework.stability.settings import StabilitySettings


@dataclass(frozen=True, kw_only=True)
class FindMargins(Command):
    """Find the margins of a structure, of some of its states, or of every state of a plan.

    STRUCTURE may be a plan, too. Margins are the least friction, the largest tilt of the ground and horizontal
    acceleration in the worst of 36 directions, the largest factor on the weight of one part and of all, the weakest
    push on a free face of a part, and the force and moment that a robot bears for each part that it holds. Each bound
    has a certificate on both sides, within 1 %. A margin without a bound is null in JSON. Exit code 1 if a state is not
    stable, or if a robot would bear more than --bears.

    States of a plan under the criterion contact are measured as built: their contacts keep the loads that they have
    taken on. Other states, those of structures with joints, and those that --out writes, are measured from rest, with
    all loads at once.
    """

    rare: ClassVar[tuple[str, ...]] = ("cone", "polygon", "settlement", "placement", "draws", "seed")

    outcomes: ClassVar[tuple[str, str]] = ("stable", "not_stable")
    examples: ClassVar[tuple[str, ...]] = (
        "falsework margins arch:blocks=15",
        "falsework margins plan.json --json",
        "falsework margins plan.json --out plan.json",
        "falsework margins my-folder --polygon --settlement",
        "falsework margins my-folder --placement 1mm,2mm --draws 40",
    )

    structure: StructureOptions
    states: StatesOption = None
    criterion: CriterionOfPlan = None
    cone: ConeOption = None
    bears: Annotated[str | None, arg(metavar="FORCE,MOMENT", help_behavior_hint=UNSET)] = None
    """Largest force and moment that a robot can bear, such as 120N,8Nm."""
    polygon: bool = False
    """Also find the largest tilt in each of 36 directions."""
    settlement: bool = False
    """Also find how deep each support may settle, under the criterion contact."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Time for the margins of each state. Margins that are not found by then have what has been proven so far."""
    placement: Annotated[str | None, arg(metavar="LENGTHS", help_behavior_hint=UNSET)] = None
    """Placement errors, such as 1mm,2mm, at which to count the stable draws, with contacts found anew. Slow."""
    draws: Annotated[int | None, arg(help_behavior_hint="(default: 1000)")] = None
    """Random draws for each placement error."""
    seed: Annotated[int | None, arg(help_behavior_hint="(default: 0)")] = None
    """Random seed of the draws."""
    steps: bool = False
    """Print all steps of a plan, not the weakest alone."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=UNSET)] = None
    """File to write the plan to with the margins of all its states from rest, which instruction sheets and the page
    show and `falsework check` verifies."""

    def run(self, output: Output) -> Exit:
        """Find and print the margins."""
        from falsework.search.measure import histories_as_built
        from falsework.stability.margins.margins import QUICK
        from falsework.stability.oracle import StabilityOracle
        from falsework.utils.quantity import parse_quantity

        limits = self._limits()
        if self.placement is None and self._drawing():
            raise InputError("--draws and --seed are of placement errors; give --placement too, or leave them out")
        asked = [] if self.placement is None else self.placement.split(",")
        errors = [parse_quantity(text, "length", "--placement") for text in asked]
        assembly, chosen = self.structure.load_states(self.states, output)
        plan, states = chosen.plan, chosen.states
        settings = chosen.settings(self.criterion, self.cone)
        if self.out is not None:
            self._refuse_out(plan, settings)
        extra = [kind for kind in ("polygon", "settlement") if getattr(self, kind)]
        oracle, found, interrupted = StabilityOracle(assembly, settings), [], False
        from_rest = plan is None or self.out is not None
        histories = () if from_rest else histories_as_built(plan, assembly, settings, chosen.steps)
        with output.count("margins", "state") as progress:
            try:
                for row in range(len(states)):
                    built = histories[row : row + 1]
                    found += oracle.margins(states[row], (*QUICK, *extra), deadline=self.deadline, histories=built)
                    progress(row + 1, len(states))
            except KeyboardInterrupt:
                interrupted = True
        if interrupted:
            errors = []
        shares = self._shares(assembly, states, errors, settings, output)
        overloaded, records = False, []
        for row, margins in enumerate(found):
            record = {"state": chosen.number(row), **margins.to_dict(assembly.names)}
            if errors:
                record["placement"] = [{"error_m": e, "share": s} for e, s in zip(errors, shares[row], strict=True)]
            beyond = [
                load
                for load in margins.held
                if limits is not None and (load.force_n > limits[0] or load.moment_nm > limits[1])
            ]
            overloaded |= bool(beyond)
            if limits is not None:
                record["overloaded"] = [load.part for load in beyond]
            output.row("states", record)
            records.append(record)
            for load in beyond:
                name = assembly.names[load.part]
                output.note(
                    f"falsework: {chosen.subject(row)}: the robot that holds {name} bears "
                    f"{format_quantity(load.force_n, 'force')} and {format_quantity(load.moment_nm, 'moment')}, more "
                    f"than {self.bears}"
                )
        whole = plan is None and self.states is None
        subjects = [assembly.name if whole else chosen.subject(row) for row in range(len(records))]
        print_margins(records, subjects, output, everything=self.steps or plan is None)
        if histories:
            output.say("measured as built, with the loads that contacts have taken on by then")
        if interrupted:
            output.note(f"interrupted after {len(found)} of {len(states)} states")
            return Exit.INTERRUPTED
        if self.out is not None and plan is not None:
            self._save(plan, found, self.out, output)
        if overloaded:
            output.outcome("overloaded")
        return Exit.DONE if all(margins.stands for margins in found) and not overloaded else Exit.NO

    def _drawing(self) -> dict[str, int]:
        """Return the options of random draws that are given."""
        given = {"draws": self.draws, "seed": self.seed}
        return {name: value for name, value in given.items() if value is not None}

    def _limits(self) -> tuple[float, float] | None:
        from falsework.utils.quantity import parse_quantity

        if self.bears is None:
            return None
        force, comma, moment = self.bears.partition(",")
        if not comma:
            raise InputError(f"--bears {self.bears}: give a force and a moment, such as 120N,8Nm")
        return parse_quantity(force, "force", "--bears"), parse_quantity(moment, "moment", "--bears")

    def _refuse_out(self, plan: Plan | None, settings: StabilitySettings) -> None:
        """Check before the search that the margins can be written into a plan."""
        from falsework.cli.planning import writable_plan

        assert self.out is not None
        if plan is None or self.states is not None or self.deadline is not None:
            raise InputError("--out writes all margins of a plan: give a plan, and leave out --states and --deadline")
        claim = settings.claim
        if (claim.criterion, claim.cone) != (plan.claim.criterion, plan.claim.cone):
            raise InputError(
                f"the plan is for the criterion {plan.claim.criterion} with the {plan.claim.cone} cone; "
                "leave out --criterion and --cone, or --out"
            )
        writable_plan(self.out)

    def _save(self, plan: Plan, found: list[StateMargins], path: Path, output: Output) -> None:
        """Write the plan with its margins, unless one of its states has none."""
        from falsework.search.margins.plan_margins import PlanMargins
        from falsework.search.plans.plan_file import save_plan
        from falsework.search.plans.plan_source import moved_source

        fallen = next((row for row, margins in enumerate(found) if not margins.stands), None)
        if fallen is not None:
            output.note(
                f"falsework: {path} is not written: a plan carries margins of states from rest, and state {fallen} "
                "stands only as built"
            )
            return
        margins = PlanMargins.from_states(found)
        if plan.margins is not None:
            known = plan.margins
            margins = replace(margins, demands=known.demands, maximised=known.maximised, bound=known.bound)
        source = moved_source(plan, Path(self.structure.spec), path)
        save_plan(replace(plan, margins=margins, source=source), path, proofs=plan.proof_arrays() is not None)
        output.file(path)
        output.note(f"the plan with its margins is in {path}")

    def _shares(
        self, assembly: Assembly, states: States, errors: list[float], settings: Any, output: Output
    ) -> list[list[float]]:
        """Return the share of stable draws, a list per state with one entry for each placement error."""
        from falsework.stability.margins.placement import placement_curve
        from falsework.stability.oracle import StabilityOracle

        if not errors:
            return []
        with output.count("placing", "draw") as progress:
            curve = placement_curve(
                assembly,
                states,
                errors,
                lambda moved, batch: StabilityOracle(moved, settings).verdicts(batch).stable,
                progress=progress,
                **self._drawing(),
            )
        return curve.shares.T.tolist()
