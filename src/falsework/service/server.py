"""HTTP server with limits on slow and idle connections."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.service.app import application
from falsework.service.metrics import Metrics
from falsework.service.pool import Pool
from falsework.service.settings import HEADER_BYTES, LONGEST_DEADLINE, STUCK_SECONDS, ServiceSettings

_STOP_SECONDS = 3
"""Seconds in which open requests may end when the service stops."""


def run_service(
    assembly: Assembly,
    settings: ServiceSettings,
    *,
    run: Path | None = None,
    started: Callable[[str], None] | None = None,
) -> None:
    """Serve one structure until SIGINT or SIGTERM; then end in good order.

    Args:
        assembly: the structure; its clearance table is computed first, if absent.
        settings: where to listen, and bounds.
        run: folder of a trained policy.
        started: called with the address once requests are taken.

    Raises:
        InputError: the address cannot be had, or the run cannot be used.
    """
    assembly.clearance  # noqa: B018 - computed here once, and not in every worker
    listener = listen(settings.host, settings.port)
    try:
        asyncio.run(_serve(assembly, settings, run, listener, started))
    finally:
        listener.close()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        # With the protocol named, asyncio sends at once; else every answer would wait 40 ms for an acknowledgement.
        listener = socket.socket(family, kind, protocol)
        if sys.platform != "win32":  # there, it would let several services have one port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        reason = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be had ({error.strerror or error})"
        raise InputError(f"port {port} of {host} {reason}; choose another with --port or --host") from None
    return listener


def server_of(assembly: Assembly, pool: Pool, settings: ServiceSettings, metrics: Metrics) -> uvicorn.Server:
    """Return a server that is not running yet; it keeps clients to the bounds of the settings."""
    config = uvicorn.Config(
        application(assembly, pool, settings, metrics),  # type: ignore[arg-type]
        http=_protocol(settings),
        ws="none",
        loop="asyncio",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=settings.idle_seconds,
        timeout_graceful_shutdown=_STOP_SECONDS,
        h11_max_incomplete_event_size=HEADER_BYTES,
    )
    return _Server(config)


class _Server(uvicorn.Server):
    """Server that a signal ends in good order; uvicorn raises the signal again, before the workers have ended."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        with super().capture_signals():
            yield
            self._captured_signals.clear()


async def _serve(
    assembly: Assembly,
    settings: ServiceSettings,
    run: Path | None,
    listener: socket.socket,
    started: Callable[[str], None] | None,
) -> None:
    metrics = Metrics()
    pool = Pool(assembly, settings, metrics, run=run)
    await pool.start()  # before any request is accepted, so that errors are reported here
    server = server_of(assembly, pool, settings, metrics)
    announcing = asyncio.create_task(_announce(server, listener, started))
    try:
        await server.serve(sockets=[listener])
    finally:
        announcing.cancel()
        await pool.stop()


async def _announce(server: uvicorn.Server, listener: socket.socket, started: Callable[[str], None] | None) -> None:
    while not server.started:
        await asyncio.sleep(0.01)
    host, port = listener.getsockname()[:2]
    if started is not None:
        started(f"http://{f'[{host}]' if ':' in host else host}:{port}")


def _protocol(settings: ServiceSettings) -> type[H11Protocol]:
    """Return an HTTP/1.1 protocol with limits on the time for a request and its answer, and on idle connections."""
    longest = LONGEST_DEADLINE + settings.body_seconds + STUCK_SECONDS
    waiting: dict[IdleTimeoutProtocol, None] = {}  # connections without a whole header, longest without first

    class IdleTimeoutProtocol(H11Protocol):
        """Connection with time limits, which makes room for others while no request is being answered on it."""

        _hang_up: asyncio.TimerHandle | None = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._within(settings.header_seconds)
            waiting[self] = None
            if len(waiting) > settings.connections:
                next(iter(waiting)).make_room()

        def make_room(self) -> None:
            """Close an idle connection: clients that only connect must not keep others out."""
            waiting.pop(self, None)
            self.transport.abort()

        def data_received(self, data: bytes) -> None:
            if self._hang_up is None:
                self._within(settings.header_seconds)
            active = self._active()
            super().data_received(data)
            if self._active() and not active:
                waiting.pop(self, None)
                self._within(longest)

        def on_response_complete(self) -> None:
            self._within(None)
            super().on_response_complete()
            if self._active():  # the next request was there already
                self._within(longest)
            elif not self.transport.is_closing():
                waiting[self] = None

        def connection_lost(self, exc: Exception | None) -> None:
            waiting.pop(self, None)
            self._within(None)
            super().connection_lost(exc)

        def _active(self) -> bool:
            return self.cycle is not None and not self.cycle.response_complete

        def _within(self, seconds: float | None) -> None:
            if self._hang_up is not None:
                self._hang_up.cancel()
            self._hang_up = None
            if seconds is not None:
                self._hang_up = self.loop.call_later(seconds, self._end)

        def _end(self) -> None:
            logging.getLogger("falsework.service").info("hung up on a client that took too long")
            self.transport.abort()

    return IdleTimeoutProtocol
