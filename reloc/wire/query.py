"""The messages of a query on the wire: request attachment, reply, error.

Models check untrusted text; `schemas/wire/*.json` says the same for other languages, and a test holds
both together. A request refuses unknown fields, so that a misspelt option is not ignored silently. A
reader of replies ignores fields that it does not know, so that a newer server can add some.
"""

import json
from enum import StrEnum
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from featuredb.errors import ServiceError

WIRE_VERSION = "2"  # 2: keys name the client
MAX_ATTACHMENT_BYTES = 65_536  # a request needs a few hundred; more is a mistake or an attack
# A message larger than so many largest payloads is not even gathered; up to it the client hears TOO_LARGE.
MESSAGE_HEADROOM = 4


# Words of an answer: why there is no pose, where the lens came from, what the photo's own position did.
Reason = Literal[
    "NO_COVERAGE",
    "TOO_FEW_FEATURES",
    "TOO_FEW_MATCHES",
    "TOO_FEW_INLIERS",
    "AMBIGUOUS",
    "CONTRADICTS_PRIOR",
]
CameraSource = Literal["request", "map", "exif", "estimated"]
PositionRole = Literal["agrees", "decided", "contradicted", "no_help"]


class ErrorCode(StrEnum):
    """Why a query got `reply_err` instead of an answer."""

    BAD_REQUEST = "BAD_REQUEST"  # the attachment is not a valid request
    BAD_IMAGE = "BAD_IMAGE"  # the payload is not a readable image: unknown format, truncated, broken
    TOO_LARGE = "TOO_LARGE"  # more bytes or pixels than the server takes
    BUSY = "BUSY"  # the queue is full; try again later
    DEADLINE = "DEADLINE"  # no answer within the deadline
    INCOMPATIBLE_EXTRACTOR = "INCOMPATIBLE_EXTRACTOR"  # the maps were made with another feature extractor
    UNSUPPORTED = "UNSUPPORTED"  # a valid wish that this server does not fulfil
    SHUTTING_DOWN = "SHUTTING_DOWN"  # the server stops; ask another or later
    INTERNAL = "INTERNAL"  # a defect of the server; its log has the request id


class RequestError(ServiceError):
    """A query cannot be answered; goes to the client as `reply_err`."""

    def __init__(self, code: ErrorCode, message: str, request_id: str | None = None) -> None:
        super().__init__(code.value, message, request_id)


def bad_request(message: str, request_id: str | None = None) -> RequestError:
    """The request is not what it should be, as the message says."""
    return RequestError(ErrorCode.BAD_REQUEST, message, request_id)


class Request(BaseModel):
    """Base of what a client sends: unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


_Attached = TypeVar("_Attached", bound=Request)


class Answer(BaseModel):
    """Base of what a server sends."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)


