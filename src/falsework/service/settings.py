"""Service settings: addresses, and bounds on requests and time."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field

from falsework.errors import InputError
from falsework.stability.verdict import Criterion
from falsework.utils.cores import core_count

TOKEN_VARIABLE = "FALSEWORK_TOKEN"
SHORTEST_TOKEN = 16


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host's address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class ServiceSettings:
    """Settings of a service; times in seconds."""

    host: str = "127.0.0.1"
    port: int = 8080
    """0 for any free one."""
    token: str | None = field(default=None, repr=False)
    """Token that clients must send; required if other machines can reach the service."""
    workers: int = field(default_factory=lambda: core_count())
    """Number of planning processes; one more computes verdicts."""
    batch: int = 8
    """Requests that a worker takes at a time to plan together."""
    stability_batch: int = 64
    """The same for requests about stability."""
    window: float = 0.003
    """How long the first request of a batch waits for others."""
    queue: int = 256
    """Requests that may wait; more are refused."""
    connections: int = 512
    """Clients at a time."""
    body_bytes: int = 1 << 20
    """Largest request."""
    header_bytes: int = 16 * 1024
    """Largest header."""
    idle_seconds: int = 15
    """Between two requests on one connection."""
    header_seconds: float = 10.0
    """For a client to send the header ..."""
    body_seconds: float = 10.0
    """... and the whole request."""
    deadline: float = 5.0
    """For a plan, unless the request names another."""
    longest_deadline: float = 60.0
    stability_seconds: float = 10.0
    """For verdicts."""
    picture_seconds: float = 60.0
    """For a picture, the start of the process that draws included."""
    states: int = 256
    """States in one request about stability."""
    grace: float = 0.015
    """How much later than its deadline a request is answered at the latest, if nothing blocks this process."""
    stuck_seconds: float = 10.0
    """After its last deadline, a worker that is still busy is replaced."""
    criterion: Criterion = "contact"
    """Stability criterion, see `falsework.stability.StabilitySettings`."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"port {self.port} does not exist; give 0 to 65535")
        for name in ("workers", "batch", "stability_batch", "queue", "connections", "body_bytes", "states"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; give at least 1")
        if self.token is None and not is_loopback(self.host):
            raise InputError(
                f"{self.host} can be reached from other machines; give a token with --token or {TOKEN_VARIABLE}, "
                "or stay on 127.0.0.1"
            )
        if self.token is not None and (len(self.token) < SHORTEST_TOKEN or not self.token.isascii()):
            raise InputError(
                f"the token must have at least {SHORTEST_TOKEN} plain characters; openssl rand -hex 24 makes one"
            )
