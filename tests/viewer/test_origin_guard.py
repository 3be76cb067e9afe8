"""Other web pages cannot open or steer the page: handshakes with a foreign host or origin are refused."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from http.client import HTTPConnection

import pytest

pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")

import viser

from falsework.cli.main import main
from falsework.errors import DependencyError, InputError
from falsework.viewer import Timeline
from falsework.viewer.page.page import Page
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.web.origin_guard import OriginGuard, start_server

PORT = 8230


@pytest.fixture
def page(timeline: Timeline) -> Iterator[Page]:
    opened = Page(ViewerState(timeline), port=PORT, allowed_hosts=["plans.example"])
    yield opened
    opened.close()


def test_a_page_begins_at_the_step_of_its_model(timeline: Timeline) -> None:
    model = ViewerState(timeline)
    model.go_to(2)
    opened = Page(model, port=PORT + 1)
    try:
        assert opened.play.slider.value == 2
    finally:
        opened.close()


def handshake(port: int, host: str, origin: str | None, during: Callable[[], None] | None = None) -> int:
    """Status that an upgrade request gets; `PORT` in the names is the port. Nothing is read after that.

    Args:
        during: called while the connection is open.
    """
    headers = {
        "Host": host.replace("PORT", str(port)),
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    }
    if origin is not None:
        headers["Origin"] = origin.replace("PORT", str(port))
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/", headers=headers)
        status = connection.getresponse().status
        if during is not None:
            during()
        return status
    finally:
        connection.close()


def test_a_client_that_does_not_read_delays_no_end(timeline: Timeline) -> None:
    """It never confirms that the connection ends."""
    opened, seconds = Page(ViewerState(timeline), port=PORT + 2), []

    def close() -> None:
        begun = time.perf_counter()
        opened.close()
        seconds.append(time.perf_counter() - begun)

    assert handshake(opened.port, "localhost:PORT", None, close) == 101
    assert seconds[0] < 4  # viser gives up after six, and leaves the server running


def test_foreign_hosts_and_origins_are_refused(page: Page) -> None:
    for host, origin in (
        ("evil.example", "http://evil.example"),
        ("evil.example:PORT", "http://evil.example:PORT"),
        ("localhost:PORT", "http://evil.example"),
        ("localhost:PORT", "http://localhost:1"),
        ("localhost:PORT", "null"),
        ("192.168.0.7:PORT", "http://192.168.0.7:PORT"),
    ):
        assert handshake(page.port, host, origin) == 403, (host, origin)


def test_the_page_itself_is_served(page: Page) -> None:
    for host, origin in (
        ("localhost:PORT", "http://localhost:PORT"),
        ("127.0.0.1:PORT", "http://127.0.0.1:PORT"),
        ("localhost:9000", "http://localhost:9000"),  # a tunnel from another port
        ("plans.example", "https://plans.example"),
        ("localhost:PORT", "https://plans.example"),  # a proxy that names itself to the server
        ("localhost:PORT", None),
    ):
        assert handshake(page.port, host, origin) == 101, (host, origin)


def test_the_command_names_further_hosts(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[int] = []

    def ask(page: Page) -> None:
        for name in ("a.example", "b.example", "evil.example"):
            found.append(handshake(page.port, name, f"http://{name}"))

    monkeypatch.setattr(Page, "wait", ask)
    assert main(["view", "arch:blocks=3", "--port", str(PORT), "--allow-host", "a.example, B.example"]) == 0
    assert found == [101, 101, 403]


def test_files_of_the_page_are_guarded_too(page: Page) -> None:
    for host, status in (("localhost", 200), ("evil.example", 403)):
        connection = HTTPConnection("127.0.0.1", page.port, timeout=10)
        connection.request("GET", "/", headers={"Host": host})
        assert connection.getresponse().status == status
        connection.close()


def test_a_server_on_all_interfaces_answers_to_addresses_but_not_to_names() -> None:
    guard = OriginGuard("0.0.0.0")
    assert guard.refusal(["192.168.0.7:8080"], ["http://192.168.0.7:8080"]) is None
    assert guard.refusal(["[fe80::1]:8080"], ["http://[fe80::1]:8080"]) is None
    assert "evil.example" in str(guard.refusal(["evil.example:8080"], ["http://evil.example:8080"]))
    assert "not given" in str(guard.refusal([], []))
    assert guard.refusal(["localhost", "localhost"], []) is not None
    assert guard.refusal(["[broken"], []) is not None


@pytest.mark.parametrize("host", ["999.1.1.1", "192.0.2.1"])  # no address; one for documentation, of no machine
def test_an_address_of_no_machine_is_refused_at_once(host: str, timeline: Timeline) -> None:
    with pytest.raises(InputError, match=f"cannot listen at {host}"):
        Page(ViewerState(timeline), host=host, port=PORT)


def test_a_server_that_the_guard_does_not_reach_is_stopped() -> None:
    class Unguarded:
        stopped = False

        def __init__(self, **_: object) -> None:
            pass

        def stop(self) -> None:
            Unguarded.stopped = True

    class Package:
        ViserServer = Unguarded
        __file__ = viser.__file__

    with pytest.raises(DependencyError, match="cannot be guarded"):
        start_server(Package, "127.0.0.1", PORT, OriginGuard("127.0.0.1"))
    assert Unguarded.stopped
