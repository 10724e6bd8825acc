"""Errors over HTTP: the wire's codes, the gateway's own, and the status of each."""

from typing import Any

from pydantic import BaseModel, Field

from reloc.client import BAD_REPLY, NO_SERVER, TIMEOUT

NOT_LOCALISED = "NOT_LOCALISED"
NOT_FOUND = "NOT_FOUND"
NOT_READY = "NOT_READY"
METHOD_NOT_ALLOWED = "METHOD_NOT_ALLOWED"
NOT_ACCEPTABLE = "NOT_ACCEPTABLE"
SLOW_BODY = "SLOW_BODY"
UNSUPPORTED_MEDIA_TYPE = "UNSUPPORTED_MEDIA_TYPE"

# Codes and meaning by status. 500 is left for defects of the gateway itself: what is wrong behind it is a bad
# gateway's 502. 415 is in RFC 9110 also "as a result of inspecting the data directly".
_FAILURES = {
    400: (("BAD_REQUEST",), "the body is not what it should be; the message names the field"),
    404: ((NOT_FOUND,), "there is no such path"),
    405: ((METHOD_NOT_ALLOWED,), "the path has other methods"),
    406: ((NOT_ACCEPTABLE,), "another version of the protocol is asked for"),
    408: ((SLOW_BODY,), "the body did not arrive in time"),
    413: (("TOO_LARGE",), "more bytes or pixels than are taken"),
    415: ((UNSUPPORTED_MEDIA_TYPE, "BAD_IMAGE"), "the picture is no image file, or a broken one"),
    422: ((NOT_LOCALISED,), "a valid request, and no place is known for its photo"),
    501: (("UNSUPPORTED",), "a valid wish that the server does not fulfil"),
    502: (("INTERNAL", "INCOMPATIBLE_EXTRACTOR", BAD_REPLY), "the server behind failed"),
    503: (("BUSY", "SHUTTING_DOWN", NO_SERVER, NOT_READY), "try again after Retry-After seconds"),
    504: (("DEADLINE", TIMEOUT), "no answer in time"),
}
STATUS_OF = {code: status for status, (codes, _) in _FAILURES.items() for code in codes}
RETRY_AFTER_S = {"BUSY": 1, "SHUTTING_DOWN": 5, NO_SERVER: 5, NOT_READY: 1}


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What a route may fail with, for /openapi.json."""
    return {
        s: {"model": ErrorBody, "description": f"{', '.join(_FAILURES[s][0])}: {_FAILURES[s][1]}"}
        for s in statuses
    }


class ErrorBody(BaseModel):
    """Body of every answer that is not 2xx."""

    code: str = Field(description="one of docs/gateway.md's table", examples=["BAD_REQUEST"])
    message: str = Field(description="what was expected, what was found", examples=["id: Field required"])
    request_id: str | None = Field(default=None, description="stands in the server's log")
    reason: str | None = Field(
        default=None, description="of NOT_LOCALISED: the wire's reason", examples=["TOO_FEW_INLIERS"]
    )
    id: str | None = Field(default=None, description="of NOT_LOCALISED: the GeoPoseReq's id")
