"""Worker pool: batching, deadlines, and recovery of lost workers.

Everything here runs in the event loop of the process that serves clients, except for the threads that listen to the
pipes of the workers; no call blocks for long. A request that waits is answered at its deadline whatever the workers do.
The requests of a worker that dies are retried once, each by itself; a request that kills the next worker as well is
refused.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import json
import logging
import multiprocessing
import os
import threading
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, get_args

from falsework.assembly.model import Assembly
from falsework.errors import FalseworkError, InputError
from falsework.service.metrics import Metrics
from falsework.service.settings import GRACE, STABILITY_BATCH, STUCK_SECONDS, WINDOW, ServiceSettings
from falsework.service.worker import NOT_YET, Done, Failed, Item, Kind, Ready, WorkerConfig, refusal, work
from falsework.stability.verdict import Criterion

KINDS: tuple[Kind, ...] = get_args(Kind)
STANDING: tuple[Kind, ...] = ("replan", "stability")
"""Kinds whose workers start with the service; the one that draws starts with the first picture."""
START_SECONDS = 300.0
"""Time limit for a worker to load its structure."""
_TRIES = 2
"""Workers that a request may cost before it is refused."""
_EXPRESS = 2
"""Requests that the first of several planners takes at a time."""
_HEAD_START = 0.02
"""Seconds before the deadline at which a worker is to be done, so that its answer is here in time."""
_BACKOFF = (0.0, 0.5, 2.0, 10.0)
"""Seconds before replacing a worker that died before its first request, by the number of such failures."""
_TOO_MUCH: dict[Kind, str] = {
    "stability": "verdict within {seconds:g} s; try again, or ask about fewer states",
    "picture": "picture within {seconds:g} s; try again, or ask for a smaller one",
}
_QUIET = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

log = logging.getLogger("falsework.service")


@dataclass(frozen=True)
class Reply:
    """Answer to a client."""

    status: int
    body: bytes
    """JSON, or a picture as PNG."""


@dataclass(eq=False)
class PendingRequest:
    """Request that waits for its answer."""

    kind: Kind
    payload: Any
    deadline: float
    """On the clock of the event loop."""
    future: asyncio.Future[Reply]
    number: int
    tries: int = 0

    @property
    def open(self) -> bool:
        """Whether the answer is still awaited."""
        return not self.future.done()


@dataclass(eq=False)
class _Worker:
    """Worker process and the requests that it works on."""

    kind: Kind
    process: Any
    pipe: Connection
    ready: bool = False
    busy: dict[int, PendingRequest] | None = field(default_factory=dict)
    """Requests that it has; None once it is waiting for more."""
    watchdog: asyncio.TimerHandle | None = None


class Pool:
    """Worker processes and their request queues."""

    def __init__(
        self, assembly: Assembly, settings: ServiceSettings, metrics: Metrics, *, run: Path | None = None
    ) -> None:
        """Get ready; `start` begins."""
        self.settings = settings
        self.policy = ""
        """Description of the policy that proposes actions; empty for none."""
        self._recipes = {
            kind: WorkerConfig(assembly, kind, run if kind == "replan" else None, settings.criterion) for kind in KINDS
        }
        self._metrics = metrics
        self.workers: list[_Worker] = []
        self._queues: dict[Kind, list[tuple[float, int, PendingRequest]]] = {kind: [] for kind in KINDS}
        self._planned: dict[Kind, asyncio.TimerHandle] = {}
        self._failures: dict[Kind, int] = dict.fromkeys(KINDS, 0)
        self._numbers = itertools.count()
        self._started: asyncio.Future[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._closing = False
        self._draws = False
        """Whether a worker that draws was started."""

    @property
    def busy(self) -> int:
        """Workers that have requests."""
        return sum(worker.busy is not None for worker in self.workers)

    @property
    def waiting(self) -> int:
        """Requests that no worker has taken yet."""
        return sum(ticket.open for queue in self._queues.values() for _, _, ticket in queue)

    @property
    def ready(self) -> dict[Kind, int]:
        """Workers that take requests, of each kind that starts with the service."""
        return {kind: sum(worker.ready for worker in self.workers if worker.kind == kind) for kind in STANDING}

    async def start(self) -> None:
        """Start all workers and wait until each has loaded the structure."""
        for name, value in _QUIET.items():
            os.environ.setdefault(name, value)
        self._started = asyncio.get_running_loop().create_future()
        for kind in STANDING:
            for _ in range(self.settings.workers if kind == "replan" else 1):
                self._replace(kind)
        try:
            await asyncio.wait_for(self._started, START_SECONDS)
        except TimeoutError:
            raise FalseworkError(f"no worker was ready within {START_SECONDS:g} s; try a smaller structure") from None
        finally:
            if self._started.cancelled() or not self._started.done() or self._started.exception():
                await self.stop()

    async def stop(self) -> None:
        """End all workers and refuse what is still waiting."""
        self._closing = True
        for task in self._tasks:
            task.cancel()
        for queue in self._queues.values():
            for _, _, ticket in queue:
                _give(ticket, Reply(503, refusal("the service is stopping")))
            queue.clear()
        for worker in list(self.workers):
            for ticket in (worker.busy or {}).values():
                _give(ticket, Reply(503, refusal("the service is stopping")))
            self._drop(worker)
            worker.process.kill()
        await asyncio.sleep(0)

    async def ask(self, kind: Kind, payload: Any, seconds: float) -> Reply:
        """Have a worker answer a request, by its deadline at the latest.

        Args:
            payload: as `Item` says.
        """
        loop = asyncio.get_running_loop()
        if kind == "picture" and not self._draws:
            self._draws = True
            self._replace(kind)
        if len(self._queues[kind]) >= self.settings.queue:
            self._queues[kind] = [entry for entry in self._queues[kind] if entry[2].open]
            heapq.heapify(self._queues[kind])
        if len(self._queues[kind]) >= self.settings.queue:
            self._metrics.turned_away.inc()
            return Reply(503, refusal("too many requests are waiting; try again in a moment"))
        ticket = PendingRequest(kind, payload, loop.time() + seconds, loop.create_future(), next(self._numbers))
        guard = loop.call_at(ticket.deadline + GRACE, self._late, ticket, seconds)
        try:
            self._put(ticket)
            self._plan(kind, WINDOW)
            return await ticket.future
        finally:
            guard.cancel()

    def _put(self, ticket: PendingRequest) -> None:
        """Queue a request, the one with the least time left first."""
        heapq.heappush(self._queues[ticket.kind], (ticket.deadline, ticket.number, ticket))

    def _plan(self, kind: Kind, seconds: float) -> None:
        """Distribute requests after a moment, when others may have joined them."""
        if kind not in self._planned:
            self._planned[kind] = asyncio.get_running_loop().call_later(seconds, self._hand_out, kind)

    def _hand_out(self, kind: Kind) -> None:
        self._planned.pop(kind, None)
        team = [worker for worker in self.workers if worker.kind == kind]
        idle = [worker for worker in team if worker.ready and worker.busy is None]
        most = {"replan": self.settings.batch, "stability": STABILITY_BATCH, "picture": 1}[kind]
        for place, worker in enumerate(idle):
            # One of several takes few at a time, so that an urgent request finds an idle worker soon.
            limit = min(most, _EXPRESS) if worker is team[0] and len(team) > 1 else most
            batch = self._take(kind, limit, share=len(idle) - place)
            if not batch:
                return
            self.send(worker, batch)

    def _take(self, kind: Kind, limit: int, share: int) -> list[PendingRequest]:
        """Return the most urgent requests for one of `share` idle workers; one that was tried before goes by itself."""
        queue = self._queues[kind]
        limit = min(limit, -(-len(queue) // share))
        batch: list[PendingRequest] = []
        while queue and len(batch) < limit:
            ticket = queue[0][2]
            if ticket.open and ticket.tries and batch:
                break
            heapq.heappop(queue)
            if ticket.open:
                batch.append(ticket)
                if ticket.tries:
                    break
        return batch

    def send(self, worker: _Worker, batch: list[PendingRequest]) -> None:
        """Give a batch to a worker, and stop it where it does not answer in time."""
        loop = asyncio.get_running_loop()
        now = loop.time()
        items = [Item(ticket.number, ticket.payload, ticket.deadline - now - _HEAD_START) for ticket in batch]
        worker.busy = {ticket.number: ticket for ticket in batch}
        last = max(ticket.deadline for ticket in batch)
        worker.watchdog = loop.call_at(last + STUCK_SECONDS, self._stuck, worker)
        self._metrics.batch.labels(worker.kind).observe(len(batch))
        try:
            worker.pipe.send(items)
        except OSError:
            self._lost(worker)

    def _listen(self, worker: _Worker, loop: asyncio.AbstractEventLoop) -> None:
        """Pass messages from the pipe of a worker to the event loop until the worker is gone; runs in a thread.

        Event loops on Windows cannot wait for pipes.
        """
        with contextlib.suppress(RuntimeError):  # the loop is closed
            try:
                while True:
                    loop.call_soon_threadsafe(self._take_in, worker, worker.pipe.recv())
            except (EOFError, OSError):
                worker.pipe.close()
                loop.call_soon_threadsafe(self._lost, worker)

    def _take_in(self, worker: _Worker, message: Ready | Failed | Done | None) -> None:
        if worker not in self.workers:
            return
        if isinstance(message, Done):
            ticket = (worker.busy or {}).pop(message.number, None)
            if ticket is not None:
                self._metrics.answers.labels(worker.kind, message.label).inc()
                _give(ticket, Reply(message.status, message.body))
            return
        if isinstance(message, Failed):
            if self._started is not None and not self._started.done():
                self._started.set_exception(InputError(message.reason))
            log.error("a worker cannot begin: %s", message.reason)
            return
        if isinstance(message, Ready):
            worker.ready = True
            self._failures[worker.kind] = 0
            self.policy = message.policy or self.policy
            complete = self.ready == {"replan": self.settings.workers, "stability": 1}
            if complete and self._started is not None and not self._started.done():
                self._started.set_result(None)
        if worker.watchdog is not None:
            worker.watchdog.cancel()
        worker.busy, worker.watchdog = None, None
        self._hand_out(worker.kind)

    def _lost(self, worker: _Worker) -> None:
        """Retry the requests of a lost worker once, and replace the worker."""
        if worker not in self.workers:
            return
        begun = worker.ready
        self._drop(worker)
        for ticket in (worker.busy or {}).values():
            ticket.tries += 1
            if not ticket.open:
                continue
            if ticket.tries < _TRIES:
                self._put(ticket)
            else:
                _give(
                    ticket, Reply(503, refusal("the workers that had this request were lost; change it or try later"))
                )
        if self._closing:
            return
        if self._started is not None and not self._started.done():
            self._started.set_exception(FalseworkError("a worker died while it loaded the structure; is memory short?"))
            return
        self._metrics.restarts.labels(worker.kind).inc()
        log.warning("a worker was lost (exit code %s); another one takes its place", worker.process.exitcode)
        self._failures[worker.kind] += not begun
        delay = _BACKOFF[min(self._failures[worker.kind], len(_BACKOFF) - 1)]
        asyncio.get_running_loop().call_later(delay, self._replace, worker.kind)
        self._plan(worker.kind, 0.0)

    def _drop(self, worker: _Worker) -> None:
        """Forget a worker, which is gone or about to be ended."""
        self.workers.remove(worker)
        if worker.watchdog is not None:
            worker.watchdog.cancel()

    def _stuck(self, worker: _Worker) -> None:
        """Terminate a worker that does not respond; its closed pipe then reports it."""
        log.error("a worker is stuck and is replaced")
        worker.process.kill()

    def _replace(self, kind: Kind) -> None:
        if not self._closing:
            task = asyncio.get_running_loop().create_task(self._spawn(kind))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _spawn(self, kind: Kind) -> None:
        """Start a worker; in a thread, since its structure goes through a pipe while the new process begins."""
        context = multiprocessing.get_context("spawn")
        mine, theirs = context.Pipe()
        process = context.Process(
            target=work, args=(theirs, self._recipes[kind]), daemon=True, name=f"falsework {kind}"
        )
        await asyncio.get_running_loop().run_in_executor(None, process.start)
        theirs.close()
        if self._closing:
            mine.close()
            process.kill()
            return
        worker = _Worker(kind, process, mine)
        self.workers.append(worker)
        listener = threading.Thread(target=self._listen, args=(worker, asyncio.get_running_loop()), daemon=True)
        listener.start()

    def _late(self, ticket: PendingRequest, seconds: float) -> None:
        """Answer a request whose deadline passed while it waited or was worked on."""
        if not ticket.open:
            return
        self._metrics.late.labels(ticket.kind).inc()
        if ticket.kind == "replan":
            _give(ticket, Reply(200, not_yet(seconds, self.settings.criterion)))
        else:
            _give(ticket, Reply(503, refusal(f"no {_TOO_MUCH[ticket.kind].format(seconds=seconds)}")))


def not_yet(seconds: float, criterion: Criterion) -> bytes:
    """Return the answer to a request for a plan whose deadline passed, which proves nothing."""
    record = {
        "criterion": criterion,
        "outcome": NOT_YET,
        "decided_by": "none",
        "direction": None,
        "built": 0,
        "steps": None,
        "reached": 0,
        "seconds": round(seconds, 6),
        "deadline_passed": True,
        "reason": f"the deadline of {round(1000 * seconds)} ms passed; more time may find a plan",
        "moving": [],
        "plans": [],
        "unreserved": "",
        "replays": [],
        "distances": [],
    }
    return json.dumps(record, separators=(",", ":")).encode()


def _give(ticket: PendingRequest, reply: Reply) -> None:
    if ticket.open:
        with contextlib.suppress(asyncio.InvalidStateError):
            ticket.future.set_result(reply)
