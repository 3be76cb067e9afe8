"""Whatever comes in, the answer is one line of JSON with the right status and says nothing about the inside."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import httpx
import pytest

JSON = {"Content-Type": "application/json"}
STATE = [1, 1, 1, 1, 1, 2, 2]


def expect(reply: Any, status: int, *hints: str) -> None:
    """An error as it must be."""
    assert reply.status_code == status, reply.text
    assert reply.headers["content-type"] == "application/json"
    content = reply.json()
    assert list(content) == ["error"]
    text = content["error"]
    assert "\n" not in text
    assert text
    for hint in hints:
        assert hint in text, text
    for leak in ("Traceback", ".py", "/work", "/home", os.getcwd(), "File "):
        assert leak not in text, text


def pids(live: Any, kind: str) -> list[int]:
    """Process ids of the workers of a kind."""
    return [worker.process.pid for worker in live.pool.workers if worker.kind == kind]


@pytest.mark.parametrize(
    ("content", "hints"),
    [
        (b"", ("JSON",)),
        (b"{", ("JSON",)),
        (b"[]", ("JSON",)),
        (b"null", ("JSON",)),
        (b'{"state": "complete"', ("JSON",)),
        (b"\xff\xfe\x00", ("JSON",)),
        (b'{"state": "\\ud800"}', ()),
        (b"[" * 9000, ("JSON",)),
        (b'{"state":' * 2000, ("JSON",)),
        (b'{"robots": 1e400}', ("robots",)),
        (b'{"robots": NaN}', ("robots",)),
        (b'{"robots": 0}', ("robots",)),
        (b'{"robots": 2.5}', ("robots",)),
        (b'{"robots": "2"}', ("robots",)),
        (b'{"robots": true}', ("robots",)),
        (b'{"robots": ' + b"9" * 5000 + b"}", ("JSON",)),
        (b'{"deadline": -1}', ("deadline",)),
        (b'{"deadline": 10000000}', ("deadline",)),
        (b'{"missing": [99]}', ("missing",)),
        (b'{"missing": [-1]}', ("missing",)),
        (b'{"missing": [1, 1]}', ("1", "twice")),
        (b'{"missing": [5]}', ("5", "boundary")),
        (b'{"state": [1, 1]}', ("state", "7 values")),
        (b'{"state": [1, 1, 1, 1, 1, 2, 3]}', ("state[6] is 3; give one of 0, 1, 2",)),
        (b'{"state": [1, 1, 1, 1, 1, 2, 1]}', ("6", "boundary")),
        (b'{"state": [2, 2, 2, 1, 1, 2, 2]}', ("3", "held")),
        (b'{"state": "half"}', ("complete", "empty")),
        (b'{"sate": "complete"}', ("sate",)),
        (b'{"states": [[1, 1, 1, 1, 1, 2, 2]]}', ("states is not known; did you mean state?",)),
        (b'{"\\u001b[31m\\n": 1}', ()),
        (b'{"target": "complete", "direction": "disassembly", "state": "empty"}', ("part",)),
        (b'{"direction": "sideways"}', ("direction",)),
        (b'{"reserve": 0.9}', ("reserve",)),
        (b'{"reserve": 1e400}', ("reserve",)),
        (b'{"holds": 5}', ("holds is 5; give an object")),
        (b'{"holds": null}', ("holds is None; give an object",)),
        (b'{"holds": {"stiffness": 0}}', ("holds.stiffness",)),
        (b'{"holds": {"stiffness": NaN}}', ("holds.stiffness",)),
        (b'{"holds": {"force": -1}}', ("holds.force",)),
        (b'{"holds": {"moment": "5"}}', ("holds.moment",)),
        (b'{"holds": {"moment": 0}}', ("holds.moment is 0; give a number > 0",)),
        (b'{"holds": {"mode": 1}}', ("holds.mode",)),
        (b'{"holds": {"strength": 1}}', ("holds.strength is not known; known are force",)),
        (b'{"holds": {"force": 1}}', ("holds:", "cannot carry part voussoir-", "weighs")),
    ],
)
def test_malformed_requests_for_plans(content: bytes, hints: tuple[str, ...], live: Any) -> None:
    reply = live.client.post("/replan", content=content, headers=JSON)
    expect(reply, 422, *hints)


@pytest.mark.parametrize(
    ("content", "hints"),
    [
        ({}, ("states is missing; /docs",)),
        ({"states": []}, ("states is []; give a list of length >= 1",)),
        ({"states": STATE}, ("states",)),
        ({"states": [STATE[:-1]]}, ("states[0]", "7 values")),
        ({"states": [STATE, [1, 1, 1, 1, 1, 0, 2]]}, ("states[1]", "boundary")),
        ({"states": ["complete"] * 257}, ("states",)),
        ({"states": ["complete"], "explain": "yes"}, ("explain",)),
    ],
)
def test_malformed_requests_for_verdicts(content: Any, hints: tuple[str, ...], live: Any) -> None:
    expect(live.post("/stability", content), 422, *hints)


def test_other_content_types_and_methods_and_places(live: Any) -> None:
    expect(live.client.post("/replan", content=b"{}"), 415, "application/json")
    expect(live.client.post("/replan", data={"state": "complete"}), 415, "application/json")
    reply = live.client.get("/replan")
    expect(reply, 405)
    assert reply.headers["allow"] == "POST"
    expect(live.client.get("/../../etc/passwd"), 404)
    expect(live.client.get("/%2e%2e/%00"), 404)
    expect(live.client.get("/replan/"), 404)


def test_a_page_under_another_name_cannot_use_the_browser_to_get_in(live: Any) -> None:
    expect(live.client.get("/structure", headers={"Host": "evil.example"}), 400, "localhost")


def test_large_requests_are_refused_whether_they_say_so_or_not(live: Any) -> None:
    large = json.dumps({"states": [STATE] * 5000}).encode()
    expect(live.client.post("/stability", content=large, headers=JSON), 413, str(live.settings.body_bytes))

    def pieces() -> Any:
        for first in range(0, len(large), 1000):
            yield large[first : first + 1000]

    expect(live.client.post("/stability", content=pieces(), headers=JSON), 413)


def talk(live: Any, sent: bytes, wait: float) -> tuple[bytes, float]:
    """What comes back on a bare connection until it is closed, and after how long."""
    begun = time.monotonic()
    answer = b""
    with socket.create_connection(live.address, timeout=wait) as connection:
        connection.sendall(sent)
        try:
            while piece := connection.recv(65536):
                answer += piece
        except TimeoutError:
            pytest.fail(f"the connection was still open after {wait} s")
        except ConnectionResetError:
            pass
    return answer, time.monotonic() - begun


@pytest.mark.parametrize("sent", [b"", b"POST /replan HTTP/1.1\r\nHost: local", b"GET /health HTTP/1.1\r\nX-A: "])
def test_who_does_not_finish_a_header_is_hung_up_on(sent: bytes, live: Any) -> None:
    answer, seconds = talk(live, sent, wait=20 * live.settings.header_seconds)
    assert answer == b""
    assert seconds >= 0.9 * live.settings.header_seconds


def test_a_header_that_trickles_in_does_not_keep_a_connection_open(live: Any) -> None:
    begun = time.monotonic()
    with socket.create_connection(live.address, timeout=10) as connection:
        connection.sendall(b"GET /health HTTP/1.1\r\n")
        try:
            for number in range(1000):
                connection.sendall(f"X-{number}: a\r\n".encode())
                time.sleep(0.05)
        except OSError:
            pass
    assert time.monotonic() - begun < 20 * live.settings.header_seconds


def test_who_does_not_finish_a_body_is_told_so(live: Any) -> None:
    head = b"POST /replan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
    answer, _ = talk(live, head, wait=20 * live.settings.body_seconds)
    assert answer.startswith(b"HTTP/1.1 408 ")


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /health HTTP/1.1\r\nHost: localhost\r\n" + b"X: " + b"a" * 100_000 + b"\r\n\r\n",
        b"POST /replan HTTP/1.1\r\nHost: localhost\r\nContent-Length: -5\r\n\r\n",
        b"POST /replan HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"POST /replan HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nZZ\r\n",
    ],
)
def test_what_is_no_http_is_refused(sent: bytes, live: Any) -> None:
    answer, _ = talk(live, sent, wait=20 * live.settings.body_seconds)
    assert answer == b"" or answer.split()[1] in (b"400", b"408", b"415", b"431")
    assert b"Traceback" not in answer
    assert live.client.get("/health").status_code == 200


def idle(live: Any, count: int) -> list[socket.socket]:
    """Connections on which nothing is sent."""
    return [socket.create_connection(live.address, timeout=5) for _ in range(count)]


def is_open(connection: socket.socket) -> bool:
    """Whether the other side has not closed a connection on which it says nothing."""
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def test_idle_connections_make_room(live: Any) -> None:
    """However many clients only connect, and however often, others are served, and only idle ones lose a connection."""
    most = live.settings.connections
    with contextlib.ExitStack() as opened:
        for _ in range(3):
            crowd = [opened.enter_context(connection) for connection in idle(live, most + 40)]
            with httpx.Client(base_url=live.url, timeout=5) as client:
                assert client.get("/health").status_code == 200
                assert client.post("/stability", json={"states": ["complete"]}).status_code == 200
            still = [is_open(connection) for connection in crowd]
            assert not any(still[:40])
            assert sum(still) <= most


def test_a_request_in_work_is_not_idle(live: Any) -> None:
    live.wait_until_well()
    (planner,) = pids(live, "replan")
    os.kill(planner, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as threads, contextlib.ExitStack() as opened:
        try:
            asked = threads.submit(live.post, "/replan", {"state": "complete", "deadline": 900})
            time.sleep(0.2)
            for connection in idle(live, live.settings.connections + 20):
                opened.enter_context(connection)
            assert httpx.get(f"{live.url}/structure", timeout=5).status_code == 200
        finally:
            with contextlib.suppress(ProcessLookupError):  # a planner that hangs may have been replaced
                os.kill(planner, signal.SIGCONT)
        assert asked.result().status_code == 200


def test_too_many_requests_at_a_time_are_refused_in_json(live: Any) -> None:
    head = b"POST /replan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n{"
    with contextlib.ExitStack() as opened:
        for slow in idle(live, live.settings.connections):
            opened.enter_context(slow).sendall(head)
        time.sleep(0.2)
        reply = live.client.get("/structure")
        expect(reply, 503, "too many requests")
        assert reply.headers["retry-after"] == "1"
        assert live.client.get("/health").status_code == 200
    time.sleep(0.2)
    assert live.client.get("/structure").status_code == 200


def test_health_waits_for_no_body(live: Any) -> None:
    """It is open to clients without a token, who must not hold requests open."""
    begun = time.monotonic()
    with socket.create_connection(live.address, timeout=5) as connection:
        connection.sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{")
        assert connection.recv(100).startswith(b"HTTP/1.1 200 ")
    assert time.monotonic() - begun < 0.9 * live.settings.body_seconds


def test_a_deadline_is_kept_while_the_planner_hangs(live: Any) -> None:
    live.wait_until_well()
    (planner,) = pids(live, "replan")
    os.kill(planner, signal.SIGSTOP)
    try:
        begun = time.monotonic()
        answer = live.post("/replan", {"deadline": 200}).json()
        seconds = time.monotonic() - begun
    finally:
        with contextlib.suppress(ProcessLookupError):  # a planner that hangs may have been replaced
            os.kill(planner, signal.SIGCONT)
    assert answer["outcome"] == "not_yet"
    assert answer["criterion"] == live.pool.settings.criterion
    assert answer["plans"] == []
    assert answer["deadline_passed"]
    assert "200 ms" in answer["reason"]
    assert 0.2 <= seconds < 0.25 + 0.25  # the last quarter for machines that do other things besides
    assert live.post("/replan", {}).json()["outcome"] == "found"


def deadly(live: Any, monkeypatch: pytest.MonkeyPatch, times: int) -> list[int]:
    """Have so many workers end right after they have taken a request; the list fills with their ids."""
    send, victims = live.pool.send, []

    def send_and_kill(worker: Any, batch: list[Any]) -> None:
        if len(victims) < times:
            victims.append(worker.process.pid)
            os.kill(worker.process.pid, signal.SIGSTOP)  # so that it cannot answer before it dies
            send(worker, batch)
            os.kill(worker.process.pid, signal.SIGKILL)
        else:
            send(worker, batch)

    monkeypatch.setattr(live.pool, "send", send_and_kill)
    return victims


def test_a_request_survives_the_worker_that_had_it(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    live.wait_until_well()
    victims = deadly(live, monkeypatch, 1)
    reply = live.post("/replan", {"deadline": 60_000})
    assert reply.status_code == 200
    assert reply.json()["outcome"] == "found"
    assert len(victims) == 1
    assert not set(victims) & set(pids(live, "replan"))


def test_a_request_that_takes_two_workers_with_it_is_refused(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    live.wait_until_well()
    victims = deadly(live, monkeypatch, 2)
    expect(live.post("/replan", {"deadline": 60_000}), 503, "lost")
    assert len(set(victims)) == 2
    live.wait_until_well()
    assert live.post("/replan", {}).json()["outcome"] == "found"


def test_verdicts_come_back_after_the_judge_is_lost(live: Any) -> None:
    live.wait_until_well()
    (judge,) = pids(live, "stability")
    os.kill(judge, signal.SIGKILL)
    reply = live.post("/stability", {"states": ["complete"]})
    assert reply.status_code == 200
    assert reply.json()["verdicts"][0]["verdict"] == "stable"


def test_more_requests_than_may_wait_are_turned_away(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    live.wait_until_well()
    monkeypatch.setattr(live.pool, "settings", replace(live.settings, queue=2))
    (planner,) = pids(live, "replan")
    os.kill(planner, signal.SIGSTOP)
    try:
        with ThreadPoolExecutor(8) as clients:
            replies = list(clients.map(lambda _: live.post("/replan", {"deadline": 1000}), range(8)))
    finally:
        with contextlib.suppress(ProcessLookupError):  # a planner that hangs may have been replaced
            os.kill(planner, signal.SIGCONT)
    away = [reply for reply in replies if reply.status_code == 503]
    assert len(away) >= 3  # one batch may be with the planner, two may wait
    for reply in away:
        expect(reply, 503, "try again")
        assert reply.headers["retry-after"] == "1"
    assert {reply.json()["outcome"] for reply in replies if reply.status_code == 200} == {"not_yet"}


def test_who_hangs_up_takes_the_request_back(live: Any) -> None:
    live.wait_until_well()
    end = time.monotonic() + 40
    while live.pool.busy:  # with what a test before has left
        assert time.monotonic() < end
        time.sleep(0.01)
    (planner,) = pids(live, "replan")
    os.kill(planner, signal.SIGSTOP)
    try:
        body = b'{"deadline": 60000}'
        head = b"POST /replan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        first = socket.create_connection(live.address)  # goes to the planner, which hangs
        first.sendall(head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        end = time.monotonic() + 20
        # Were both there before the first is handed out, the planner would get both.
        while not live.pool.busy:
            assert time.monotonic() < end
            time.sleep(0.01)
        second = socket.create_connection(live.address)  # waits
        second.sendall(head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        while live.client.get("/health").json()["waiting"] != 1:
            assert time.monotonic() < end
        second.close()
        while live.client.get("/health").json()["waiting"] != 0:
            assert time.monotonic() < end, "a request still waits although nobody wants its answer"
        first.close()
    finally:
        # With nobody left who wants its answer, the pool may have replaced the planner that hangs already.
        with contextlib.suppress(ProcessLookupError):
            os.kill(planner, signal.SIGCONT)
    assert live.post("/replan", {}).json()["outcome"] == "found"
