"""The page and its data over HTTP, to this machine only.

The socket is bound to 127.0.0.1. A web page from elsewhere, open in the same browser, could still send
requests here: names that lead to 127.0.0.1 are refused by the Host header, and a photo is taken only with a
media type that a browser does not send to another site unasked.
"""

import asyncio
import sys
import webbrowser
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.staticfiles import StaticFiles

from featuredb.errors import FeatureDbError, GeodesyError, InvalidValueError, ServiceError
from reloc.listening import CLIENT_GONE, listen, run, uvicorn_server
from reloc.viewer.page import ASSETS, content_policy, page
from reloc.viewer.photos import LIMITS, PICTURE_PX, Pictures, Queries
from reloc.viewer.scene import ViewerScene

HOST = "127.0.0.1"
PHOTO_TYPE = "application/octet-stream"


def create_app(scene: ViewerScene, pictures: Pictures, queries: Queries) -> FastAPI:
    """The application; `queries` answers photos that are dropped on the page."""
    # Pictures and queries are decoded beside the event loop; a query takes its own turn inside.
    app, in_thread = local_app("featuredb viewer", page(), content_policy(), ASSETS)
    document = {**scene.document, "queries": True}

    @app.get("/api/scene")
    async def scene_document() -> Response:
        return JSONResponse(document)

    @app.get("/api/points/{place}")
    async def points(place: int) -> Response:
        if not 0 <= place < len(scene.points):
            raise HTTPException(404, f"no place {place}")
        return Response(scene.points[place], media_type=PHOTO_TYPE)

    @app.get("/api/picture")
    async def picture(map: str, image: int) -> Response:
        asked = scene.images.get((map, image))
        if asked is None:
            raise HTTPException(404, "no such photo")
        data, reason = await in_thread(partial(pictures.jpeg, asked, PICTURE_PX))
        if data is None:
            raise HTTPException(404, reason)
        return Response(data, media_type="image/jpeg")

    @app.get("/api/where")
    async def where(place: int, east: float, north: float, up: float) -> Response:
        return JSONResponse(_where(scene, place, east, north, up))

    @app.post("/api/query")
    async def query(request: Request, exif_prior: bool = False) -> Response:
        photo = await _photo(request)
        return JSONResponse(await in_thread(partial(queries.ask, photo, exif_prior=exif_prior)))

    _add_failures(app)
    return app


def local_app(
    title: str, html: str, policy: str, assets: Path, prefix: str = ""
) -> tuple[FastAPI, Callable[[Callable[[], Any]], Awaitable[Any]]]:
    """An application for this machine, and what runs a function beside its event loop.

    The page is at `prefix`/, with `policy` as its Content-Security-Policy, files of the folder `assets` lie
    below `prefix`/assets/.
    """
    app = FastAPI(title=title, docs_url=None, redoc_url=None, openapi_url=None)
    threads = ThreadPoolExecutor(4, thread_name_prefix=title)
    headers = {"Content-Security-Policy": policy, "Referrer-Policy": "no-referrer"}

    async def in_thread(work: Callable[[], Any]) -> Any:
        return await asyncio.get_running_loop().run_in_executor(threads, work)

    @app.get(f"{prefix}/")
    async def index() -> Response:
        return Response(html, media_type="text/html", headers=headers)

    app.mount(f"{prefix}/assets", StaticFiles(directory=assets))
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"], www_redirect=False)
    return app, in_thread


def serve(app: FastAPI, port: int, *, browser: bool, path: str = "") -> None:
    """Serve until SIGINT or SIGTERM; call from the main thread. Prints the page's address, or opens it, too.

    Raises:
        ListenError: cannot listen.
    """

    def announce(url: str) -> None:
        sys.stdout.write(f"{url}/{path}; stop with Ctrl-C\n")
        sys.stdout.flush()
        if browser and not webbrowser.open(f"{url}/{path}"):
            sys.stderr.write("no browser was found; open the address by hand\n")

    server = uvicorn_server(app, http="h11", timeout_graceful_shutdown=2)
    run(server, partial(listen, HOST, port), announce)


async def _photo(request: Request) -> bytes:
    """The body, counted while it streams. Raises HTTPException: another media type, or too large."""
    found = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if found != PHOTO_TYPE:  # which a browser does not send for another site unasked
        raise HTTPException(415, f"Content-Type: expected {PHOTO_TYPE}, found {found[:100]!r}")
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > LIMITS.max_bytes:
            raise HTTPException(413, f"the photo has more than {LIMITS.max_bytes} bytes")
    return bytes(data)


def _where(scene: ViewerScene, place: int, east: float, north: float, up: float) -> dict[str, Any]:
    """UTM and geographic coordinates of a spot in a place's frame. Raises HTTPException: no such place."""
    if not 0 <= place < len(scene.frames):
        own = 0 <= place < len(scene.points)
        raise HTTPException(404, f"place {place} is no place on Earth" if own else f"no place {place}")
    frame, epsg = scene.frames[place], scene.document["places"][place]["epsg"]
    latitude, longitude, height = frame.geodetic_from_enu((east, north, up))
    easting, northing, _ = frame.utm_from_enu((east, north, up), epsg)
    return {
        "latitude_deg": round(float(latitude), 8),
        "longitude_deg": round(float(longitude), 8),
        "height_m": round(float(height), 3),
        "utm": {"epsg": epsg, "easting": round(float(easting), 3), "northing": round(float(northing), 3)},
    }


def _add_failures(app: FastAPI) -> None:
    """What the page says where something fails is in `message`, or in FastAPI's `detail`."""

    @app.exception_handler(FeatureDbError)
    async def failure(request: Request, error: FeatureDbError) -> Response:
        asked_wrong = isinstance(error, ServiceError | InvalidValueError | GeodesyError)
        # Otherwise the database is gone, for example.
        return JSONResponse({"message": str(error)}, 400 if asked_wrong else 500)

    @app.exception_handler(ClientDisconnect)
    async def gone(request: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=CLIENT_GONE)
