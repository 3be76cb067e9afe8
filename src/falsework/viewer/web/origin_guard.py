"""Guard of the viewer's web server: only requests that name the served address can open and control the page.

Answers carry the content security policy.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from falsework.errors import DependencyError
from falsework.utils.lazy import importing
from falsework.viewer.web.content_policy import content_policy
from falsework.viewer.web.links import Unit, target_of

LOCAL = ("localhost", "127.0.0.1", "::1")
"""Names of this machine that are unreachable from others."""
WILDCARDS = ("0.0.0.0", "::")
"""Wildcard addresses: all addresses of this machine."""
_GOODBYE = 0.5
"""Seconds that a browser has to confirm the end of a connection; one that does not read never does."""
_SERVING = threading.Lock()


def import_viser() -> Any:
    """Return the package that serves the page."""
    with importing("the page needs viser; install it with pip install 'falsework[viewer]'"):
        import viser
    return viser


class OriginGuard:
    """Decision on the `Host` and `Origin` headers of requests.

    A browser lets a page of any site open a web socket to any address and names that site in `Origin`; a site
    whose name resolves to this machine (DNS rebinding) is named in `Host`. Both are rejected. An IP address in `Host`
    cannot come from rebinding, so a server on all interfaces accepts every one.
    """

    def __init__(self, host: str, allowed: Iterable[str] = ()) -> None:
        """Collect the names that the server answers to.

        Args:
            allowed: further names under which browsers reach it, such as that of a proxy.
        """
        self._extra = {name.strip().lower() for name in allowed} - {""}
        self._names = {*LOCAL, host.lower(), *self._extra}
        self._any_address = host in WILDCARDS
        if self._any_address:
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}

    def refusal(self, hosts: list[str], origins: list[str]) -> str | None:
        """Return why a request is rejected, in one line, or None if it is accepted.

        Args:
            hosts: all `Host` headers.
            origins: all `Origin` headers; programs other than browsers send none.
        """
        name = _host_name(f"//{hosts[0]}") if len(hosts) == 1 else None
        if name is None or not (name in self._names or (self._any_address and _is_address(name))):
            return f"host {', '.join(hosts) or 'not given'} is not served; start with --allow-host to serve it"
        for origin in origins:
            site = _host_name(origin)
            same = site is not None and urlsplit(origin).netloc.lower() == hosts[0].lower()
            if not same and site not in self._extra:
                return f"pages of {origin} may not use this server; start with --allow-host to let them"
        return None


@contextlib.contextmanager
def unannounced() -> Iterator[None]:
    """Keep viser from saying that it starts and stops, at a terminal or below a cell of a notebook."""
    import rich

    console = rich.get_console()
    quiet, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = quiet


def start_server(
    viser: Any, host: str, port: int, guard: OriginGuard, *, go: Callable[[Unit, float], None] | None = None
) -> Any:
    """Start viser's server behind a guard, with a content security policy.

    viser has no settings for these, so `websockets.asyncio.server.serve` is replaced while the server starts.

    Args:
        port: port to listen at; if it is in use, the next free one, and any if it is 0.
        go: called with the step or second that a click on a link of the page asks for, see `links`.
    """
    from websockets.asyncio import server as sockets

    _check_address(host)
    policy, plain, guarded = content_policy(viser), sockets.serve, False

    def serve(*arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        nonlocal guarded
        guarded = True

        def checked(connection: Any, request: Any) -> Any:
            refusal = guard.refusal(request.headers.get_all("Host"), request.headers.get_all("Origin"))
            if refusal is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
            target = target_of(request.path)
            if go is not None and target is not None:
                if request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
                    return connection.respond(HTTPStatus.FORBIDDEN, "a link of another page\n")
                asyncio.get_running_loop().run_in_executor(None, go, *target)
                return connection.respond(HTTPStatus.NO_CONTENT, "")
            response = None if process_request is None else process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = policy
                response.headers["X-Content-Type-Options"] = "nosniff"
            return response

        return plain(*arguments, process_request=checked, close_timeout=_GOODBYE, **options)

    with _SERVING, unannounced():
        sockets.serve = serve  # type: ignore[assignment]
        try:
            made = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            sockets.serve = plain  # type: ignore[misc]
        if not guarded:
            made.stop()
            raise DependencyError("this version of viser cannot be guarded; pip install 'falsework[viewer]'")
    return made


def _check_address(host: str) -> None:
    """Raise unless this machine has an address of this name; viser would try one port after the other for ever."""
    failure: OSError | None = None
    for family, kind, _, _, address in socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM):
        with socket.socket(family, kind) as tried:
            try:
                tried.bind(address)
            except OSError as error:
                failure = error
            else:
                return
    raise failure or OSError(f"{host} has no address")


def _host_name(url: str) -> str | None:
    """Return the host name in a URL, lower case; None where there is none."""
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
