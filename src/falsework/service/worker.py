"""Worker processes: each loads the structure once and answers batches until its pipe closes.

A worker does not depend on HTTP. It takes `(kind, items)` from its pipe and puts back one `Done` per item, as soon as
it is ready, and `None` after the last. It sends the text of the answer, which needs no further processing.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.props import with_props
from falsework.assembly.state import States, complete_state
from falsework.errors import DependencyError, InputError, PlanError
from falsework.search.find import RESERVES
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_check import check_identity
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.problem.result import Outcome
from falsework.stability.motion import motion_of
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import NumericalSettings, StabilitySettings
from falsework.stability.verdict import Criterion, Proof, Verdicts

if TYPE_CHECKING:
    from falsework.replanning.replanner import Replanner, ReplanResult
    from falsework.replanning.since import SiteSteps

Kind = Literal["replan", "stability", "picture"]

NOT_YET = "not_yet"
"""Outcome of a request whose deadline passed before a plan was found; it proves nothing."""
REMEMBERED = 400_000
"""Verdicts after which a worker empties its caches, to bound its memory."""
_KEPT = 6
"""Replanners that a worker keeps, each for other robots or another reserve; an answer may take two."""
_BACKGROUND = 5
"""Niceness of the planning processes, so that the process that answers clients goes first."""
_MOVES = 0.05
"""A part counts as moving at this share of the fastest part's velocity."""
_UNSEEN = frozenset({"forces", "displacements"})
"""Entries of a plan that the service does not use; packed in a short text they may take any amount of memory."""

log = logging.getLogger("falsework.service")


@dataclass(frozen=True, eq=False)
class WorkerConfig:
    """Initial data of a worker."""

    assembly: Assembly
    kind: Kind
    run: Path | None = None
    """Folder of a trained policy."""
    criterion: Criterion = "contact"
    """Stability criterion, see `falsework.stability.StabilitySettings`."""


@dataclass(frozen=True)
class Ready:
    """Message: the worker accepts requests."""

    policy: str
    """Description of the policy that proposes actions; empty for none."""


@dataclass(frozen=True)
class Failed:
    """Message: the worker cannot start, and a user must act."""

    reason: str


@dataclass(frozen=True)
class Item:
    """One request."""

    number: int
    payload: Any
    """Fields of `falsework.replanning.request.Request` with the `holds` and perhaps the `reserve` of the settings of
    stability and the `SiteSteps` since the plan; or of `PictureRequest` with the state as an array; or for stability
    `(states, explain)`."""
    seconds: float
    """Time that is left for it."""


@dataclass(frozen=True)
class Done:
    """One answer."""

    number: int
    status: int
    """HTTP status."""
    body: bytes
    """JSON, or a picture as PNG."""
    label: str = ""
    """Deciding stage, for the statistics."""


def work(pipe: Connection, config: WorkerConfig) -> None:
    """Answer batches until the pipe closes; entry point of a worker process."""
    # The process that serves clients handles signals, which may be sent to the whole group, and closes the pipe.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    try:
        bench = {"replan": _Planner, "stability": _Judge, "picture": _Painter}[config.kind](config)
    except InputError as error:
        pipe.send(Failed(" ".join(str(error).split())))
        return
    try:
        pipe.send(Ready(bench.policy))
        while True:
            items: Sequence[Item] = pipe.recv()
            bench.answer(items, pipe)
            pipe.send(None)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def refusal(text: str) -> bytes:
    """Return an error as JSON, one line."""
    return json.dumps({"error": " ".join(text.split())}, ensure_ascii=True).encode()


def one_thread(criterion: Criterion) -> StabilitySettings:
    """Return settings of an oracle in a worker: the processes share the cores already."""
    return StabilitySettings(criterion=criterion, numerics=NumericalSettings(threads=1))


class _Judge:
    """Worker loop for stability requests."""

    policy = ""

    def __init__(self, config: WorkerConfig) -> None:
        self._assembly, self._settings = config.assembly, one_thread(config.criterion)
        self._oracle = StabilityOracle(config.assembly, self._settings)
        states = complete_state(config.assembly.boundary)[None]
        self._oracle.verdicts(states)
        self._oracle.verdicts(states, require_certificate=True)

    def answer(self, items: Sequence[Item], pipe: Connection) -> None:
        """Check all states of all requests in one batch, except those to be explained."""
        if self._oracle.counters.cpu + self._oracle.counters.exact > REMEMBERED:
            self._oracle = StabilityOracle(self._assembly, self._settings)
        plain = [item for item in items if not item.payload[1]]
        if plain:
            verdicts = self._oracle.verdicts(np.concatenate([item.payload[0] for item in plain]))
            first = 0
            for item in plain:
                rows = slice(first, first := first + len(item.payload[0]))
                pipe.send(self._done(item.number, verdicts[rows], explain=False))
        for item in items:
            if item.payload[1]:
                verdicts = self._oracle.verdicts(item.payload[0], require_certificate=True)
                pipe.send(self._done(item.number, verdicts, explain=True))

    def _done(self, number: int, verdicts: Verdicts, *, explain: bool) -> Done:
        records = []
        for row, verdict in enumerate(verdicts.kinds):
            residual = float(verdicts.residual[row])
            record: dict[str, Any] = {
                "verdict": verdict.name.lower(),
                "proof": Proof(verdicts.proof[row]).name.lower(),
                "residual": float(f"{residual:.6g}") if np.isfinite(residual) else None,
                "on_tolerance": bool(verdicts.on_tolerance[row]),
            }
            if explain:
                motion = motion_of(self._assembly, verdicts, row)
                speed = np.zeros(0) if motion is None else np.abs(motion).max(axis=1)
                order = np.argsort(-speed, kind="stable")
                record["moving"] = order[speed[order] > _MOVES * speed.max(initial=0.0)].tolist()
            records.append(record)
        return Done(number, 200, _dump({"criterion": self._settings.criterion, "verdicts": records}), "judged")


