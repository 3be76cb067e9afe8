"""Structure of blocks, and what falsework says of it."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Union

from falsework_client.blocks import UNITS, Block, center_of, check, names_of
from falsework_client.errors import ClientError
from falsework_client.http import ask
from falsework_client.local_service import LocalService

URL_VARIABLE, TOKEN_VARIABLE = "FALSEWORK_URL", "FALSEWORK_TOKEN"
REMOVED, INSTALLED, HELD = 0, 1, 2
"""Values of a state."""
State = Union[str, Sequence[int]]
"""`complete`, `empty`, or a value for each part; supports are always held."""

_AFTER = {"hold": HELD, "insert": HELD, "remove": REMOVED, "release": INSTALLED}
_UNDONE = {"insert": "remove", "remove": "insert", "release": "hold", "hold": "release"}
_WITHIN = 1e-3
"""Share of the structure's size by which centres of mass here and in a running service may differ."""
_KEPT = 2
"""Structures whose local services run at the same time for `shared_structure`."""
_PICTURE_SECONDS, _GRACE = 60.0, 15.0


@dataclass(frozen=True)
class Verdict:
    """Verdict on a state."""

    verdict: str
    """`stable`, `slides`, `tips`, `unstable` or `undecided`."""
    criterion: str
    """What stable means: `contact` or `equilibrium`."""
    proof: str
    """Type of the certificate: `displacement`, `forces`, `velocity` or `none`."""
    moving: tuple[int, ...]
    """Parts that move, the fastest first."""

    @property
    def stable(self) -> bool:
        """Whether the state stands."""
        return self.verdict == "stable"


@dataclass(frozen=True)
class Press:
    """Wrench that a robot adds to a part that it holds while another is released."""

    part: int
    name: str
    wrench: tuple[float, ...]
    """Force in N, and moment in N m about the centre of mass."""

    @property
    def force(self) -> float:
        """Size of the force, N."""
        return math.sqrt(sum(value * value for value in self.wrench[:3]))


@dataclass(frozen=True)
class Step:
    """Action of a plan."""

    do: str
    """`insert` or `release`; in disassembly `hold` or `remove`."""
    part: int
    name: str
    state: tuple[int, ...]
    """After the step, one value a part: 0 removed, 1 installed, 2 held."""
    presses: tuple[Press, ...] = ()
    """Parts that robots press meanwhile."""
    number: int = 0
    """In the order of assembly, from 1; a step that takes something away has the number of the one that it undoes."""

    @property
    def words(self) -> str:
        """The step in words, such as `release v2; robot presses v3 with 1290 N`."""
        presses = [f"robot presses {press.name} with {press.force:.0f} N" for press in self.presses]
        return "; ".join([f"{self.do} {self.name}", *presses])


@dataclass(frozen=True)
class Plan:
    """Answer to a request for a plan."""

    outcome: str
    """`found`, `proved_impossible`, `not_found`, or `not_yet` if the time was too short."""
    reason: str
    """Why there is no plan, or why the one that there is keeps no reserve; empty otherwise."""
    plan: dict[str, Any] | None
    """Contents of a plan file, which every command of falsework reads; None if no plan was found."""
    steps: tuple[Step, ...]
    start: tuple[int, ...]
    """State before the first step; empty if no plan was found."""
    moving: tuple[int, ...]
    """Parts that move where the search broke off."""

    @property
    def found(self) -> bool:
        """Whether there is a plan."""
        return self.plan is not None

    def state_after(self, steps: int) -> tuple[int, ...]:
        """Return the state after so many steps; 0 is the beginning, more than there are is the end."""
        return self.steps[min(steps, len(self.steps)) - 1].state if steps > 0 and self.steps else self.start


