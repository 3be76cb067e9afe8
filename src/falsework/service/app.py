"""FastAPI application and routes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Literal

from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException

from falsework import __version__
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.service.docs_page import page_of
from falsework.service.metrics import Metrics
from falsework.service.middleware import INSIDE, App, ServiceMiddleware
from falsework.service.pool import Pool, Reply
from falsework.service.schema import Schema
from falsework.service.settings import ServiceSettings
from falsework.service.worker import refusal

ABOUT = """Another plan, now, for the structure that this service is for, and verdicts with proofs.

Every state of every plan is proven stable before it is sent. Errors are one line that says what to do. Times are in
seconds but for `deadline`, which is in milliseconds; masses in kg, places in metres, z up."""
_GONE_EVERY = 0.2
"""Seconds between two looks whether a client still waits."""
_JSON = "application/json"
_WORDS = {
    400: "not a request that this service takes",
    401: "no token, or a wrong one",
    408: "the request came too slowly",
    413: "the request is too large",
    415: "not JSON",
    422: "the request makes no sense for this structure; the error says why",
    431: "the header is too large",
    500: "the request failed inside",
    503: "busy, starting or stopping; try again",
}


def application(assembly: Assembly, pool: Pool, settings: ServiceSettings, metrics: Metrics) -> App:
    """The application of one service, with its guard around it; it starts and stops the pool.

    Args:
        assembly: the structure.
        pool: does the work.
        settings: bounds.
        metrics: counts.
    """

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        if not any(pool.ready.values()):
            await pool.start()
        try:
            yield
        finally:
            await pool.stop()

    app = FastAPI(
        title=f"falsework: {assembly.name}",
        version=__version__,
        description=ABOUT,
        lifespan=life,
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
    )
    schema = Schema.of(assembly, settings)
    _add_questions(app, schema, pool)
    _add_reports(app, schema, pool, metrics)
    app.add_exception_handler(HTTPException, _refuse)
    app.add_exception_handler(Exception, _admit)
    app.openapi = _describe(app, schema)  # type: ignore[method-assign]
    _add_pages(app)
    return ServiceMiddleware(app, settings, metrics)


def _add_questions(app: FastAPI, schema: Schema, pool: Pool) -> None:
    """Add the routes for plans and for verdicts."""

    def route(name: Literal["replan", "stability"], parse: Callable[[bytes], tuple[Any, float]]) -> Any:
        async def answer(request: Request) -> Response:
            kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
            if kind != _JSON:
                return _response(Reply(415, refusal(f"send JSON, with Content-Type: {_JSON}")))
            try:
                payload, seconds = parse(await request.body())
            except InputError as error:
                return _response(Reply(422, refusal(str(error))))
            return await _wait(request, pool.ask(name, payload, seconds))

        answer.__name__ = name  # which the description shows as the id of the operation
        return answer

    replan, stability = route("replan", schema.parse_replan), route("stability", schema.parse_stability)
    app.add_api_route("/replan", replan, **_route("POST", "Plan anew from a state", "ReplanAnswer", "ReplanRequest"))
    app.add_api_route(
        "/stability", stability, **_route("POST", "Judge states, with proofs", "StabilityAnswer", "StabilityRequest")
    )


def _add_reports(app: FastAPI, schema: Schema, pool: Pool, metrics: Metrics) -> None:
    """Add the routes for health, structure and metrics."""
    written: list[bytes] = []

    async def structure() -> Response:
        if not written:
            record = schema.structure_record(policy=bool(pool.policy))
            written.append(json.dumps(record, ensure_ascii=True).encode())
        return Response(written[0], media_type=_JSON)

    async def health() -> Response:
        ready = pool.ready
        well = all(ready.values())
        record = {
            "status": "ok" if well else "starting",
            "planners": ready["replan"],
            "judges": ready["stability"],
            "waiting": pool.waiting,
        }
        return Response(json.dumps(record), 200 if well else 503, media_type=_JSON)

    async def count() -> Response:
        return Response(metrics.text(pool.waiting, sum(pool.ready.values())), media_type="text/plain; version=0.0.4")

    app.add_api_route("/structure", structure, **_route("GET", "The structure and its parts", "Structure"))
    app.add_api_route("/health", health, **_route("GET", "Whether the service takes requests", "Health"))
    about = _route("GET", "Counters for Prometheus", None)
    app.add_api_route("/metrics", count, **about)


def _add_pages(app: FastAPI) -> None:
    """The description, for machines and for people."""
    written: dict[str, bytes] = {}

    async def openapi() -> Response:
        if "json" not in written:
            written["json"] = json.dumps(app.openapi()).encode()
        return Response(written["json"], media_type=_JSON)

    async def docs() -> Response:
        if "html" not in written:
            written["html"] = page_of(app.openapi()).encode()
        return Response(written["html"], media_type="text/html; charset=utf-8")

    app.add_api_route("/openapi.json", openapi, include_in_schema=False)
    app.add_api_route("/docs", docs, include_in_schema=False)
    app.add_api_route("/", docs, include_in_schema=False)


def _route(method: str, summary: str, answer: str | None, question: str | None = None) -> dict[str, Any]:
    """Return the OpenAPI options of a route."""
    content = {_JSON: {"schema": _ref(answer)}} if answer else {"text/plain": {"schema": {"type": "string"}}}
    refused = (400, 401, 431, 500, 503) if question is None else (400, 401, 408, 413, 415, 422, 431, 500, 503)
    responses: dict[int | str, dict[str, Any]] = {
        status: {"description": _WORDS[status], "content": {_JSON: {"schema": _ref("Error")}}} for status in refused
    }
    responses[200] = {"description": "the answer", "content": content}
    if answer == "Health":
        responses[503] = {"description": _WORDS[503], "content": content}
    extra = {}
    if question is not None:
        extra = {"requestBody": {"required": True, "content": {_JSON: {"schema": _ref(question)}}}}
    return {
        "methods": [method],
        "summary": summary,
        "response_class": Response,
        "response_model": None,
        "responses": responses,
        "openapi_extra": extra,
    }


def _ref(model: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{model}"}


def _describe(app: FastAPI, schema: Schema) -> Callable[[], dict[str, Any]]:
    """Makes the OpenAPI description: what FastAPI knows of the routes, with the schemas of this structure."""
    generate = app.openapi
    written: list[dict[str, Any]] = []

    def describe() -> dict[str, Any]:
        if not written:
            document = generate()
            document["components"] = {"schemas": schema.components()}
            for path in document["paths"].values():
                for operation in path.values():
                    answers = operation["responses"]
                    operation["responses"] = {code: answer for code, answer in answers.items() if answer.get("content")}
            if schema.settings.token is not None:
                document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
                document["security"] = [{"token": []}]
                document["paths"]["/health"]["get"]["security"] = []
            written.append(document)
        return written[0]

    return describe


async def _wait(request: Request, question: Any) -> Response:
    """Wait for an answer as long as somebody wants it."""
    task = asyncio.ensure_future(question)
    try:
        while not task.done():
            await asyncio.wait({task}, timeout=_GONE_EVERY)
            if not task.done() and await request.is_disconnected():
                raise ConnectionError
        return _response(task.result())
    finally:
        task.cancel()


def _response(reply: Reply) -> Response:
    headers = {"Retry-After": "1"} if reply.status == 503 else None
    return Response(reply.body, reply.status, headers=headers, media_type=_JSON)


async def _refuse(_: Request, error: Exception) -> Response:
    """What the router refuses, such as a path that is not there."""
    assert isinstance(error, HTTPException)
    text = {404: "there is nothing here; / says what there is", 405: "not this way; / says how"}
    body = refusal(text.get(error.status_code, "this request cannot be served"))
    return Response(body, error.status_code, headers=error.headers, media_type=_JSON)


async def _admit(_: Request, __: Exception) -> Response:
    """What went wrong inside; the guard writes it to the log."""
    return _response(Reply(500, refusal(INSIDE)))
