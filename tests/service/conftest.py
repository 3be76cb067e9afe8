"""A service that runs in a thread, for tests that talk to it as clients do."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the service needs fastapi; pip install 'falsework[service]'")

import httpx

from falsework import Assembly, load_structure
from falsework.service import ServiceSettings
from falsework.service.metrics import Metrics
from falsework.service.pool import Pool
from falsework.service.server import listen, server_of

SLOW = 1.0
"""Seconds that clients of the tests may take for a header or a body."""


@dataclass
class Live:
    """A running service."""

    assembly: Assembly
    settings: ServiceSettings
    pool: Pool
    url: str
    loop: asyncio.AbstractEventLoop
    client: httpx.Client = field(init=False)

    def __post_init__(self) -> None:
        self.client = httpx.Client(base_url=self.url, timeout=60)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self.client.base_url.host, self.client.base_url.port or 0

    def post(self, path: str, content: Any) -> httpx.Response:
        """Send JSON."""
        return self.client.post(path, json=content)

    def wait_until_well(self, seconds: float = 60) -> None:
        """Wait until all workers are there."""
        end = time.monotonic() + seconds
        while self.client.get("/health").status_code != 200 or self.pool.ready["replan"] < self.settings.workers:
            assert time.monotonic() < end, "no worker came back"
            time.sleep(0.05)


def run(assembly: Assembly, settings: ServiceSettings) -> Iterator[Live]:
    """Serve in a thread until the test is done."""
    metrics, begun, ended = Metrics(), threading.Event(), threading.Event()
    pool = Pool(assembly, settings, metrics)
    listener = listen(settings.host, settings.port)
    found: dict[str, Any] = {}

    async def serve() -> None:
        server = server_of(assembly, pool, settings, metrics)
        await pool.start()
        task = asyncio.create_task(server.serve(sockets=[listener]))
        while not server.started:
            await asyncio.sleep(0.01)
        found["loop"] = asyncio.get_running_loop()
        begun.set()
        while not ended.is_set():
            await asyncio.sleep(0.02)
        server.should_exit = True
        await task

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    assert begun.wait(120)
    host, port = listener.getsockname()[:2]
    live = Live(assembly, settings, pool, f"http://{host}:{port}", found["loop"])
    try:
        yield live
    finally:
        live.client.close()
        ended.set()
        thread.join(30)
        listener.close()
        assert not thread.is_alive()


@pytest.fixture(scope="session")
def live() -> Iterator[Live]:
    """An arch of five blocks, one planner, and little patience with clients."""
    settings = ServiceSettings(
        port=0,
        workers=1,
        header_seconds=SLOW,
        body_seconds=SLOW,
        body_bytes=20_000,
        idle_seconds=int(SLOW),
        connections=32,
    )
    yield from run(load_structure("arch:blocks=5"), settings)


@pytest.fixture(scope="module")
def grounded() -> Iterator[Live]:
    """An arch of five blocks on the ground, where props can stand."""
    yield from run(load_structure("arch:blocks=5", ground=True), ServiceSettings(port=0, workers=1))
