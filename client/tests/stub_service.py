"""Service with fixed answers for the pair of cubes of `arch`."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

PLAN = {
    "format": "falsework.plan/4",
    "start": {"state": [0, 2]},
    "steps": [{"do": "insert", "part": 0}, {"do": "release", "part": 0}],
    "end": [1, 2],
}
PNG = b"\x89PNG\r\n\x1a\n and so on"
ANSWERS = {
    "/health": {"status": "ok", "planners": 1, "judges": 1, "waiting": 0},
    "/structure": {
        "name": "pair",
        "friction": 0.6,
        "parts": [
            {"part": 0, "name": "top", "boundary": False, "mass": 2400.0, "center": [0.5, 0.5, 1.5]},
            {"part": 1, "name": "base", "boundary": True, "mass": 2400.0, "center": [0.5, 0.5, 0.5]},
        ],
    },
    "/stability": {"criterion": "contact", "verdicts": [{"verdict": "unstable", "proof": "velocity", "moving": [0]}]},
    "/replan": {"outcome": "found", "reason": "", "direction": "assembly", "moving": [], "plans": [PLAN]},
    "/picture": PNG,
}


class StubService:
    """The service, in a thread, from `with` to its end."""

    def __init__(self) -> None:
        self.answers: dict[str, Any] = dict(ANSWERS)
        self.status = 200
        self.asked: list[tuple[str, Any, str]] = []
        """Path, question and authorization of each request."""
        stub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.answer(None)

            def do_POST(self) -> None:
                self.answer(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

            def answer(self, question: Any) -> None:
                stub.asked.append((self.path, question, self.headers.get("Authorization", "")))
                content = stub.answers[self.path]
                picture = isinstance(content, bytes)
                body = content if picture else json.dumps(content).encode()
                self.send_response(stub.status)
                self.send_header("Content-Type", "image/png" if content is PNG else "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> StubService:
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def questions(self, path: str) -> list[Any]:
        """What was sent to a path."""
        return [question for asked, question, _ in self.asked if asked == path]
