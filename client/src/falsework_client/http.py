"""Requests to a service."""

from __future__ import annotations

import json
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from falsework_client.errors import ClientError

_HERE = frozenset({"localhost", "127.0.0.1", "::1"})


def ask(url: str, question: Any = None, *, token: str | None = None, seconds: float = 10.0) -> Any:
    """Ask a service and return its answer: JSON values, or the bytes of a picture.

    Args:
        url: address with the path.
        question: JSON values, sent as POST; None for GET.
        token: of the service, if it wants one.
        seconds: to wait for the answer.

    Raises:
        ClientError: there is no service, or it refuses; one line.
    """
    headers = {"Content-Type": "application/json"}
    if token:
        headers["Authorization"] = f"Bearer {token}"
    body = None if question is None else json.dumps(question).encode()
    try:
        host = urllib.parse.urlsplit(url).hostname
        # A proxy of the network knows nothing of services on this machine.
        handlers = [urllib.request.ProxyHandler({})] if host in _HERE else []
        with urllib.request.build_opener(*handlers).open(
            urllib.request.Request(url, body, headers), timeout=seconds
        ) as reply:
            kind, content = reply.headers.get_content_type(), reply.read()
    except urllib.error.HTTPError as error:
        with error:
            raise ClientError(_refusal(url, error.code, error.read())) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise ClientError(
            f"no service answers at {url} ({reason}); start one with falsework serve, or leave the address out"
        ) from None
    if kind == "image/png":
        return content
    try:
        return json.loads(content)
    except ValueError:
        raise ClientError(f"what answers at {url} is no falsework service; give another address") from None


def _refusal(url: str, status: int, body: bytes) -> str:
    try:
        return " ".join(str(json.loads(body)["error"]).split())
    except (ValueError, TypeError, KeyError):
        return f"{url} answers with status {status} and is no falsework service; give another address"
