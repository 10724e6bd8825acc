"""What /openapi.json says beside the paths: bodies and statuses."""

from typing import Any, Literal

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel

from reloc.gateway.failures import ErrorBody, responses
from reloc.gateway.geopose import MEDIA_TYPE, GeoPoseReq, GeoPoseResp
from reloc.wire.query import CameraRequest, LocaliseReply, PriorRequest, RequestOptions
from reloc.wire.server import MapsReply

DESCRIPTION = (
    "Where was this photo taken? A thin adapter over a featuredb server, which is asked over Zenoh: OSCP "
    "GeoPoseProtocol v2 at /geopose, plain multipart at /localise. Quaternions turn camera axes (x forward, "
    "y left, z up) into true east, north, up. See docs/gateway.md."
)


class Health(BaseModel):
    """A server answers."""

    status: Literal["ok"] = "ok"
    database: str
    snapshot: int
    maps: int


_REF = "#/components/schemas/{model}"


def _body(media_type: str, **content: dict[str, Any]) -> dict[str, Any]:
    return {"requestBody": {"required": True, "content": {media_type: content}}}


def _schema(model: str) -> dict[str, Any]:
    return {"$ref": _REF.format(model=model)}


GEOPOSE: dict[str, Any] = {
    "summary": "OSCP GeoPoseProtocol v2: the pose of the first camera reading",
    "responses": {
        200: {
            "model": GeoPoseResp,
            "description": "The pose. Header Featuredb-Height-Datum names the datum of h where it is not the "
            "ellipsoid's.",
            "content": {MEDIA_TYPE: {"schema": _schema("GeoPoseResp")}},
        },
        **responses(400, 406, 408, 413, 415, 422, 501, 502, 503, 504),
    },
    "openapi_extra": _body("application/json", schema=_schema("GeoPoseReq")),
}
_IMAGE = {"type": "string", "format": "binary", "description": "JPEG, HEIC, AVIF, PNG, WebP, TIFF, BMP"}
_SAID = {"camera": "CameraRequest", "prior": "PriorRequest", "options": "RequestOptions"}
LOCALISE: dict[str, Any] = {
    "summary": "One photo as a form; the answer is the wire's localise_reply.json",
    "responses": {
        200: {
            "model": LocaliseReply,
            "description": "The reply, localised or not: `status` tells, and `reason` why not",
        },
        **responses(400, 408, 413, 415, 501, 502, 503, 504),
    },
    "openapi_extra": _body(
        "multipart/form-data",
        schema={
            "type": "object",
            "required": ["image"],
            "properties": {
                "image": _IMAGE,
                **{name: _schema(model) for name, model in _SAID.items()},
                "request_id": {"type": "string", "pattern": "^[A-Za-z0-9._:-]{1,128}$"},
            },
        },
        encoding={
            "image": {"contentType": "image/jpeg"},
            **{name: {"contentType": "application/json"} for name in _SAID},
        },
    ),
}
MAPS: dict[str, Any] = {
    "summary": "The maps that the server answers from",
    "responses": {200: {"model": MapsReply}, **responses(502, 503, 504)},
}
HEALTH: dict[str, Any] = {
    "summary": "200 only if a server answers over Zenoh",
    "responses": {
        200: {"model": Health},
        503: {"model": ErrorBody, "description": "NO_SERVER or any other code: none answers, and why"},
    },
}


def install(app: FastAPI) -> None:
    """Make `app.openapi` give the document with the bodies' schemas among its components."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            made = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=app.routes
            )
            schemas = made.setdefault("components", {}).setdefault("schemas", {})
            bodies: tuple[type[BaseModel], ...] = (GeoPoseReq, CameraRequest, PriorRequest, RequestOptions)
            for model in bodies:
                schema = model.model_json_schema(ref_template=_REF)
                for name, part in schema.pop("$defs", {}).items():
                    schemas.setdefault(name, part)
                schemas[model.__name__] = schema
            app.openapi_schema = made
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]
