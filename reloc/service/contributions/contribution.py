"""A contributed photo as a database keeps it: what of the query and of its answer goes with it."""

from dataclasses import asdict
from datetime import datetime
from typing import Any

from featuredb.features.exif.read import ExifInfo, read_exif
from featuredb.features.image_header import read_header
from featuredb.store.candidates.states import Contribution
from reloc.wire.query import LocaliseReply, LocaliseWireRequest

_ANSWER = {
    "request_id", "status", "reason", "detail", "position", "utm", "height_datum", "covariance", "accuracy",
    "confidence", "camera", "matches", "inliers", "residual_rms_px", "maps",
}  # fmt: skip


def contribution_of(
    data: bytes,
    request: LocaliseWireRequest,
    reply: LocaliseReply,
    received_at: datetime,
    owner: str,
) -> Contribution:
    """The row of a contributed photo out of its query, which has been answered and found valid.

    `owner`: the name by which the client was authenticated, ANONYMOUS where it was not.
    """
    header = read_header(data)
    asked = request.model_dump(mode="json", include={"request_id", "camera", "prior", "options"})
    return Contribution(
        image=data,
        width=header.width,
        height=header.height,
        owner=owner,
        credit=request.credit or "",
        licence=request.licence or "",
        client_id=request.client_id or "",
        received_at=received_at,
        request={**asked, "exif": _told(read_exif(data, header))},
        answer=reply.model_dump(mode="json", include=_ANSWER),
        snapshot=reply.snapshot,
    )


def _told(exif: ExifInfo) -> dict[str, Any]:
    """What the photo says about itself, without what it does not say."""
    told = {name: value for name, value in asdict(exif).items() if value not in (None, "", ())}
    return {name: value.isoformat() if isinstance(value, datetime) else value for name, value in told.items()}
