"""Page that viser serves: address, clients, controls that change without events, and its end."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator

from falsework.errors import InputError
from falsework.utils.files.printable import printable
from falsework.viewer.web.links import Unit
from falsework.viewer.web.origin_guard import LOCAL, WILDCARDS, OriginGuard, import_viser, start_server, unannounced


class ServedPage:
    """Browser page that all clients share."""

    def __init__(
        self, host: str, port: int, allowed_hosts: Iterable[str], go: Callable[[Unit, float], None] | None = None
    ) -> None:
        """Start the server.

        Args:
            port: port to listen at; if it is in use, the next free one.
            allowed_hosts: names other than `host` under which browsers may open the page.
            go: called with the step or second that a click on a link of the page asks for.
        """
        self.host = host
        self._lock, self._stop, self._quiet = threading.RLock(), threading.Event(), False
        try:
            self.server = start_server(import_viser(), host, port, OriginGuard(host, allowed_hosts), go=go)
        except OSError as error:
            raise InputError(f"cannot listen at {host} port {port} ({error.strerror}); choose another") from None

    @property
    def port(self) -> int:
        """Port of the page."""
        return int(self.server.get_port())

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        name = "localhost" if self.host in (*LOCAL, *WILDCARDS) else self.host
        return f"http://{name}:{self.port}"

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        with unannounced():
            self.server.stop()

    def wait(self) -> None:
        """Serve until interrupted."""
        while not self._stop.wait(1.0):
            pass

    @contextlib.contextmanager
    def quiet(self) -> Iterator[None]:
        """Change controls without handling their events."""
        before, self._quiet = self._quiet, True
        try:
            yield
        finally:
            self._quiet = before

    def _set_theme(self, name: str) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 114, 178))
        gui.set_panel_label(f"falsework: {printable(name)}")


def check_host(host: str) -> str | None:
    """Return a warning if others can reach the page, None if not."""
    if not host.strip():
        raise InputError("--host is empty; leave it out to serve this machine alone")
    if host in LOCAL:
        return None
    return f"every client that can reach {host} can see and control this page; there is no password"


def serve(page: ServedPage) -> None:
    """Serve until interrupted by the keyboard."""
    with contextlib.suppress(KeyboardInterrupt):
        page.wait()
    with contextlib.suppress(KeyboardInterrupt):  # a second Ctrl-C
        page.close()