class _Planner:
    """Worker loop for replanning requests."""

    def __init__(self, config: WorkerConfig) -> None:
        os.nice(_BACKGROUND)
        self._assembly = config.assembly
        self._settings = replace(one_thread(config.criterion), reserve=RESERVES[config.criterion])
        self._policy, self.policy = _load_policy(config)
        self._replanners: OrderedDict[tuple[str, StabilitySettings], Replanner] = OrderedDict()
        for reserve in dict.fromkeys((1.0, self._settings.reserve)):
            self._replanner(self._assembly, replace(self._settings, reserve=reserve))

    def _replanner(self, assembly: Assembly, settings: StabilitySettings) -> Replanner:
        """Return the replanner for a structure with some props, some robots and a reserve; the last few are kept."""
        from falsework.replanning.replanner import Replanner

        key = assembly.identity, settings
        replanner = self._replanners.pop(key, None)
        if replanner is None or replanner.oracle.counters.cpu + replanner.oracle.counters.exact > REMEMBERED:
            policy = None if assembly.props else self._policy
            replanner = Replanner(assembly, policy, StabilityOracle(assembly, settings))
        self._replanners[key] = replanner
        while len(self._replanners) > _KEPT:
            self._replanners.popitem(last=False)
        return replanner

    def answer(self, items: Sequence[Item], pipe: Connection) -> None:
        """Answer the requests for the same props, robots and reserve together."""
        begun = time.monotonic()
        groups: dict[tuple[str, StabilitySettings], tuple[Assembly, list[Item]]] = {}
        for item in items:
            try:
                assembly, payload = _on_site(item.payload, self._assembly)
            except InputError as error:
                pipe.send(Done(item.number, 422, refusal(str(error)), "refused"))
                continue
            settings = self._settings
            if (plan := payload.get("plan")) is not None:  # its gravity and tolerance, its holds and reserve
                own = StabilitySettings.from_claim(plan.claim, settings.criterion)
                reserve = own.reserve if plan.claim.criterion == own.criterion else settings.reserve
                settings = replace(own, numerics=settings.numerics, reserve=reserve)
            for name in payload.keys() & {"holds", "reserve"}:
                settings = replace(settings, **{name: payload.pop(name)})
            groups.setdefault((assembly.identity, settings), (assembly, []))[1].append(replace(item, payload=payload))
        for (_, settings), (assembly, some) in groups.items():
            try:
                self._replanner(assembly, settings)
            except InputError as error:  # they cannot carry a part
                for item in some:
                    pipe.send(Done(item.number, 422, refusal(f"holds: {error}"), "refused"))
                continue
            passed = time.monotonic() - begun
            self._answer(assembly, settings, [replace(item, seconds=item.seconds - passed) for item in some], pipe)

    def _answer(self, assembly: Assembly, settings: StabilitySettings, items: Sequence[Item], pipe: Connection) -> None:
        """Answer the requests together, or each by itself if one of them breaks the batch."""
        from falsework.replanning.replanner import replan_with_reserve
        from falsework.replanning.request import Request

        good: list[tuple[Item, Request]] = []
        for item in items:
            request = Request(**item.payload, deadline=max(item.seconds, 0.001))
            try:
                request.task(assembly)
            except InputError as error:
                pipe.send(Done(item.number, 422, refusal(str(error)), "refused"))
            else:
                good.append((item, request))
        open_items = {item.number for item, _ in good}

        def finished(number: int, answer: ReplanResult) -> None:
            item = good[number][0]
            open_items.discard(item.number)
            body = _dump(replan_record(answer, self._settings.criterion))
            pipe.send(Done(item.number, 200, body, answer.decided_by.value))

        try:
            asked, replanner = [request for _, request in good], partial(self._replanner, assembly)
            replan_with_reserve(asked, settings, replanner, finished=finished)
        except Exception as error:
            if len(items) == 1:
                log.exception("a request failed")
                reason = f"the request failed inside ({type(error).__name__})"
                pipe.send(Done(items[0].number, 500, refusal(reason), "failed"))
                return
            for item, _ in good:
                if item.number in open_items:
                    self._answer(assembly, settings, [item], pipe)


