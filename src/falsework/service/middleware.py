"""ASGI middleware: authentication, size and rate limits, and error masking."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
import time
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from falsework.service.metrics import Metrics
from falsework.service.settings import HEADER_BYTES, ServiceSettings
from falsework.service.worker import refusal

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

OPEN_PATHS = frozenset({"/health"})
"""Answered without a token, so that monitoring needs none."""
INSIDE = "the request failed inside; the log of the service says why"
_HOSTS = frozenset({b"localhost", b"127.0.0.1", b"[::1]"})
_HEADERS = [
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"content-security-policy", b"default-src 'none'; style-src 'unsafe-inline'"),
]

log = logging.getLogger("falsework.service")


class _Refused(Exception):
    """Refusal of a request."""

    def __init__(self, status: int, text: str, headers: tuple[tuple[bytes, bytes], ...] = ()) -> None:
        super().__init__(text)
        self.status = status
        self.headers = headers


class ServiceMiddleware:
    """Middleware that checks host, token and size, buffers whole requests, and masks errors.

    Without a token only this machine can connect, but a page in its browser could be made to do so under another name
    for 127.0.0.1; hence the check of the host.
    """

    def __init__(self, app: App, settings: ServiceSettings, metrics: Metrics) -> None:
        self._app = app
        self._settings = settings
        self._metrics = metrics
        self._served = 0
        self._digest = None if settings.token is None else _digest(settings.token.encode())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection, as ASGI requires."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await self._serve(scope, receive, send)
        else:
            await send({"type": "websocket.close", "code": 1008})

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        begun, status = time.perf_counter(), 0

        async def watch(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
            await send(message)

        self._served += 1
        try:
            self._check(scope)
            # What is answered without a token waits for nothing from the client.
            body = b"" if scope["path"] in OPEN_PATHS else await self._read(scope, receive)
            await self._app(scope, _again(body, receive), watch)
        except _Refused as refused:
            await _respond(watch, refused.status, str(refused), refused.headers)
        except ConnectionError:
            return
        except Exception:
            log.exception("a request failed")
            if not status:
                await _respond(watch, 500, INSIDE)
        finally:
            self._served -= 1
            self._metrics.answered(scope["path"], status, time.perf_counter() - begun)

    def _check(self, scope: Scope) -> None:
        headers = dict(scope["headers"])
        if sum(len(name) + len(value) for name, value in scope["headers"]) > HEADER_BYTES:
            close = ((b"connection", b"close"),)
            raise _Refused(431, f"the header is larger than {HEADER_BYTES} bytes; send less", close)
        if self._digest is None:
            host = headers.get(b"host", b"").lower()
            name = host.partition(b"]")[0] + b"]" if host.startswith(b"[") else host.partition(b":")[0]
            if name not in _HOSTS:
                raise _Refused(400, "without a token this service answers to localhost only; use that name")
        elif scope["path"] not in OPEN_PATHS:
            kind, _, token = headers.get(b"authorization", b"").partition(b" ")
            if kind.lower() != b"bearer" or not hmac.compare_digest(_digest(token.strip()), self._digest):
                challenge = (b"www-authenticate", b"Bearer")
                raise _Refused(401, "this service requires its token: send Authorization: Bearer TOKEN", (challenge,))
        if self._served > self._settings.connections and scope["path"] not in OPEN_PATHS:
            raise _Refused(503, "too many requests at a time; try again in a moment", ((b"retry-after", b"1"),))

    async def _read(self, scope: Scope, receive: Receive) -> bytes:
        """Read a whole request within the limits on size and time."""
        limit = self._settings.body_bytes
        too_large = _Refused(
            413, f"the request is larger than {limit} bytes; ask for less", ((b"connection", b"close"),)
        )
        announced = dict(scope["headers"]).get(b"content-length", b"0")
        if announced.isdigit() and int(announced[:20]) > limit:
            raise too_large
        body = bytearray()
        try:
            async with asyncio.timeout(self._settings.body_seconds):
                more = True
                while more:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise ConnectionError
                    body += message.get("body", b"")
                    more = message.get("more_body", False)
                    if len(body) > limit:
                        raise too_large
        except TimeoutError:
            close = ((b"connection", b"close"),)
            raise _Refused(408, f"the request did not arrive within {self._settings.body_seconds:g} s", close) from None
        return bytes(body)


def _again(body: bytes, receive: Receive) -> Receive:
    """Return a receiver that yields the body read already, then further messages."""
    given = False

    async def again() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


async def _respond(send: Send, status: int, text: str, headers: tuple[tuple[bytes, bytes], ...] = ()) -> None:
    body = refusal(text)
    own = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()), *headers]
    await send({"type": "http.response.start", "status": status, "headers": own})
    await send({"type": "http.response.body", "body": body})


def _digest(token: bytes) -> bytes:
    """Hash a token to a fixed length, so that a comparison takes the same time for every token."""
    return hashlib.sha256(token).digest()
