"""The HTTP application: routes, and the client of the server that they share."""

import asyncio
import logging
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TypeVar

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4 as METRICS_TYPE
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect
from starlette.responses import FileResponse, PlainTextResponse
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from featuredb.errors import InvalidValueError, ServiceError
from reloc.client import NO_SERVER, Client
from reloc.gateway import openapi
from reloc.gateway.failures import (
    METHOD_NOT_ALLOWED,
    NOT_FOUND,
    NOT_READY,
    RETRY_AFTER_S,
    STATUS_OF,
    ErrorBody,
)
from reloc.gateway.geopose import MEDIA_TYPE as GEOPOSE_TYPE
from reloc.gateway.geopose import VERSION as GEOPOSE_VERSION
from reloc.gateway.geopose import (
    GeoPoseResp,
    NotLocalisedError,
    check_version,
    parse,
    question_of,
    response_of,
)
from reloc.gateway.intake import Intake, read_form
from reloc.gateway.options import GatewayOptions
from reloc.listening import CLIENT_GONE
from reloc.service.logs import fields
from reloc.wire.query import ErrorCode, LocaliseReply, LocaliseWireRequest
from reloc.wire.server import StatusReply
from reloc.wire.status_metrics import Figures, status_metrics

logger = logging.getLogger(__name__)

_T = TypeVar("_T")

# After a server was waited for in vain nobody waits so long: a hundred requests would, one after another.
_PAUSE_S = 1.0
_STATUS_TIMEOUT_S = 2.0  # what a health check or a scrape may take; the server answers in a millisecond
# The client gives up so much later than it tells the server to, so that the server's word arrives.
_DEADLINE_MARGIN_S = 0.2

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Permissions-Policy": "camera=(self), geolocation=(self)",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_NAME = "featuredb_gateway_"
# A query takes 0.2 s and at most the timeout of 10 s; health and maps take milliseconds.
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


def add_phone_page(app: FastAPI, prefix: str) -> None:
    """`prefix`/phone, and its script and style below it; it asks `prefix`/localise as any client does."""
    assets = Path(__file__).with_name("assets")

    @app.get(f"{prefix}/phone", include_in_schema=False)
    async def page() -> Response:
        return FileResponse(assets / "phone.html", headers=_HEADERS)

    app.mount(f"{prefix}/phone", StaticFiles(directory=assets))