class _Painter:
    """Worker loop for requests for pictures."""

    policy = ""

    def __init__(self, config: WorkerConfig) -> None:
        os.nice(_BACKGROUND)
        self._assembly, self._criterion = config.assembly, config.criterion

    def answer(self, items: Sequence[Item], pipe: Connection) -> None:
        """Draw one picture after the other."""
        for item in items:
            try:
                pipe.send(Done(item.number, 200, self._draw(**item.payload), "drawn"))
            except DependencyError as error:
                pipe.send(Done(item.number, 501, refusal(str(error)), "refused"))
            except InputError as error:
                pipe.send(Done(item.number, 422, refusal(str(error)), "refused"))
            except Exception as error:
                log.exception("a picture failed")
                reason = f"the picture failed inside ({type(error).__name__})"
                pipe.send(Done(item.number, 500, refusal(reason), "failed"))

    def _draw(
        self, *, state: States, plan: dict[str, Any] | None, proof: bool, width: int | None, **options: Any
    ) -> bytes:
        """Return a PNG of a state, of a step of a plan, or of all its steps."""
        from falsework.viewer.show import picture

        subject, assembly = (state, self._assembly) if plan is None else read_plan(plan, self._assembly)
        forces = proof and (plan is None or options["step"] is not None)
        return picture(
            subject, None, assembly, forces=forces, width=width or 0, criterion=self._criterion, **options
        ).content


def read_plan(values: Mapping[str, Any], assembly: Assembly) -> tuple[Plan, Assembly]:
    """Return the plan of a request, and the structure with its props."""
    structure = values.get("structure")
    entries = structure if isinstance(structure, dict) else {}
    names, props = (entry if isinstance(entry, list) else [] for entry in map(entries.get, ("parts", "props")))
    if names and (len(names) - len(props) != assembly.part_count or len(props) > assembly.part_count):
        raise PlanError(
            f"the plan is of {len(names) - len(props)} parts, {assembly.name} has {assembly.part_count}; send a plan "
            "of this service"
        )
    plan = plan_from_dict({key: value for key, value in values.items() if key not in _UNSEEN})
    return plan, with_props(assembly, plan.props)


def _on_site(given: Mapping[str, Any], assembly: Assembly) -> tuple[Assembly, dict[str, Any]]:
    """Return the structure with the props on site, and a request for it with its plan read and gone on with.

    There are as many robots as in the plan where no other number is given.
    """
    since: SiteSteps | None = given.get("since")
    payload: dict[str, Any] = {name: value for name, value in given.items() if name != "since"}
    if payload.get("plan") is None:
        if since:
            raise InputError("since: these steps follow a step of a plan; give plan and step too")
        return assembly, payload
    try:
        plan, wide = read_plan(payload["plan"], assembly)
    except InputError as error:
        raise InputError(f"plan: {error}") from None
    payload = {"robots": plan.robots, **payload, "plan": plan}
    if since:
        if payload["step"] is None:
            raise InputError("since: these steps follow a step of the plan; give step too")
        check_identity(plan, wide)
        try:
            plan, wide = since.after(plan, payload["step"], wide, payload["robots"])
        except InputError as error:
            raise InputError(f"since: {error}") from None
        payload |= {"plan": plan, "step": len(plan)}
    if (target := payload["target"]) is not None:  # given without places for props, which are absent there
        absent = np.zeros(wide.part_count - assembly.part_count, dtype=np.uint8)
        payload["target"] = np.concatenate([target, absent])
    return wide, payload


def replan_record(answer: ReplanResult, criterion: Criterion) -> dict[str, Any]:
    """Return an answer as JSON values, its plans as in plan files; `criterion` is the stability criterion."""
    cut = answer.outcome is Outcome.NOT_FOUND and answer.deadline_passed
    return {
        "criterion": criterion,
        "outcome": NOT_YET if cut else answer.outcome.value,
        "decided_by": answer.decided_by.value,
        "direction": answer.direction.value,
        "built": answer.built,
        "steps": answer.steps,
        "reached": answer.reached,
        "seconds": round(answer.seconds, 6),
        "deadline_passed": answer.deadline_passed,
        "reason": answer.reason,
        "moving": list(answer.moving),
        "plans": [plan_to_dict(plan) for plan in answer.plans],
        "unreserved": answer.unreserved,
        "replays": [replayed.to_dict() for replayed in answer.replays],
        "distances": np.round(answer.distance, 4).tolist(),
    }


def _load_policy(config: WorkerConfig) -> tuple[Any, str]:
    """Return the policy of a run and its description."""
    if config.run is None:
        return None, ""
    from falsework.utils.tensors import check_torch

    check_torch()
    import torch

    from falsework.learn.training.checkpoint import load_run

    torch.set_num_threads(1)
    run = load_run(config.run, assembly=config.assembly)
    return run.policy, run.settings.policy.kind


def _dump(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":")).encode()
