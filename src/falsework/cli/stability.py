"""`falsework stability`: stability of a structure, or of states of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from falsework.cli.command import (
    Command,
    ConeOption,
    CriterionOfPlan,
    SolverOption,
    StatesOption,
    StructureOptions,
    settlement_record,
)
from falsework.cli.exit_code import Exit
from falsework.utils.quantity import format_quantity

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.stability.verdict import Verdict


@dataclass(frozen=True, kw_only=True)
class CheckStability(Command):
    """Check the stability of a structure, of some of its states, or of those of a plan, with a certificate for each.

    A state has one value per part: 0 removed, 1 installed, 2 held; boundary parts are always 2. For a state that is
    unstable, slides or tips, the output describes which parts would move and how. Exit code 1 if any state is not
    stable.

    STRUCTURE may be a plan, too. Under the criterion contact a state of a plan is judged twice: as built, by the steps
    that lead to it, which is what `plan` and `check` prove, and from rest, with all loads at once, as other states are.
    It may stand in one way and slide in the other; a plan needs the first.
    """

    rare: ClassVar[tuple[str, ...]] = ("cone", "solver")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework stability arch:blocks=15 --friction 0.84",
        "falsework stability my-folder --states states.json --json",
        "falsework stability plan.json --states plan.json:31",
    )

    outcomes: ClassVar[tuple[str, str]] = ("stable", "not_stable")

    structure: StructureOptions
    states: StatesOption = None
    criterion: CriterionOfPlan = None
    cone: ConeOption = None
    solver: SolverOption = "cpu"

    def run(self, output: Output) -> Exit:
        """Compute the verdicts and describe how unstable states fail."""
        import numpy as np

        from falsework.cli.velocity_text import describe, motions_at, part_name
        from falsework.stability import Proof
        from falsework.stability.oracle import StabilityOracle
        from falsework.viewer.proof import BuildProofs

        assembly, chosen = self.structure.load_states(self.states, output)
        output.record(settlement_record(assembly))
        states, plan = chosen.states, chosen.plan
        oracle = StabilityOracle(assembly, chosen.settings(self.criterion, self.cone, self.solver))
        criterion = oracle.settings.criterion
        verdicts = oracle.verdicts(states, require_certificate=True)
        both = plan is not None and criterion == plan.claim.criterion == "contact"
        builds = BuildProofs(plan, oracle) if plan is not None and both else None
        stands = []
        for index, verdict in enumerate(verdicts.kinds):
            proof = Proof(verdicts.proof[index])
            residual = float(verdicts.residual[index])
            moving = motions_at(assembly, verdicts, index)
            built = None if builds is None else builds.at(chosen.number(index))
            stands.append(bool(verdicts.stable[index]) if built is None else built.stable)
            output.row(
                "states",
                {
                    "state": chosen.number(index),
                    "verdict": verdict.name.lower(),
                    "proof": proof.name.lower(),
                    "as_built": None if built is None else built.verdict,
                    "criterion": criterion,
                    "residual": residual if np.isfinite(residual) else None,
                    "on_tolerance": bool(verdicts.on_tolerance[index]),
                    "moving": [motion.to_dict(assembly) for motion in moving],
                },
            )
            subject = assembly.name if plan is None and self.states is None else chosen.subject(index)
            held = [part for part in np.flatnonzero(states[index] == 2) if not assembly.boundary[part]]
            if held:
                subject += f" with {', '.join(part_name(assembly, int(part)) for part in held)} held"
            near = "; the verdict depends on the tolerance" if verdicts.on_tolerance[index] else ""
            word = verdict.name.lower()
            if built is not None:
                only_rest = verdicts.stable[index] and not built.stable
                word = built.words if only_rest else f"{built.verdict} as built, {word} from rest"
            line = f"{subject}: {word}; {_reason(verdict, residual)}{near}"
            output.say(f"{line}; {describe(assembly, moving)}" if moving else line)
            if not verdicts.stable[index] and states[index].all() and (hint := assembly.clearance_hint):
                output.note(f"falsework: {hint}")
        return Exit.DONE if all(stands) else Exit.NO


def _reason(verdict: Verdict, residual: float) -> str:
    """Return what the certificate of a verdict shows, in the words of statics."""
    from falsework.stability.verdict import Verdict

    left = f"{format_quantity(residual, 'share')} of gravity"
    return {
        Verdict.STABLE: f"contact forces balance every part (left over: {left})",
        Verdict.UNSTABLE: f"whatever the contact forces, a part accelerates (by at least {left})",
        Verdict.SLIDES: f"forces in balance exist (left over: {left}), but parts slide before contacts build them up",
        Verdict.TIPS: f"contact forces balance every part (left over: {left}), but a small motion grows from there",
        Verdict.UNDECIDED: "neither forces in balance nor a motion that nothing stops were found",
    }[verdict]
