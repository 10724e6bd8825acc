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
_CODES_OF = {
    400: (ErrorCode.BAD_REQUEST,),
    404: (NOT_FOUND,),
    405: (METHOD_NOT_ALLOWED,),
    406: (NOT_ACCEPTABLE,),
    408: (SLOW_BODY,),
    413: (ErrorCode.TOO_LARGE,),
    # RFC 9110: also "as a result of inspecting the data directly".
    415: (UNSUPPORTED_MEDIA_TYPE, ErrorCode.BAD_IMAGE),
    422: (NOT_LOCALISED,),
    501: (ErrorCode.UNSUPPORTED,),
    502: (ErrorCode.INTERNAL, ErrorCode.INCOMPATIBLE_EXTRACTOR, BAD_REPLY),
    503: (ErrorCode.BUSY, ErrorCode.SHUTTING_DOWN, NO_SERVER, NOT_READY),
    504: (ErrorCode.DEADLINE, TIMEOUT),
}
STATUS_OF = {str(code): status for status, codes in _CODES_OF.items() for code in codes}
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
