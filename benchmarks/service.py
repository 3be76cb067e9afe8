"""Load test of a service on this machine: one JSON object per line.

    python benchmarks/service.py replan --structure dome-37 --policy my-run
    python benchmarks/service.py stability --rate 300 --seconds 20
    python benchmarks/service.py deadline

Starts `falsework serve` on a free port of 127.0.0.1 and stops it at the end; requests go there and nowhere else, and
their number is bounded by `rate` times `seconds`. Clients keep to a schedule, so that a slow answer does not thin out
the load, and times count from the moment at which a request was due. `cores` is the CPU time that the service
and its workers took, divided by the time on the clock: the share of the machine that the load needs.

`replan`: whole plans from and to the empty and the complete structure, states on the way, a part that is late, a part
not to be touched; 10 a second for two minutes from 16 clients.
`stability`: one state a request, drawn from those that a search checks; 300 a second.
`deadline`: one request after the other with 200 ms, beside two clients that keep the planners busy; the
answer is a plan or `not_yet`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
import tyro
from record import report, write_to
from states import asked_states, find

from falsework import Assembly, find_plans, load_structure, make_task
from falsework.assembly import complete_state, empty_state

MOST_REQUESTS = 60_000
"""Limit on requests of one benchmark."""

Ask = Callable[[int], tuple[str, str, dict[str, Any]]]
"""Maps the number of a request to its kind, its path and its content."""


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["replan", "stability", "deadline"]]
    """Benchmark."""
    structure: str = "dome-37"
    """Built-in name, path, or name of a real structure."""
    policy: str | None = None
    """Folder of a trained run for the structure."""
    rate: float | None = None
    """Requests per second; by default 10 for replan, 300 for stability, 6 for deadline."""
    seconds: float | None = None
    """Duration; by default 120 s for replan, 20 s for the others."""
    clients: int = 16
    """Number of connections."""
    workers: int = 2
    """Number of planning processes."""
    seed: int = 0
    """Seed of the requests."""
    out: Path | None = None
    """File to which the records are appended."""


@dataclass(frozen=True)
class Sample:
    """One request and its outcome."""

    kind: str
    status: int
    seconds: float
    """Seconds from the due time to the end of the answer."""
    outcome: str
    decided_by: str


class Client:
    """One connection to a service on this machine."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        assert parts.hostname == "127.0.0.1", "this benchmark loads nothing but this machine"
        assert parts.port is not None
        self._place = (parts.hostname, parts.port)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def post(self, path: str, content: dict[str, Any]) -> tuple[int, dict[str, Any]]:
        """Return status and content of the answer."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(*self._place)
        reader, writer = self._streams
        body = json.dumps(content).encode()
        head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        status_line, *headers = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        length = next(int(line.split(":")[1]) for line in headers if line.lower().startswith("content-length"))
        return int(status_line.split()[1]), json.loads(await reader.readexactly(length))

    def close(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def load(url: str, ask: Ask, options: Options, rate: float, count: int) -> list[Sample]:
    """Send requests at a steady rate from several clients, each its share in turn."""
    begin = time.perf_counter() + 0.2
    samples: list[Sample] = []

    async def one(place: int) -> None:
        client = Client(url)
        for number in range(place, count, options.clients):
            due = begin + number / rate
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            kind, path, content = ask(number)
            try:
                status, answer = await asyncio.wait_for(client.post(path, content), 30)
            except (OSError, asyncio.IncompleteReadError, TimeoutError) as error:
                client.close()
                status, answer = 0, {"outcome": type(error).__name__}
            taken = time.perf_counter() - due
            samples.append(Sample(kind, status, taken, answer.get("outcome", ""), answer.get("decided_by", "")))
        client.close()

    await asyncio.gather(*(one(place) for place in range(options.clients)))
    return samples


def replans(assembly: Assembly, seed: int) -> Ask:
    """Return requests for plans, no two alike."""
    states = find_plans(assembly, make_task(assembly)).plans[0].states
    random = np.random.default_rng(seed)
    loose = np.flatnonzero(~assembly.boundary)
    full, nothing = complete_state(assembly.boundary).tolist(), empty_state(assembly.boundary).tolist()

    def ask(number: int) -> tuple[str, str, dict[str, Any]]:
        content: dict[str, Any] = {"seed": number, "robots": int(random.integers(2, 4)), "deadline": 2000}
        kind = ("take down", "build", "build on", "late part", "fixed part")[number % 5]
        part = int(random.choice(loose))
        if kind == "take down":
            content |= {"state": full}
        elif kind == "build":
            content |= {"state": nothing, "direction": "assembly"}
        elif kind == "build on":
            state = states[int(random.integers(len(states) // 2, len(states)))]
            content |= {"state": state.tolist(), "direction": "assembly"}
        elif kind == "late part":
            content |= {"state": nothing, "direction": "assembly", "missing": [part]}
        else:
            foot = int(random.choice(np.flatnonzero(states[-6] == 1))) if (states[-6] == 1).any() else part
            content |= {"state": full, "fixed": [foot]}
        return kind, "/replan", content

    return ask


def judgements(assembly: Assembly, seed: int) -> Ask:
    """Return requests for verdicts, one state each."""
    states, _ = asked_states(assembly, 4000, seed=seed)
    return lambda number: ("state", "/stability", {"states": [states[number % len(states)].tolist()]})


def short(assembly: Assembly, seed: int) -> Ask:
    """Return requests with short deadlines; those of the other clients are long."""
    patient = replans(assembly, seed)

    def ask(number: int) -> tuple[str, str, dict[str, Any]]:
        kind, path, content = patient(number)
        if number % 3 == 0:
            return "200 ms", path, {**content, "deadline": 200}
        return kind, path, content

    return ask


def processor_seconds(process: int) -> float:
    """Return the CPU time of a process and its children so far; NaN where the system does not provide it."""
    total = 0.0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            if int(path.parent.name) == process or int(fields[1]) == process:
                total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total or float("nan")


def summarise(options: Options, samples: list[Sample], seconds: float, cores: float) -> None:
    """Print a line for each kind of request and one for all."""
    for kind in [*sorted({sample.kind for sample in samples}), "all"]:
        chosen = [sample for sample in samples if kind in (sample.kind, "all")]
        times = np.sort([sample.seconds for sample in chosen])
        line = {
            "structure": options.structure,
            "policy": options.policy is not None,
            "clients": options.clients,
            "kind": kind,
            "requests": len(chosen),
            "per_second": round(len(chosen) / seconds, 2),
            "errors": sum(sample.status != 200 for sample in chosen),
            "p50": round(float(np.quantile(times, 0.5)), 4),
            "p90": round(float(np.quantile(times, 0.9)), 4),
            "p99": round(float(np.quantile(times, 0.99)), 4),
            "max": round(float(times[-1]), 4),
            "outcomes": dict(Counter(sample.outcome for sample in chosen if sample.outcome)),
            "decided_by": dict(Counter(sample.decided_by for sample in chosen if sample.decided_by)),
            "cores": round(cores, 2),
        }
        report(f"service {options.what}", **line, seeds=(options.seed,))


def main(options: Options) -> None:
    """Start a service, load it, stop it."""
    write_to(options.out)
    rate = options.rate or {"replan": 10.0, "stability": 300.0, "deadline": 6.0}[options.what]
    seconds = options.seconds or (120.0 if options.what == "replan" else 20.0)
    count = min(int(rate * seconds), MOST_REQUESTS)
    spec = find(options.structure)
    assembly = load_structure(spec)
    ask = {"replan": replans, "stability": judgements, "deadline": short}[options.what](assembly, options.seed)
    command = [sys.executable, "-m", "falsework", "serve", spec, "--port", "0", "--json"]
    command += ["--workers", str(options.workers)]
    command += ["--policy", options.policy] if options.policy else []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        try:
            assert service.stdout is not None
            line = service.stdout.readline()
            if not line:
                raise SystemExit("the service did not start")
            before, begun = processor_seconds(service.pid), time.perf_counter()
            samples = asyncio.run(load(json.loads(line)["url"], ask, options, rate, count))
            taken = time.perf_counter() - begun
            used = processor_seconds(service.pid) - before
        finally:
            service.terminate()
    summarise(options, samples, taken, used / taken)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
