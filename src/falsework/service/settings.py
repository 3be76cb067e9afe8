"""Service settings: addresses, and bounds on requests and time."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field

from falsework.errors import InputError
from falsework.stability.verdict import Criterion
from falsework.utils.cores import core_count
from falsework.utils.quantity import check_counts

TOKEN_VARIABLE = "FALSEWORK_TOKEN"
SHORTEST_TOKEN = 16
"""Fewest characters of a token."""
STABILITY_BATCH = 64
"""Requests about stability that a worker takes at a time."""
WINDOW = 0.003
"""Time that the first request of a batch waits for others, seconds."""
HEADER_BYTES = 16 * 1024
"""Largest header of a request, bytes."""
LONGEST_DEADLINE = 60.0
"""Longest deadline of a request for a plan, seconds."""
STABILITY_SECONDS = 10.0
"""Deadline of a request for verdicts, seconds."""
PICTURE_SECONDS = 60.0
"""Deadline of a request for a picture, the start of the process that draws included, seconds."""
GRACE = 0.015
"""Largest delay of an answer after its deadline while nothing blocks this process, seconds."""
STUCK_SECONDS = 10.0
"""Time after its last deadline after which a worker that is still busy is replaced."""


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
    workers: int = field(default_factory=core_count)
    """Number of planning processes; one more computes verdicts."""
    batch: int = 8
    """Requests that a worker takes at a time to plan together."""
    queue: int = 256
    """Requests that may wait; more are refused."""
    connections: int = 512
    """Idle connections, the oldest of which make room for new ones, and requests at a time; more are refused."""
    body_bytes: int = 1 << 20
    """Largest request."""
    idle_seconds: int = 15
    """Between two requests on one connection."""
    header_seconds: float = 10.0
    """For a client to send the header ..."""
    body_seconds: float = 10.0
    """... and the whole request."""
    deadline: float = 5.0
    """For a plan, unless the request names another."""
    states: int = 256
    """States in one request about stability."""
    criterion: Criterion = "contact"
    """Stability criterion, see `falsework.stability.StabilitySettings`."""
    robots: int = 2
    """Robots of a request that names neither them nor a plan; those of a run that is served."""
    removable_only_if_clear: bool = False
    """Whether each plan has parts move along collision-free straight lines only, as a run that is served does."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"port {self.port} does not exist; give 0 to 65535")
        check_counts(self, "workers", "batch", "queue", "connections", "body_bytes", "states")
        if self.token is None and not is_loopback(self.host):
            raise InputError(
                f"{self.host} can be reached from other machines; give a token with --token or {TOKEN_VARIABLE}, "
                "or stay on 127.0.0.1"
            )
        if self.token is not None and (len(self.token) < SHORTEST_TOKEN or not self.token.isascii()):
            raise InputError(
                f"the token must have at least {SHORTEST_TOKEN} plain characters; openssl rand -hex 24 makes one"
            )
