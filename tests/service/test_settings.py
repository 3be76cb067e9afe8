"""Clients that may connect: this machine, or those with the token."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from falsework import load_structure
from falsework.errors import InputError
from falsework.service import ServiceSettings
from falsework.service.app import application
from falsework.service.metrics import Metrics
from falsework.service.pool import Pool
from falsework.service.server import listen
from falsework.service.settings import is_loopback

TOKEN = "a-token-of-many-letters"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_this_machine_needs_no_token(host: str) -> None:
    assert is_loopback(host)
    ServiceSettings(host=host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "example.org", "localhost.example.org"])
def test_others_need_one(host: str) -> None:
    with pytest.raises(InputError, match=r"other machines.*--token or FALSEWORK_TOKEN"):
        ServiceSettings(host=host)
    ServiceSettings(host=host, token=TOKEN)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"token": "short"}, "openssl rand"),
        ({"token": "ä" * 30}, "plain characters"),
        ({"port": 70000}, "70000"),
        ({"workers": 0}, "workers is 0"),
        ({"batch": 0}, "batch is 0"),
    ],
)
def test_wrong_settings(options: dict[str, Any], hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        ServiceSettings(**options)


def test_settings_do_not_show_the_token() -> None:
    assert TOKEN not in repr(ServiceSettings(token=TOKEN))


def asking(settings: ServiceSettings) -> Callable[..., httpx.Response]:
    """Ask an application whose workers were never started."""
    assembly, metrics = load_structure("arch:blocks=3"), Metrics()
    app = application(assembly, Pool(assembly, settings, metrics), settings, metrics)

    def ask(path: str, **options: Any) -> httpx.Response:
        async def once() -> httpx.Response:
            transport = httpx.ASGITransport(app=app, raise_app_exceptions=False)  # type: ignore[arg-type]
            async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
                return await client.request("GET", path, **options)

        return asyncio.run(once())

    return ask


def test_a_token_is_wanted_everywhere_but_for_the_health() -> None:
    ask = asking(ServiceSettings(host="0.0.0.0", token=TOKEN))
    for path in ("/structure", "/metrics", "/docs", "/openapi.json", "/replan", "/nowhere"):
        for shown in (
            {},
            {"Authorization": "Bearer wrong"},
            {"Authorization": f"Basic {TOKEN}"},
            {"Authorization": ""},
        ):
            reply = ask(path, headers=shown)
            assert reply.status_code == 401
            assert reply.headers["www-authenticate"] == "Bearer"
            assert list(reply.json()) == ["error"]
            assert TOKEN not in reply.text
    assert ask("/structure", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert ask("/structure", headers={"Authorization": f"bearer {TOKEN}", "Host": "site.example"}).status_code == 200
    assert ask("/health").status_code == 503  # no worker, and anybody may know


def test_what_goes_wrong_inside_stays_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    from falsework.service import schema as description

    def fail(*_: Any, **__: Any) -> Any:
        raise RuntimeError("/secret/path/of/mine")

    monkeypatch.setattr(description, "structure_record", fail)
    reply = asking(ServiceSettings())("/structure")
    assert reply.status_code == 500
    assert reply.json() == {"error": "the request failed inside; the log of the service says why"}


def test_a_port_that_is_taken() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of 127.0.0.1 is taken; choose another with --port"):
            listen("127.0.0.1", port)
    with pytest.raises(InputError, match="cannot be had"):
        listen("203.0.113.7", 0)


def test_answers_are_sent_at_once() -> None:
    """Both ends of a connection leave small packets together no longer than they must."""

    async def options() -> int:
        with listen("127.0.0.1", 0) as listener:
            seen: asyncio.Future[int] = asyncio.get_running_loop().create_future()

            def accepted(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
                ours = writer.get_extra_info("socket")
                seen.set_result(ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
                writer.close()

            async with await asyncio.start_server(accepted, sock=listener):
                _, writer = await asyncio.open_connection(*listener.getsockname())
                try:
                    return await asyncio.wait_for(seen, 5)
                finally:
                    writer.close()

    assert asyncio.run(options()) != 0