class Gateway:
    """What the routes share: a client of the server, threads to wait in, limits and counters.

    The client connects with the first question. Zenoh itself connects again with a server that has restarted.
    """

    def __init__(self, options: GatewayOptions) -> None:
        self.options = options
        self._client = Client(
            options.connect,
            options.database,
            config_path=options.config_path,
            connect_timeout_s=options.connect_timeout_s,
        )
        self._finding = threading.Lock()
        self._refusal: tuple[float, ServiceError] | None = None
        self.intake = Intake(options)
        self.registry = CollectorRegistry()
        self._requests = Counter(
            f"{_NAME}requests", "HTTP requests answered.", ("route", "status"), registry=self.registry
        )
        self._seconds = Histogram(
            f"{_NAME}request_seconds",
            "Time to the answer.",
            ("route",),
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self.registry.register(Figures(self._figures))
        # Their own: routes that ask for figures have Starlette's, and an overrun server says how it is.
        self._photos = ThreadPoolExecutor(options.max_in_flight, thread_name_prefix="gateway-photo")

    async def in_thread(self, work: Callable[[], _T]) -> _T:
        """Run blocking work on a photo."""
        return await asyncio.get_running_loop().run_in_executor(self._photos, work)

    def ask(self, question: Callable[[Client], _T]) -> _T:
        """The server's answer, in any thread. If nobody answers, or not yet, a server is looked for once.

        Raises:
            ServiceError: as of `reloc.client.Client`.
        """
        try:
            return question(self._client)
        except ServiceError as error:
            if error.code != NO_SERVER:
                raise
        with self._finding:
            if self._refusal is not None and time.monotonic() < self._refusal[0]:
                raise ServiceError(self._refusal[1].code, self._refusal[1].message)
            try:
                self._client.open()
            except ServiceError as error:
                self._refusal = (time.monotonic() + _PAUSE_S, error)
                raise
        return question(self._client)

    def status(self) -> StatusReply:
        return self.ask(lambda client: client.status(timeout_s=_STATUS_TIMEOUT_S))

    def observe(self, route: str, status: int, seconds: float) -> None:
        """A request was answered."""
        self._requests.labels(route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def _figures(self) -> Iterator[Metric]:
        """This gateway's at the moment, and what the server says of itself."""
        status = None
        try:
            status = self.status()
        except ServiceError as error:
            logger.info("no figures of the server: %s", error)
        yield GaugeMetricFamily(f"{_NAME}in_flight", "Photos in hand.", value=self.intake.in_flight)
        yield from status_metrics(status)

    def close(self) -> None:
        self._photos.shutdown(wait=True, cancel_futures=True)
        self._client.close()

    def geopose(self, body: bytes) -> tuple[GeoPoseResp, str, str]:
        """The answer, the datum of its height, the request id."""
        request = parse(body)
        image, asked = question_of(request, self.options)
        reply = self.ask(lambda client: client.ask(image, asked, self.options.timeout_s))
        return *response_of(request, reply), reply.request_id

    def localise(self, image: bytes, asked: LocaliseWireRequest) -> LocaliseReply:
        """The server's reply as it is."""
        timeout_s = self.options.timeout_s
        if asked.options.deadline_ms is not None:
            deadline_s = asked.options.deadline_ms / 1e3
            timeout_s = min(timeout_s, deadline_s + min(deadline_s, _DEADLINE_MARGIN_S))
        return self.ask(lambda client: client.ask(image, asked, timeout_s))


def create_app(options: GatewayOptions) -> FastAPI:
    """The application; it connects with the first question and closes with its lifespan."""
    gateway = Gateway(options)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await asyncio.get_running_loop().run_in_executor(None, gateway.close)

    # Pages of documentation would load scripts from elsewhere; /openapi.json is what tools read.
    app = FastAPI(
        title="featuredb gateway",
        version=GEOPOSE_VERSION,
        description=openapi.DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        openapi_url=f"{options.prefix}/openapi.json",
        lifespan=lifespan,
    )
    app.state.gateway = gateway
    paths = _add_routes(app, gateway)
    _add_failures(app)
    if options.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=list(options.cors_origins),
            allow_methods=["GET", "POST"],
            allow_headers=["*"],
            expose_headers=["Featuredb-Height-Datum", "Featuredb-Request-Id", "Retry-After"],
        )
    app.add_middleware(_Observed, gateway=gateway, paths=paths)
    openapi.install(app)
    return app


def _add_routes(app: FastAPI, gateway: Gateway) -> frozenset[str]:
    """The routes; returns their paths."""
    prefix = gateway.options.prefix

    @app.post(f"{prefix}/geopose", **openapi.GEOPOSE)
    async def geopose(request: Request) -> Response:
        versioned = check_version(request.headers.get("accept", ""))
        async with gateway.intake.admitted(request, "application/json") as bounded:
            body = await bounded.body()
            answer, datum, request_id = await gateway.in_thread(lambda: gateway.geopose(body))
        return Response(
            answer.model_dump_json(),
            media_type=f"{GEOPOSE_TYPE}; version={GEOPOSE_VERSION}" if versioned else "application/json",
            headers={"Featuredb-Height-Datum": datum, "Featuredb-Request-Id": request_id},
        )

    @app.get(f"{prefix}/geopose")
    async def running() -> dict[str, str]:
        """The gateway runs, as the protocol's reference servers say it."""
        return {"status": "running"}

    @app.post(f"{prefix}/localise", **openapi.LOCALISE)
    async def localise(request: Request) -> Response:
        async with gateway.intake.admitted(request, "multipart/form-data") as bounded:
            image, asked = await read_form(bounded, gateway.options)
            reply = await gateway.in_thread(lambda: gateway.localise(image, asked))
        return _json(reply)

    @app.get(f"{prefix}/maps", **openapi.MAPS)
    def maps() -> Response:
        return _json(gateway.ask(lambda client: client.maps(timeout_s=_STATUS_TIMEOUT_S)))

    @app.get(f"{prefix}/health", **openapi.HEALTH)
    def health() -> Response:
        try:
            status = gateway.status()
        except ServiceError as error:  # whatever is wrong: who balances load must not send anybody here
            return _json(ErrorBody(code=error.code, message=error.message), 503)
        if status.queue.ready == 0:
            message = f"none of the server's {status.queue.workers} workers can take a query"
            return _json(ErrorBody(code=NOT_READY, message=message), 503)
        return _json(openapi.Health(database=status.database, snapshot=status.snapshot, maps=status.maps))

    @app.get(f"{prefix}/metrics", response_class=PlainTextResponse)
    def metrics() -> Response:
        """Prometheus' text format."""
        return Response(generate_latest(gateway.registry), media_type=METRICS_TYPE)

    add_phone_page(app, prefix)
    return frozenset(
        f"{prefix}/{leaf}" for leaf in ("geopose", "localise", "maps", "health", "metrics", "phone")
    )


def _add_failures(app: FastAPI) -> None:
    """Every way to fail ends in an ErrorBody; what went wrong inside stays in the log."""

    @app.exception_handler(ServiceError)
    async def service_error(request: Request, error: ServiceError) -> Response:
        body = ErrorBody(code=error.code, message=error.message, request_id=error.request_id)
        if isinstance(error, NotLocalisedError):
            body = body.model_copy(update={"reason": error.reply.reason, "id": error.geopose_id})
        return _failed(body)

    @app.exception_handler(InvalidValueError)
    async def invalid(request: Request, error: InvalidValueError) -> Response:
        return _failed(ErrorBody(code=ErrorCode.BAD_REQUEST, message=str(error)))

    @app.exception_handler(RequestValidationError)
    async def unreadable(request: Request, error: RequestValidationError) -> Response:
        return _failed(ErrorBody(code=ErrorCode.BAD_REQUEST, message="the request cannot be read"))

    @app.exception_handler(HTTPException)
    async def http_error(request: Request, error: HTTPException) -> Response:
        code = {404: NOT_FOUND, 405: METHOD_NOT_ALLOWED}.get(error.status_code, ErrorCode.BAD_REQUEST.value)
        body = ErrorBody(code=code, message=f"{request.method} {request.url.path[:200]}: {error.detail}")
        return _failed(body, dict(error.headers or {}))

    @app.exception_handler(ClientDisconnect)
    async def gone(request: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=CLIENT_GONE)

    @app.exception_handler(Exception)
    async def defect(request: Request, error: Exception) -> Response:
        # Starlette raises it again after this answer, so that uvicorn's log has the trace.
        text = "the gateway failed on this request; its log says why"
        return _json(ErrorBody(code=ErrorCode.INTERNAL, message=text), 500)


def _failed(body: ErrorBody, headers: dict[str, str] | None = None) -> Response:
    headers = headers or {}
    if body.code in RETRY_AFTER_S:
        headers["Retry-After"] = str(RETRY_AFTER_S[body.code])
    # A code that a newer server has invented is its error, not the client's.
    return _json(body, STATUS_OF.get(body.code, 502), headers)


def _json(content: BaseModel, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    return Response(content.model_dump_json(), status, headers, "application/json")


class _Observed:
    """Counts what every request was answered with, and how long it took."""

    def __init__(self, app: ASGIApp, gateway: Gateway, paths: frozenset[str]) -> None:
        self._app = app
        self._gateway = gateway
        self._paths = paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status = time.perf_counter(), 500

        async def note(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, note)
        finally:
            # Paths that do not exist are one: who asks for many cannot make many counters.
            path = scope["path"] if scope["path"] in self._paths else "other"
            seconds = time.perf_counter() - start
            self._gateway.observe(path, status, seconds)
            said, ms = f"{scope['method']} {path} {status}", round(seconds * 1e3, 1)
            logger.info(said, extra=fields("http", route=path, status=status, ms=ms))
