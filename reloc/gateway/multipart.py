"""`POST /localise`: a form with an image file and JSON fields, as the wire has them."""

from typing import TypeVar

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request

from reloc.gateway.failures import GatewayError
from reloc.gateway.options import GatewayOptions
from reloc.wire.query import (
    MAX_ATTACHMENT_BYTES,
    CameraRequest,
    ErrorCode,
    LocaliseWireRequest,
    PriorRequest,
    RequestError,
    RequestOptions,
    parse_attachment,
)

_Field = TypeVar("_Field", CameraRequest, PriorRequest, RequestOptions)

FIELDS = ("image", "camera", "prior", "options", "request_id")


async def read_form(request: Request, options: GatewayOptions) -> tuple[bytes, LocaliseWireRequest]:
    """The image file, and what is said of it.

    The file goes through a temporary file where it is larger than a megabyte.

    Raises:
        GatewayError: BAD_REQUEST, BAD_IMAGE, TOO_LARGE, and those of the body.
    """
    parts: dict[str, bytes] = {}
    try:
        async with request.form(
            max_files=len(FIELDS), max_fields=len(FIELDS), max_part_size=MAX_ATTACHMENT_BYTES
        ) as form:
            for name, value in form.multi_items():
                if name not in FIELDS or name in parts:
                    raise GatewayError(
                        ErrorCode.BAD_REQUEST,
                        f"form: expected {', '.join(FIELDS)} once each, found {name[:100]!r}",
                    )
                if name == "image" and not isinstance(value, UploadFile):
                    raise GatewayError(
                        ErrorCode.BAD_REQUEST, "image: expected a file (a part with a filename)"
                    )
                parts[name] = await value.read() if isinstance(value, UploadFile) else value.encode()
    except HTTPException as error:  # Starlette's word for a form that cannot be read
        raise GatewayError(ErrorCode.BAD_REQUEST, f"form: {error.detail}") from error
    image = parts.get("image")
    if image is None:
        raise GatewayError(
            ErrorCode.BAD_REQUEST, "image: expected the bytes of an image file, found no such field"
        )
    if len(image) > options.max_image_bytes:
        raise GatewayError(
            ErrorCode.TOO_LARGE,
            f"image: expected at most {options.max_image_bytes} bytes, found {len(image)}",
        )
    said = LocaliseWireRequest(
        camera=_json("camera", CameraRequest, parts),
        prior=_json("prior", PriorRequest, parts),
        options=_json("options", RequestOptions, parts) or RequestOptions(),
        request_id=_request_id(parts),
    )
    return image, said


def _json(name: str, model: type[_Field], parts: dict[str, bytes]) -> _Field | None:
    if not parts.get(name):
        return None
    try:
        return parse_attachment(model, parts[name])
    except RequestError as error:
        raise GatewayError(ErrorCode.BAD_REQUEST, f"{name}: {error.message}") from error


def _request_id(parts: dict[str, bytes]) -> str | None:
    if "request_id" not in parts:
        return None
    try:
        text = parts["request_id"].decode()
        return LocaliseWireRequest(request_id=text).request_id
    except ValueError as error:
        raise GatewayError(
            ErrorCode.BAD_REQUEST, "request_id: expected 1 to 128 of A-Z a-z 0-9 . _ : -"
        ) from error
