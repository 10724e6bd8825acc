"""Bodies as they arrive: counted while they stream, bounded in size, number, memory and time."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TypeVar

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import Message, Receive

from featuredb.errors import ServiceError
from reloc.gateway.failures import SLOW_BODY, UNSUPPORTED_MEDIA_TYPE
from reloc.gateway.options import GatewayOptions
from reloc.wire.query import (
    MAX_ATTACHMENT_BYTES,
    CameraRequest,
    ErrorCode,
    LocaliseWireRequest,
    PriorRequest,
    RequestError,
    RequestOptions,
    bad_request,
    parse_attachment,
    request_id_of,
)


class Intake:
    """Admits requests with a body; all of its state belongs to the event loop."""

    def __init__(self, options: GatewayOptions) -> None:
        self._options = options
        self.in_flight = 0
        self.buffered_bytes = 0

    @asynccontextmanager
    async def admitted(self, request: Request, media_type: str) -> AsyncIterator[Request]:
        """Within the block, the request with a body that ends in a ServiceError where it breaks a limit.

        It is in hand from the end of its body on: who sends slowly takes nobody's place.

        Raises:
            ServiceError: TOO_LARGE, UNSUPPORTED_MEDIA_TYPE; while the body is read also BUSY, SLOW_BODY.
        """
        _check_headers(request, media_type)
        options, held_bytes, complete = self._options, 0, False
        end = time.monotonic() + options.body_timeout_s
        too_large = f"body: expected at most {options.max_body_bytes} bytes; send a smaller picture"

        async def receive() -> Message:
            nonlocal held_bytes, complete
            message = await _next(request.receive, end, options)
            size = len(message.get("body", b""))
            if held_bytes + size > options.max_body_bytes:
                raise ServiceError(ErrorCode.TOO_LARGE, too_large)
            if self.buffered_bytes + size > options.max_buffered_bytes:
                raise ServiceError(
                    ErrorCode.BUSY, "the photos in hand fill the memory; try again in a second"
                )
            held_bytes += size
            self.buffered_bytes += size
            if not (complete or message.get("more_body", False)):
                if self.in_flight >= options.max_in_flight:
                    many = f"{self.in_flight} photos are in hand, which is as many as are taken"
                    raise ServiceError(ErrorCode.BUSY, f"{many}; try again in a second")
                complete = True
                self.in_flight += 1
            return message

        try:
            declared = request.headers.get("content-length", "")
            if declared.isdecimal() and int(declared) > options.max_body_bytes:
                raise ServiceError(ErrorCode.TOO_LARGE, too_large)
            yield Request(request.scope, receive)
        finally:
            self.in_flight -= complete
            self.buffered_bytes -= held_bytes


def _check_headers(request: Request, media_type: str) -> None:
    found = request.headers.get("content-type", "").split(";")[0].strip().lower()
    wanted = (media_type, "application/vnd.oscp+json") if media_type == "application/json" else (media_type,)
    if found not in wanted:
        raise ServiceError(
            UNSUPPORTED_MEDIA_TYPE, f"Content-Type: expected {media_type}, found {found[:100]!r}"
        )
    coding = request.headers.get("content-encoding", "identity").strip().lower()
    if coding != "identity":
        raise ServiceError(
            UNSUPPORTED_MEDIA_TYPE,
            f"Content-Encoding: expected none, found {coding[:100]!r}; images are compressed",
        )


async def _next(receive: Receive, end: float, options: GatewayOptions) -> Message:
    """What comes of a body, until `end` of the monotonic clock."""
    try:
        async with asyncio.timeout(max(0.0, end - time.monotonic())):
            message = await receive()
    except TimeoutError as error:
        text = f"body: expected within {options.body_timeout_s:g} s, found a part of it"
        raise ServiceError(SLOW_BODY, text) from error
    if message["type"] == "http.disconnect":
        raise ClientDisconnect
    return message


_Field = TypeVar("_Field", CameraRequest, PriorRequest, RequestOptions)

FIELDS = ("image", "camera", "prior", "options", "request_id")


async def read_form(request: Request, options: GatewayOptions) -> tuple[bytes, LocaliseWireRequest]:
    """The image file, and what is said of it.

    The file goes through a temporary file where it is larger than a megabyte.

    Raises:
        ServiceError: BAD_REQUEST, BAD_IMAGE, TOO_LARGE, and those of the body.
    """
    parts: dict[str, bytes] = {}
    try:
        async with request.form(
            max_files=len(FIELDS), max_fields=len(FIELDS), max_part_size=MAX_ATTACHMENT_BYTES
        ) as form:
            for name, value in form.multi_items():
                if name not in FIELDS or name in parts:
                    raise bad_request(f"form: expected {', '.join(FIELDS)} once each, found {name[:100]!r}")
                if name == "image" and not isinstance(value, UploadFile):
                    raise bad_request("image: expected a file (a part with a filename)")
                parts[name] = await value.read() if isinstance(value, UploadFile) else value.encode()
    except HTTPException as error:  # Starlette's word for a form that cannot be read
        raise bad_request(f"form: {error.detail}") from error
    image = parts.get("image")
    if image is None:
        raise bad_request("image: expected the bytes of an image file, found no such field")
    if len(image) > options.max_image_bytes:
        text = f"image: expected at most {options.max_image_bytes} bytes, found {len(image)}"
        raise ServiceError(ErrorCode.TOO_LARGE, text)
    raw = parts.get("request_id")
    request_id = None if raw is None else request_id_of(raw.decode(errors="replace"))
    if raw is not None and request_id is None:
        raise bad_request("request_id: expected 1 to 128 of A-Z a-z 0-9 . _ : -")
    return image, LocaliseWireRequest(
        camera=_json("camera", CameraRequest, parts),
        prior=_json("prior", PriorRequest, parts),
        options=_json("options", RequestOptions, parts) or RequestOptions(),
        request_id=request_id,
    )


def _json(name: str, model: type[_Field], parts: dict[str, bytes]) -> _Field | None:
    if not parts.get(name):
        return None
    try:
        return parse_attachment(model, parts[name])
    except RequestError as error:
        raise bad_request(f"{name}: {error.message}") from error