class Structure:
    """Structure with a service that answers for it."""

    def __init__(
        self,
        blocks: Sequence[Block],
        *,
        unit: str,
        friction: float | None = None,
        density: float | None = None,
        name: str = "blocks",
        ground: bool = False,
        url: str | None = None,
        token: str | None = None,
        python: str | None = None,
    ) -> None:
        """Find the service for some blocks, or start one.

        Args:
            blocks: of the structure; part `i` is block `i`, and a ground comes after the last.
            unit: of the coordinates: m, dm, cm, mm, in or ft.
            friction: coefficient of friction of every contact; the default of falsework if None.
            density: of blocks without their own, kg/m3; the default of falsework if None.
            name: of the structure.
            ground: whether a fixed ground is added below the lowest point.
            url: of a service that runs already and serves these blocks; by default the environment variable
                `FALSEWORK_URL`. Without either a local service is started.
            token: that the service at `url` wants; by default the environment variable `FALSEWORK_TOKEN`.
            python: that starts a local service, see `LocalService`.

        Raises:
            ClientError: the blocks make no structure, or there is no service for them.
        """
        check(blocks, unit, friction, density, ground)
        self.blocks = tuple(blocks)
        self.names = tuple(names_of(blocks)) + (("ground",) if ground else ())
        self._local: LocalService | None = None
        address = url or os.environ.get(URL_VARIABLE)
        if address:
            self._url = address.rstrip("/")
            self._token = token or os.environ.get(TOKEN_VARIABLE)
            self._check_service(unit, friction)
        else:
            options: dict[str, Any] = {"unit": unit, "friction": friction, "density": density, "name": name}
            self._local = LocalService(blocks, python=python, ground=ground, **options)
            self._url, self._token = self._local.url, None

    @property
    def url(self) -> str:
        """Address of the service."""
        return self._url

    @property
    def warnings(self) -> list[str]:
        """What falsework remarks on the blocks; known of a local service only."""
        return [] if self._local is None else self._local.warnings

    def stability(self, state: State = "complete") -> Verdict:
        """Return the verdict on a state.

        Raises:
            ClientError: the service cannot be reached, or refuses.
        """
        question = {"states": [_state(state)], "explain": True}
        answer = self._ask("/stability", question, 60.0)
        record = answer["verdicts"][0]
        return Verdict(record["verdict"], answer["criterion"], record["proof"], tuple(record["moving"]))

    def plan(
        self,
        state: State = "empty",
        target: State = "complete",
        *,
        robots: int = 2,
        missing: Sequence[int] = (),
        fixed: Sequence[int] = (),
        removable_only_if_clear: bool = False,
        holds: dict[str, Any] | None = None,
        reserve: float | None = None,
        seconds: float = 30.0,
    ) -> Plan:
        """Plan from a state to another.

        Args:
            state: where the structure is.
            target: where it shall go; without any part it is taken apart, otherwise assembled.
            robots: parts that can be held at a time.
            missing: parts that are not delivered yet.
            fixed: parts that must not be held or removed.
            removable_only_if_clear: whether parts move along free straight lines only.
            holds: what robots that hold parts can do: any of `stiffness` in N/m, `force` in N, `moment` in N m and
                `mode`, such as `locked` for robots that never press; the defaults of the service if None.
            reserve: number by which friction is divided; that of `falsework plan`, 1.1, if None. If no plan keeps it,
                there is one without, and `reason` says why.
            seconds: until the answer, 60 at most.

        Raises:
            ClientError: the service cannot be reached, or refuses.
        """
        question = {
            "state": _state(state),
            "target": _state(target),
            "robots": robots,
            "missing": list(missing),
            "fixed": list(fixed),
            "removable_only_if_clear": removable_only_if_clear,
            "deadline": round(1000 * seconds),
        }
        question.update({name: value for name, value in (("holds", holds), ("reserve", reserve)) if value is not None})
        answer = self._ask("/replan", question, seconds + _GRACE)
        record = answer["plans"][0] if answer["plans"] else None
        if record is None:
            return Plan(answer["outcome"], answer["reason"], None, (), (), tuple(answer["moving"]))
        # The steps of a plan are in the order of assembly; to take the structure apart, the last one is undone first.
        undone = answer["direction"] == "disassembly"
        start = tuple(record["end"] if undone else record["start"]["state"])
        steps: list[Step] = []
        now: list[int] = list(start)
        numbered = list(enumerate(record["steps"], 1))
        for number, step in reversed(numbered) if undone else numbered:
            do = _UNDONE[step["do"]] if undone else step["do"]
            now[step["part"]] = _AFTER[do]
            presses = tuple(
                Press(press["part"], self.names[press["part"]], tuple(press["wrench"]))
                for press in ([] if undone else step.get("presses", []))
            )
            steps.append(Step(do, step["part"], self.names[step["part"]], tuple(now), presses, number))
        unreserved = answer.get("unreserved", "")  # services before 0.2 fell back on nothing
        return Plan(answer["outcome"], unreserved, record, tuple(steps), start, tuple(answer["moving"]))

    def picture(
        self,
        state: State = "complete",
        *,
        plan: dict[str, Any] | None = None,
        step: int | None = None,
        proof: bool = False,
        **view: float,
    ) -> bytes:
        """Return a PNG of a state, of a plan, or of one step of a plan.

        Args:
            state: drawn if there is no plan.
            plan: `Plan.plan`; drawn as a contact sheet.
            step: draws the state in which this many steps of the plan are done alone.
            proof: whether the forces of a single state are drawn, or its motion if it does not stand.
            **view: `width` in pixels, `azimuth` and `elevation` in degrees, `frames` of a contact sheet.

        Raises:
            ClientError: the service cannot be reached, refuses, or has not the extra `picture`.
        """
        question = {"state": _state(state), "plan": plan, "step": step, "proof": proof, **view}
        return self._ask("/picture", question, _PICTURE_SECONDS + _GRACE)

    def close(self) -> None:
        """End the service if it was started here."""
        if self._local is not None:
            self._local.stop()

    def __enter__(self) -> Structure:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, path: str, question: Any, seconds: float) -> Any:
        return ask(self._url + path, question, token=self._token, seconds=seconds)

    def _check_service(self, unit: str, friction: float | None) -> None:
        """Refuse a service of other blocks: its plans would not fit."""
        record = self._ask("/structure", None, 30.0)
        if not isinstance(record, dict) or "parts" not in record:
            raise ClientError(f"what answers at {self._url} is no falsework service; give another address")
        parts = record["parts"]
        remedy = f"serve these blocks there, or leave the address out; {self._url} serves {record['name']!r}"
        if len(parts) != len(self.names):
            raise ClientError(f"the service has {len(parts)} parts instead of {len(self.names)}; {remedy}")
        if friction is not None and abs(record["friction"] - friction) > 1e-9:
            raise ClientError(f"the friction is {friction} here and {record['friction']} in the service; {remedy}")
        points = [point for block in self.blocks for point in block.vertices]
        size = max(max(axis) - min(axis) for axis in zip(*points)) * UNITS[unit]
        for number, (block, part) in enumerate(zip(self.blocks, parts)):
            center = center_of(block)
            if block.support != part["boundary"]:
                raise ClientError(f"part {number} is a support either here or in the service only; {remedy}")
            if center is not None and any(
                abs(here * UNITS[unit] - there) > _WITHIN * size for here, there in zip(center, part["center"])
            ):
                raise ClientError(f"part {number} is at another place in the service; {remedy}")


_shared: dict[str, Structure] = {}


def shared_structure(blocks: Sequence[Block], **options: Any) -> Structure:
    """Return a structure whose service goes on running, for callers that come again with the same blocks.

    The last two structures are kept; the service of an older one ends.

    Args:
        blocks: of the structure.
        **options: of `Structure`.

    Raises:
        ClientError: as `Structure`.
    """
    told = [
        repr((_plain(block.vertices), _plain(block.faces), replace(block, vertices=(), faces=()))) for block in blocks
    ]
    told += [repr(sorted(options.items())), *(os.environ.get(name, "") for name in (URL_VARIABLE, TOKEN_VARIABLE))]
    key = hashlib.sha256("\n".join(told).encode()).hexdigest()
    found = _shared.pop(key, None)
    if found is not None:
        try:
            ask(found.url + "/health")
        except ClientError:  # it was ended from outside
            found.close()
            found = None
    if found is None:
        found = Structure(blocks, **options)
    _shared[key] = found
    while len(_shared) > _KEPT:
        _shared.pop(next(iter(_shared))).close()
    return found


def _plain(rows: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
    return [tuple(row) for row in rows]


def _state(state: State) -> Any:
    return state if isinstance(state, str) else [int(value) for value in state]
