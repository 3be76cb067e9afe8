"""FastAPI application and routes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, Request, Response
from msgspec import UNSET, UnsetType, structs
from msgspec.json import encode
from starlette.exceptions import HTTPException

from falsework import __version__
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.replanning.since import SiteSteps
from falsework.service import schema
from falsework.service.docs_page import page_of
from falsework.service.metrics import Metrics
from falsework.service.middleware import INSIDE, App, ServiceMiddleware
from falsework.service.pool import Pool, Reply
from falsework.service.schema import Holds, PictureRequest, ReplanRequest, StabilityRequest
from falsework.service.schema import Request as Asked
from falsework.service.settings import PICTURE_SECONDS, STABILITY_SECONDS, ServiceSettings
from falsework.service.worker import refusal

ABOUT = """Replanning and stability verdicts for one structure.

Every state of every plan is certified as stable before the plan is sent. Errors are one line with a remedy. Times are
in seconds, except `deadline` in milliseconds; masses in kg, positions in metres, z up."""
_GONE_EVERY = 0.2
"""Seconds between two checks whether the client is still connected."""
_JSON = "application/json"
_PNG = "image/png"
_WORDS = {
    400: "not a valid request",
    401: "missing or wrong token",
    408: "the request arrived too slowly",
    413: "the request is too large",
    415: "not JSON",
    422: "the request does not fit this structure; the error gives the reason",
    431: "the header is too large",
    500: "internal error",
    501: "this service cannot draw; the error says what to install",
    503: "busy, starting or stopping; try again",
}


def application(assembly: Assembly, pool: Pool, settings: ServiceSettings, metrics: Metrics) -> App:
    """Return the application of one service inside its middleware; it starts and stops the pool."""

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
    _add_questions(app, assembly, pool, settings)
    _add_reports(app, assembly, pool, metrics)
    app.add_exception_handler(HTTPException, _refuse)
    app.add_exception_handler(Exception, _admit)
    app.openapi = _describe(app, settings)  # type: ignore[method-assign]
    _add_pages(app)
    return ServiceMiddleware(app, settings, metrics)


def _add_questions(app: FastAPI, assembly: Assembly, pool: Pool, settings: ServiceSettings) -> None:
    """Add the routes for work: plans, verdicts and pictures."""

    async def replan(request: Request) -> Response:
        def payload(wanted: ReplanRequest) -> dict[str, Any]:
            if wanted.plan is not None and wanted.state is not UNSET:
                raise InputError("state: a plan with its step says what the state is; leave one of the two out")
            given = {
                name: value
                for name, value in structs.asdict(wanted).items()
                if name != "deadline" and value is not UNSET  # as by default, or as in the plan
            }
            given["removable_only_if_clear"] |= settings.removable_only_if_clear
            given["since"] = SiteSteps(**structs.asdict(wanted.since))
            if wanted.plan is not None:
                given["state"] = None
            else:
                given["robots"] = settings.robots if wanted.robots is UNSET else wanted.robots
                start = "complete" if wanted.state is UNSET else wanted.state
                given["state"] = schema.state_of(start, assembly, "state")
            if wanted.plan is None or wanted.holds is not UNSET:
                holds = Holds() if isinstance(wanted.holds, UnsetType) else wanted.holds
                given["holds"] = schema.read_holds(holds, pool.settings.criterion)
            if wanted.target is not None:
                given["target"] = schema.state_of(wanted.target, assembly, "target")
            return given

        def ask(wanted: ReplanRequest, given: dict[str, Any]) -> Any:
            seconds = settings.deadline if wanted.deadline is None else wanted.deadline / 1000
            return pool.ask("replan", given, seconds)

        return await _answer(request, ReplanRequest, payload, ask)

    async def stability(request: Request) -> Response:
        def payload(wanted: StabilityRequest) -> Any:
            return schema.read_states(wanted.states, assembly, settings), wanted.explain

        return await _answer(
            request, StabilityRequest, payload, lambda _, given: pool.ask("stability", given, STABILITY_SECONDS)
        )

    async def picture(request: Request) -> Response:
        def payload(wanted: PictureRequest) -> dict[str, Any]:
            if wanted.plan is None and wanted.step is not None:
                raise InputError("step: a state has no steps; give the plan too, or leave step out")
            return structs.asdict(wanted) | {"state": schema.state_of(wanted.state, assembly, "state")}

        return await _answer(
            request, PictureRequest, payload, lambda _, given: pool.ask("picture", given, PICTURE_SECONDS), media=_PNG
        )

    app.add_api_route("/replan", replan, **_route("POST", "Replan from a state", "ReplanAnswer", "ReplanRequest"))
    app.add_api_route(
        "/stability", stability, **_route("POST", "Stability verdicts of states", "StabilityAnswer", "StabilityRequest")
    )
    app.add_api_route("/picture", picture, **_route("POST", "Draw a state or a plan", _PNG, "PictureRequest"))


def _add_reports(app: FastAPI, assembly: Assembly, pool: Pool, metrics: Metrics) -> None:
    """Add the routes for health, structure and metrics."""
    written: list[bytes] = []

    async def structure() -> Response:
        if not written:
            written.append(encode(schema.structure_record(assembly, policy=bool(pool.policy))))
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

    app.add_api_route("/structure", structure, **_route("GET", "The structure and its parts", "StructureRecord"))
    app.add_api_route("/health", health, **_route("GET", "Readiness of the workers", "Health"))
    about = _route("GET", "Counters for Prometheus", None)
    app.add_api_route("/metrics", count, **about)


def _add_pages(app: FastAPI) -> None:
    """Add the OpenAPI description and the documentation page."""
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
    if answer is None:
        content = {"text/plain": {"schema": {"type": "string"}}}
    elif answer == _PNG:
        content = {_PNG: {"schema": {"type": "string", "format": "binary"}}}
    else:
        content = {_JSON: {"schema": _ref(answer)}}
    refused = (400, 401, 431, 500, 503) if question is None else (400, 401, 408, 413, 415, 422, 431, 500, 503)
    if answer == _PNG:
        refused += (501,)
    responses: dict[int | str, dict[str, Any]] = {
        status: {"description": _WORDS[status], "content": {_JSON: {"schema": _ref("Refusal")}}} for status in refused
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


def _describe(app: FastAPI, settings: ServiceSettings) -> Callable[[], dict[str, Any]]:
    """Make the OpenAPI description: the routes known to FastAPI, with the schemas of this structure."""
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
            if settings.token is not None:
                document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
                document["security"] = [{"token": []}]
                document["paths"]["/health"]["get"]["security"] = []
            written.append(document)
        return written[0]

    return describe


async def _answer(
    request: Request,
    kind: type[Asked],
    payload: Callable[[Asked], Any],
    ask: Callable[[Asked, Any], Any],
    *,
    media: str = _JSON,
) -> Response:
    """Read a request, have it answered, and wait for the answer while the client is connected."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
        return _response(Reply(415, refusal(f"send JSON, with Content-Type: {_JSON}")))
    try:
        wanted = schema.read_request(kind, await request.body())
        given = payload(wanted)
    except InputError as error:
        return _response(Reply(422, refusal(str(error))))
    task = asyncio.ensure_future(ask(wanted, given))
    try:
        while not task.done():
            await asyncio.wait({task}, timeout=_GONE_EVERY)
            if not task.done() and await request.is_disconnected():
                raise ConnectionError
        return _response(task.result(), media)
    finally:
        task.cancel()


def _response(reply: Reply, media: str = _JSON) -> Response:
    """Return a reply as a response; `media` is the type of an answer, a refusal is JSON."""
    headers = {"Retry-After": "1"} if reply.status == 503 else None
    return Response(reply.body, reply.status, headers=headers, media_type=media if reply.status == 200 else _JSON)


async def _refuse(_: Request, error: Exception) -> Response:
    """Return a refusal of the router, such as an unknown path."""
    assert isinstance(error, HTTPException)
    text = {404: "there is nothing here; / lists the requests", 405: "this method is not allowed; / lists the requests"}
    body = refusal(text.get(error.status_code, "this request cannot be served"))
    return Response(body, error.status_code, headers=error.headers, media_type=_JSON)


async def _admit(_: Request, __: Exception) -> Response:
    """Return an internal error, which the middleware writes to the log."""
    return _response(Reply(500, refusal(INSIDE)))
