"""The page on which a phone asks: its camera, its position, the answer drawn over the photo."""

from importlib import resources

from fastapi import FastAPI, Response
from starlette.exceptions import HTTPException

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
_MEDIA_TYPES = {"css": "text/css", "html": "text/html", "js": "text/javascript"}


def add_phone_page(app: FastAPI, prefix: str) -> None:
    """`prefix`/phone, and its script and style below it; it asks `prefix`/localise as any client does."""
    root = resources.files("reloc.gateway") / "assets"
    files = {file.name: file.read_bytes() for file in root.iterdir()}

    @app.get(f"{prefix}/phone", include_in_schema=False)
    async def page() -> Response:
        return _file("phone.html")

    @app.get(f"{prefix}/phone/{{name}}", include_in_schema=False)
    async def asset(name: str) -> Response:
        return _file(name)

    def _file(name: str) -> Response:
        if name not in files:
            raise HTTPException(404, f"no file {name[:100]!r}")
        return Response(files[name], media_type=_MEDIA_TYPES[name.rsplit(".", 1)[-1]], headers=_HEADERS)