RequestId = Annotated[str, Field(pattern=r"^[A-Za-z0-9._:-]{1,128}$")]
# Names of people and terms: no control characters, since terminals and logs show them.
Name = Annotated[str, Field(pattern=r"^[^\s\x00-\x1f\x7f-\x9f][^\x00-\x1f\x7f-\x9f]{0,199}$")]
MapId = Annotated[str, Field(min_length=1, max_length=200)]
# Wide enough for any camera; a value outside is a unit mistake or nonsense.
CameraParam = Annotated[float, Field(ge=-1e6, le=1e6)]
CameraSigma = Annotated[float, Field(ge=0, le=1e6)]
Side = Annotated[int, Field(ge=1, le=65_535)]
Quaternion4 = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]
Triple = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Pair = Annotated[tuple[float, ...], Field(min_length=2, max_length=2)]
Row6 = Annotated[tuple[float, ...], Field(min_length=6, max_length=6)]
Covariance6 = Annotated[tuple[Row6, ...], Field(min_length=6, max_length=6)]
Count = Annotated[int, Field(ge=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]


class CameraRequest(Request):
    """Intrinsics of the photo by COLMAP's model names; those of another size of the picture are scaled.

    `sigmas`: one standard deviation of each parameter, in their order, of an OPENCV or a SIMPLE_RADIAL lens;
    it is then estimated with the pose, within these. Null: the parameters are exact.
    """

    model: Annotated[str, Field(pattern=r"^[A-Z_]{1,32}$")]
    width: Side
    height: Side
    params: Annotated[tuple[CameraParam, ...], Field(min_length=3, max_length=12)]
    sigmas: Annotated[tuple[CameraSigma, ...], Field(min_length=4, max_length=8)] | None = None


class PriorRequest(Request):
    """Where the photo may have been taken: WGS84 degrees, metres, one standard deviation.

    `h` is in the maps' height datum. Its sigma defaults to 100 m, since heights of GPS receivers and
    drones are off by tens of metres and rarely name their datum.
    """

    lat: Annotated[float, Field(ge=-90, le=90)]
    lon: Annotated[float, Field(ge=-180, le=180)]
    sigma_m: Annotated[float, Field(ge=0.01, le=1e6)]
    h: Annotated[float, Field(ge=-12_000, le=100_000)] | None = None
    sigma_vertical_m: Annotated[float, Field(ge=0.01, le=1e6)] = 100.0


class RequestOptions(Request):
    """Wishes of one query."""

    inliers: bool = False
    exif_prior: bool = False
    maps: Annotated[tuple[MapId, ...], Field(max_length=1000)] | None = None
    deadline_ms: Annotated[float, Field(ge=1, le=600_000)] | None = None


class LocaliseWireRequest(Request):
    """The JSON attachment of a localise query; the payload is the image file's bytes."""

    request_id: RequestId | None = None
    camera: CameraRequest | None = None
    prior: PriorRequest | None = None
    contribute: bool = False
    credit: Name | None = None
    licence: Name | None = None
    client_id: Name | None = None
    options: RequestOptions = RequestOptions()

    @model_validator(mode="after")
    def _terms_of_a_gift(self) -> "LocaliseWireRequest":
        missing = [name for name in ("credit", "licence") if getattr(self, name) is None]
        if self.contribute and missing:
            raise ValueError(
                f"contribute: expected {' and '.join(missing)}, too: whom to name with the photo, and "
                "under what terms it is given"
            )
        return self


class Position(Answer):
    """OGC GeoPose position: WGS84 degrees, metres."""

    lat: Annotated[float, Field(ge=-90, le=90)]
    lon: Annotated[float, Field(ge=-180, le=180)]
    h: float


class Quaternion(Answer):
    """OGC GeoPose orientation: body axes to local east-north-up at the position."""

    x: float
    y: float
    z: float
    w: float


class UtmPose(Answer):
    """Camera centre in UTM metres and rotation of grid axes (east, north, up) into camera axes."""

    epsg: int
    easting: float
    northing: float
    height: float
    cam_from_utm_xyzw: Quaternion4


class Accuracy(Answer):
    """Radii that hold 68 % of the errors."""

    horizontal_68_m: NotNegative
    vertical_68_m: NotNegative
    orientation_68_deg: NotNegative


class Intrinsics(Answer):
    """Intrinsics by COLMAP's model names."""

    model: str
    width: Side
    height: Side
    params: tuple[float, ...]


class CameraUsed(Intrinsics):
    """Intrinsics that the pose was computed with, and where they came from."""

    source: CameraSource


class Lineage(Answer):
    """What placed a map on Earth.

    `steps` placements lie between it and the nearest of its `anchors`, which measured their own place.
    """

    map_id: str
    method: str
    generation: Count
    parents: tuple[str, ...]
    steps: Count | None = None
    anchors: tuple[str, ...] = ()
    drift_m: NotNegative | None = None
    budget_m: NotNegative | None = None


class RunnerUpPose(Answer):
    """The best pose elsewhere, which did not win."""

    inliers: Count
    distance_m: NotNegative
    angle_deg: NotNegative
    lat: float
    lon: float


class OwnPositionUse(Answer):
    """What the position in the photo's EXIF did to the answer, where `options.exif_prior` asked for it.

    `agrees`: the answer is the same without it. `decided`: without it there is none. `contradicted`: the
    photo shows another place, where it is answered, or both places fit. `no_help`: not localised with it
    either. `distance_m`: of the answer from it, horizontally.
    """

    role: PositionRole
    distance_m: NotNegative | None


class InlierPoints(Answer):
    """Evidence, on request: k pixels of the query, the UTM points they saw, and the row in `maps` of each."""

    pixels: tuple[Pair, ...]
    utm: tuple[Triple, ...]
    map_rows: tuple[Count, ...]


class InMapPose(Answer):
    """A pose in the own frame of a map without a place: nothing in it is a place on Earth.

    `cam_from_map_xyzw` and `cam_from_map_translation` lead from the map's frame to camera axes (x right, y
    down, z forward), `center` is the camera's centre in the map's frame; lengths are metres only where
    `metric`, z is up only where `upright`. `covariance`: rotation (rad) before displacement of the centre,
    axes and units of the frame.
    """

    map_id: str
    metric: bool
    upright: bool
    cam_from_map_xyzw: Quaternion4
    cam_from_map_translation: Triple
    center: Triple
    covariance: Covariance6
    camera: CameraUsed
    residual_rms_px: NotNegative


ContributionReason = Literal["QUEUE_FULL", "OWNER_LIMIT", "INBOX_FULL", "STORE_FAILED"]


class ContributionReply(Answer):
    """What became of a contributed photo: queued for the inbox, or not taken and why."""

    accepted: bool
    candidate_id: str | None
    reason: ContributionReason | None
    detail: str


class PlacedAnswer(Answer):
    """Where a camera was on Earth, and how surely; all null where that is not known."""

    position: Position | None = None
    quaternion: Quaternion | None = None
    body_axes: Literal["x forward, y left, z up"] = "x forward, y left, z up"
    height_datum: str | None = None
    utm: UtmPose | None = None
    covariance: Covariance6 | None = None
    accuracy: Accuracy | None = None


class LocaliseReply(PlacedAnswer):
    """The answer to a localise query; the pose's fields are null when it is not localised on Earth.

    `view_covariance`: of the six of `covariance` and then of `camera.params`, for what pixels show; null
    where the lens is exact.

    A map without a place that the request named answers `localised_in_map`: then `in_map` has the pose in the
    map's own frame, and whatever would say where on Earth that is stays null.
    """

    status: Literal["localised", "localised_in_map", "not_localised"]
    reason: Reason | None
    detail: str
    confidence: Unit
    camera: CameraUsed | None = None
    features: Count
    matches: Count
    inliers: Count
    residual_rms_px: NotNegative | None = None
    maps: tuple[str, ...] = ()
    lineage: tuple[Lineage, ...] = ()
    runner_up: RunnerUpPose | None = None
    inlier_points: InlierPoints | None = None
    snapshot: Count
    timings_ms: dict[str, NotNegative]
    request_id: str
    contribution: ContributionReply | None = None
    in_map: InMapPose | None = None
    view_covariance: tuple[tuple[float, ...], ...] | None = None
    exif_prior: OwnPositionUse | None = None

    @model_validator(mode="after")
    def _pose_or_reason(self) -> "LocaliseReply":
        size = 6 + (0 if self.camera is None else len(self.camera.params))
        if self.view_covariance is not None and [len(r) for r in self.view_covariance] != [size] * size:
            raise ValueError(f"view_covariance: expected {size} rows of {size}")
        pose = (self.position, self.quaternion, self.utm, self.covariance, self.accuracy, self.camera)
        if self.status == "localised" and (self.reason is not None or any(p is None for p in pose)):
            raise ValueError("a localised reply needs every field of the pose and no reason")
        if self.status == "not_localised" and (self.reason is None or any(p is not None for p in pose)):
            raise ValueError("a reply that is not localised needs a reason and no pose")
        if (self.status == "localised_in_map") != (self.in_map is not None):
            raise ValueError("a pose in a map needs the status localised_in_map, and the other way round")
        earth = (*pose, self.height_datum, self.runner_up, self.inlier_points)
        if self.in_map is not None and (self.reason is not None or any(p is not None for p in earth)):
            raise ValueError("a pose in a map needs no reason and nothing of a place on Earth")
        return self


class ErrorReply(Answer):
    """Payload of `reply_err`."""

    code: str
    message: str
    request_id: str | None


def parse_attachment(model: type[_Attached], attachment: bytes | None) -> _Attached:
    """Read a JSON attachment; none or an empty one is an object without fields.

    Raises:
        RequestError: BAD_REQUEST with the field, what was expected and what was found.
    """
    attachment = attachment or b"{}"
    if len(attachment) > MAX_ATTACHMENT_BYTES:
        most = f"at most {MAX_ATTACHMENT_BYTES} bytes of JSON"
        raise bad_request(f"attachment: expected {most}, found {len(attachment)}")
    try:
        return model.model_validate_json(attachment)
    except ValidationError as error:
        raise bad_request(explain(error), _request_id_in(attachment)) from error


def encode(message: BaseModel) -> bytes:
    """A message as UTF-8 JSON."""
    return message.model_dump_json().encode()


def explain(error: ValidationError, whole: str = "attachment", *, inputs: bool = True) -> str:
    """One line for people out of pydantic's list: field (or `whole`), expectation, what was found."""
    parts = []
    for item in error.errors(include_url=False, include_input=inputs, include_context=False)[:3]:
        shown = f", found {item['input']!r:.80}" if inputs else ""
        parts.append(f"{'.'.join(map(str, item['loc'])) or whole}: {item['msg']}{shown}")
    return "; ".join(parts)


def request_id_of(found: Any) -> str | None:
    """What a client calls its request, if a request can be called so."""
    try:
        return LocaliseWireRequest(request_id=found).request_id
    except ValidationError:
        return None


def _request_id_in(attachment: bytes) -> str | None:
    """The request id of a refused attachment, where it can still be read."""
    try:
        found = json.loads(attachment)
    except (ValueError, RecursionError):
        return None
    return request_id_of(found.get("request_id")) if isinstance(found, dict) else None
