"""Base of all subcommands, and the options that name a structure."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, UseAppendAction, arg

from falsework.cli.arguments import ChosenStates, parse_load, parse_numbers, parse_states, spell_options, split_parts
from falsework.cli.exit_code import Exit
from falsework.errors import InputError
from falsework.utils.files.output_file import path_beside

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.viewer.viewable import Viewable

UNSET = ""
"""Shown in place of a default where leaving an option out is the default."""
CRITERION = (
    "Stability criterion: compliant contacts without prestress bring every part to rest, or (paper) contact forces in "
    "balance exist."
)
_CRITERION_HINT = "(default: contact, or that of the plan)"
_CONE_HINT = "(default: quadratic under contact, octagon under equilibrium)"
_STATES = (
    "A state, as `complete`, digits, plan.json:31, or parts such as 0-16,keystone,held:left; or a file with states: a "
    "JSON list, a .npy array, or a plan. Of a plan, numbers such as 31 or 3,5-7 are steps."
)
CriterionName = Literal["contact", "equilibrium"]
CriterionOption = Annotated[CriterionName, arg(help=CRITERION)]
CriterionOfPlan = Annotated[CriterionName | None, arg(help=CRITERION, help_behavior_hint=_CRITERION_HINT)]
StatesOption = Annotated[
    str | None,
    arg(metavar="STATES", help=_STATES, help_behavior_hint="(default: complete, or those of the plan)"),
]
ConeOption = Annotated[
    Literal["octagon", "quadratic"] | None,
    arg(help="Friction cone: round, or eight-sided as in the paper.", help_behavior_hint=_CONE_HINT),
]
SolverOption = Annotated[
    Literal["auto", "cpu", "gpu", "exact"],
    arg(help="Solver; `auto` takes a GPU where there is one and it is faster."),
]
DeviceOption = Annotated[Literal["auto", "cpu", "cuda"], arg(help="Device; `auto` takes a GPU if there is one.")]
SeedOption = Annotated[int, arg(help="Random seed; results are reproducible on one machine.")]
"""Options that several commands have, with their help texts."""


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base of all subcommands; its fields are options of each."""

    examples: ClassVar[tuple[str, ...]] = ()
    """Command lines for the end of the help text."""
    rare: ClassVar[tuple[str, ...]] = ("debug",)
    """Options that only `--help-all` shows, of this class; groups of options have such a list, too."""
    outcomes: ClassVar[tuple[str, str]] = ("done", "failed")
    """Outcomes in JSON with the exit codes 0 and 1."""

    json: bool = False
    """Print the answer as one JSON object; notes go to standard error too."""
    debug: bool = False
    """Show the traceback of an error."""

    @abstractmethod
    def run(self, output: Output) -> Exit:
        """Run the subcommand and return the exit code."""


