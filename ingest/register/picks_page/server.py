"""The page of picks over HTTP, to this machine only, behind a token in its address.

The socket is bound to 127.0.0.1, names other than that are refused by the Host header, and everything lies
below a random token that other web pages cannot know: none can read or post here.
"""

import secrets
from functools import partial
from pathlib import Path

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field

from featuredb.errors import FeatureDbError
from ingest.register.picks_page.session import PickedSpot, PickSession
from reloc.viewer.server import local_app

_ASSETS = Path(__file__).with_name("assets")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class _Picks(BaseModel):
    model_config = ConfigDict(extra="forbid")
    image: int
    picks: list[PickedSpot] = Field(max_length=40)


def new_token() -> str:
    """Part of the address that nobody can guess."""
    return secrets.token_urlsafe(24)


def create_app(session: PickSession, token: str) -> FastAPI:
    """The application; everything lies below /TOKEN/."""
    html = (_ASSETS / "index.html").read_text(encoding="utf-8")
    app, in_thread = local_app("featuredb picks", html, _POLICY, _ASSETS, f"/{token}")
    api = f"/{token}/api"

    @app.get(f"{api}/state")
    async def state() -> Response:
        return JSONResponse(session.state())

    @app.get(f"{api}/ground.png")
    async def ground() -> Response:
        return Response(await in_thread(session.ground_png), media_type="image/png")

    @app.get(f"{api}/photo/{{image}}")
    async def photo(image: int) -> Response:
        return Response(await in_thread(partial(session.photo_jpeg, image)), media_type="image/jpeg")

    @app.get(f"{api}/overlay/{{image}}")
    async def overlay(image: int) -> Response:
        return Response(await in_thread(partial(session.overlay_png, image)), media_type="image/png")

    @app.post(f"{api}/solve")
    async def solve(picks: _Picks) -> Response:
        return JSONResponse(await in_thread(partial(session.solve, picks.image, picks.picks)))

    @app.post(f"{api}/refine")
    async def refine(picks: _Picks) -> Response:
        return JSONResponse(await in_thread(partial(session.refine, picks.image, picks.picks)))

    @app.post(f"{api}/confirm")
    async def confirm(picks: _Picks) -> Response:
        return JSONResponse(await in_thread(partial(session.confirm, picks.image)))

    @app.exception_handler(FeatureDbError)
    async def refused(request: Request, error: FeatureDbError) -> Response:
        return JSONResponse({"message": str(error)}, 400)

    return app
