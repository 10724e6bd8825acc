"""Errors over HTTP: the wire's codes, the gateway's own, and the status of each."""

from pydantic import BaseModel, Field

from reloc.client import BAD_REPLY, NO_SERVER, TIMEOUT
from reloc.wire.query import ErrorCode

NOT_LOCALISED = "NOT_LOCALISED"
NOT_FOUND = "NOT_FOUND"
NOT_READY = "NOT_READY"
METHOD_NOT_ALLOWED = "METHOD_NOT_ALLOWED"
NOT_ACCEPTABLE = "NOT_ACCEPTABLE"
SLOW_BODY = "SLOW_BODY"
UNSUPPORTED_MEDIA_TYPE = "UNSUPPORTED_MEDIA_TYPE"

# 500 is left for defects of the gateway itself: what is wrong behind it is a bad gateway's 502.
STATUS_OF = {
    ErrorCode.BAD_REQUEST.value: 400,
    NOT_FOUND: 404,
    METHOD_NOT_ALLOWED: 405,
    NOT_ACCEPTABLE: 406,
    SLOW_BODY: 408,
    ErrorCode.TOO_LARGE.value: 413,
    UNSUPPORTED_MEDIA_TYPE: 415,
    # RFC 9110: also "as a result of inspecting the data directly".
    ErrorCode.BAD_IMAGE.value: 415,
    NOT_LOCALISED: 422,
    ErrorCode.INTERNAL.value: 502,
    ErrorCode.INCOMPATIBLE_EXTRACTOR.value: 502,
    BAD_REPLY: 502,
    ErrorCode.UNSUPPORTED.value: 501,
    ErrorCode.BUSY.value: 503,
    ErrorCode.SHUTTING_DOWN.value: 503,
    NO_SERVER: 503,
    NOT_READY: 503,
    ErrorCode.DEADLINE.value: 504,
    TIMEOUT: 504,
}
RETRY_AFTER_S = {ErrorCode.BUSY.value: 1, ErrorCode.SHUTTING_DOWN.value: 5, NO_SERVER: 5, NOT_READY: 1}


class ErrorBody(BaseModel):
    """Body of every answer that is not 2xx."""

    code: str = Field(description="one of docs/gateway.md's table", examples=["BAD_REQUEST"])
    message: str = Field(description="what was expected, what was found", examples=["id: Field required"])
    request_id: str | None = Field(default=None, description="stands in the server's log")
    reason: str | None = Field(
        default=None, description="of NOT_LOCALISED: the wire's reason", examples=["TOO_FEW_INLIERS"]
    )
    id: str | None = Field(default=None, description="of NOT_LOCALISED: the GeoPoseReq's id")