@dataclass(frozen=True, kw_only=True)
class JudgingCommand(Command):
    """Base of subcommands that decide stability."""

    criterion: CriterionOption = "contact"


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """Options that override the files of a structure; `falsework structures --help` describes them for all commands."""

    unit: Annotated[str | None, arg(metavar="UNIT", help_behavior_hint=UNSET)] = None
    """Unit of the meshes, such as mm."""
    density: Annotated[float | None, arg(metavar="KG/M3", help_behavior_hint=UNSET)] = None
    """Density of every part."""
    friction: Annotated[float | None, arg(metavar="MU", help_behavior_hint=UNSET)] = None
    """Coefficient of friction of every contact."""
    boundary: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that are permanently fixed, such as 0,3 or 0-16 or abutment."""
    ground: bool = False
    """Put a fixed ground under the lowest point."""
    interfaces: Annotated[Literal["found", "stored", "compare"] | None, arg(help_behavior_hint="(default: found)")] = (
        None
    )
    """Contacts: found from the meshes, those that a COMPAS file stores, or found and compared with the stored ones."""
    settle: Annotated[float | None, arg(metavar="MM", help_behavior_hint=UNSET)] = None
    """Let parts settle into their clearance before they are judged, each by at most this, such as 0.5. With 0 they
    stay, where the reader of their format would let them settle."""
    # A tuple of texts; tyro would import typeguard to check the default of `tuple[str, ...]`.
    loads: Annotated[UseAppendAction[tuple], arg(name="load", metavar="PART=FX,FY,FZ", help_behavior_hint=UNSET)] = ()
    """Force on a part in N, such as keystone=0,0,-1000, at its centre of mass or at a point: 7=0,0,-1000@0.2,0,1.
    May be repeated."""
    earthquake: Annotated[str | None, arg(metavar="SHARE", help_behavior_hint=UNSET)] = None
    """Pseudo-static horizontal acceleration as a share of gravity, such as 0.1 along x, or 0.1,0.05 along x and y."""

    def given(self) -> dict[str, Any]:
        """Return the options that were given, as `load_structure` takes them."""
        options: dict[str, Any] = {"unit": self.unit, "density": self.density, "friction": self.friction}
        options["boundary"] = None if self.boundary is None else split_parts(self.boundary, "--boundary")
        options["ground"] = self.ground or None
        options["interfaces"] = self.interfaces
        options["settle"] = None if self.settle is None else self.settle / 1000
        options["loads"] = [parse_load(text) for text in self.loads] or None
        options["earthquake"] = None if self.earthquake is None else parse_numbers(self.earthquake, "--earthquake")
        return {name: value for name, value in options.items() if value is not None}


def settlement_record(assembly: Assembly) -> dict[str, Any]:
    """Return the entry of an answer on parts that settled; none if the structure was not asked to."""
    settled = assembly.settlement
    return {} if settled is None else {"settlement": settled.to_dict(assembly.names)}


@dataclass(frozen=True, kw_only=True)
class StructureOptions(LoadOptions):
    """Options that select the structure."""

    spec: Annotated[Positional[str], arg(metavar="STRUCTURE")]
    """Built-in such as `vault` or `arch:blocks=15,thickness=0.2`, or a folder or file of meshes or COMPAS data."""

    def load(self) -> Assembly:
        """Build or read the structure, and warn of materials that none has and of parts that settled."""
        from falsework.assembly.findings import findings_on_materials
        from falsework.assembly.load import load_structure

        assembly = load_structure(self.spec, **self.given())
        for finding in findings_on_materials(assembly):
            warnings.warn(finding, stacklevel=2)
        if assembly.settlement is not None:
            warnings.warn(assembly.settlement.line(assembly.names), stacklevel=2)
        return assembly

    def load_states(self, states: str | None, output: Output) -> tuple[Assembly, ChosenStates]:
        """Read a structure and states of it, or a plan and its states, and warn of options that only the plan sets.

        Args:
            states: as given on the command line; all states of a plan, or the complete one of a structure, if None.

        Raises:
            InputError: a robot plan, or no states of this structure.
        """
        from falsework.files import load_own
        from falsework.search.plans.plan import Plan
        from falsework.search.plans.plan_check import check_identity
        from falsework.search.plans.plan_source import structure_to_check

        own = load_own(self.spec) if Path(self.spec).suffix.lower() == ".json" else None
        if not isinstance(own, Plan):
            if own is not None:
                raise InputError(f"{self.spec} is a robot plan; give the plan or the structure")
            assembly = self.load()
            return assembly, parse_states("complete" if states is None else states, "--states", assembly)
        assembly, set_by_plan = structure_to_check(own, self.spec, **self.given())
        check_identity(own, assembly)
        if set_by_plan:
            options = spell_options(set_by_plan)
            output.note(f"falsework: warning: the plan sets options of its structure itself: {options}")
        if states is None:
            return assembly, ChosenStates.from_plan(own)
        return assembly, parse_states(states, "--states", assembly, own)

    def source(self, beside: Path) -> dict[str, Any]:
        """Return the source of the structure, to be recorded in a file.

        Args:
            beside: the file; a path to the structure is given relative to its folder.
        """
        if not Path(self.spec).exists():
            return {"built_in": self.spec, **self.given()}
        return {"path": path_beside(Path(self.spec), beside), **self.given()}


@dataclass(frozen=True, kw_only=True)
class ViewableOptions(LoadOptions):
    """Options that name the file or structure to show."""

    rare: ClassVar[tuple[str, ...]] = ("structure", "cell")

    spec: Annotated[Positional[str], arg(metavar="WHAT")]
    """Plan, run, robot plan, state graph, a cell, or a structure: built-in, folder or file of meshes."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure of the plan or graph, where the file does not name it or it has moved; structure in a cell."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell of a robot plan, where the file does not name it or it has moved."""
    order: Literal["assembly", "disassembly"] = "assembly"
    """Order in which the steps of a plan are shown."""

    def open(self, robots: int = 2) -> Viewable:
        """Detect the kind of the file or structure and read it.

        Args:
            robots: number of robots, if no plan gives it.
        """
        from falsework.search.problem.task import Direction
        from falsework.viewer.viewable import open_file

        direction = Direction(self.order)
        return open_file(self.spec, self.structure, cell=self.cell, direction=direction, robots=robots, **self.given())
