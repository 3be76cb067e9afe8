"""Workers without what only Unix has: forks, and event loops that wait for pipes."""

from __future__ import annotations

import asyncio
import json
import os
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="needs fastapi; pip install 'falsework[service]'")

from falsework import load_structure
from falsework.service import ServiceSettings
from falsework.service.metrics import Metrics
from falsework.service.pool import Pool, Reply


class Loop(asyncio.SelectorEventLoop):
    """Event loop that cannot wait for pipes, as on Windows."""

    def add_reader(self, fd: Any, callback: Any, *args: Any) -> None:
        raise NotImplementedError


def refuse() -> int:
    raise NotImplementedError


def test_workers_start_by_spawn_and_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fork", refuse)
    arch = load_structure("arch:blocks=3")
    pool = Pool(arch, ServiceSettings(workers=1), Metrics())
    states = np.where(arch.boundary, 2, 0).astype(np.uint8)[None]

    async def serve() -> Reply:
        await pool.start()
        try:
            return await pool.ask("stability", (states, False), 60.0)
        finally:
            await pool.stop()

    with asyncio.Runner(loop_factory=Loop) as runner:
        reply = runner.run(serve())
    assert reply.status == 200
    assert json.loads(reply.body)["verdicts"][0]["verdict"] == "stable"
