"""OSCP GeoPoseProtocol v2: a GeoPoseReq as a question for the server, and its answer as a GeoPoseResp.

https://github.com/OpenArCloud/oscp-geopose-protocol; names of fields are the protocol's. Only what is used
here is checked; the other sensors' readings and fields that the protocol does not know are ignored, since its
clients differ in both.

The answer's body axes are those of this project's GeoPose, x forward, y left, z up, so that a level camera
looking true east has the identity. The protocol's text names none; its reference server (OpenVPS) and its web
client (spARcl, `convertAugmentedCityCam2WebQuat`) use these.
"""

import base64
import binascii
import io
import math
import re
from typing import Annotated, Literal

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from featuredb.errors import ServiceError
from featuredb.geo.datum import HEIGHT_DATUMS, ellipsoidal_height
from reloc.gateway.failures import NOT_ACCEPTABLE, NOT_LOCALISED
from reloc.gateway.options import GatewayOptions
from reloc.wire.query import (
    CameraRequest,
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    Position,
    PriorRequest,
    Quaternion,
    bad_request,
    explain,
    request_id_of,
)

MEDIA_TYPE = "application/vnd.oscp+json"
VERSION = "2.0"

# Milliseconds since 1970; whole numbers stay whole in the answer. The limit is the year 318857.
Milliseconds = Annotated[int, Field(ge=0, le=10**16)] | Annotated[float, Field(ge=0, le=1e16)]
Degrees90 = Annotated[float, Field(ge=-90, le=90)]
Degrees180 = Annotated[float, Field(ge=-180, le=180)]
Text = Annotated[str, Field(max_length=1024)]


class Message(BaseModel):
    """Base: unknown fields are ignored, numbers are finite numbers."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)


class CameraParam(Message):
    """Intrinsics by COLMAP's names; without a model or parameters the lens is unknown."""

    model: Annotated[str, Field(max_length=64)] | None = None
    modelParams: Annotated[tuple[float, ...], Field(max_length=32)] | None = None  # noqa: N815


class ImageOrientation(Message):
    mirrored: bool = False


class CameraReading(Message):
    """One picture: `imageBytes` is base64 of an image file, or of raw pixels in RGBA32 or GRAY8."""

    timestamp: Milliseconds | None = None
    imageFormat: Annotated[str, Field(max_length=64)] = ""  # noqa: N815
    size: Annotated[tuple[float, ...], Field(max_length=2)] = Field(default=(), description="width, height")
    imageBytes: str = Field(description="base64")  # noqa: N815
    imageOrientation: ImageOrientation | None = None  # noqa: N815
    params: CameraParam | None = None


class GeolocationReading(Message):
    """As of the W3C's Geolocation: degrees, and metres that hold 95 % of the errors."""

    timestamp: Milliseconds | None = None
    latitude: Degrees90
    longitude: Degrees180
    accuracy: float | None = None


class SensorReadings(Message):
    cameraReadings: Annotated[tuple[CameraReading, ...], Field(max_length=16)] = ()  # noqa: N815
    geolocationReadings: Annotated[tuple[GeolocationReading, ...], Field(max_length=1000)] = ()  # noqa: N815


class GeoPoseBasicQuaternion(Message):
    """OGC GeoPose Basic-Quaternion: x forward, y left, z up of the camera to true east, north, up."""

    position: Position
    quaternion: Quaternion


class GeoPoseAccuracy(Message):
    position: float = Field(description="metres, mean of the components' standard deviations")
    orientation: float = Field(description="degrees, mean of the three angles' standard deviations")


class GeoPoseResp(Message):
    """The answer to a request, and the form of a prior pose."""

    id: Text
    timestamp: Milliseconds
    accuracy: GeoPoseAccuracy
    type: Literal["geopose"] = "geopose"
    geopose: GeoPoseBasicQuaternion


class GeoPoseReq(Message):
    id: Text
    timestamp: Milliseconds
    type: Literal["geopose"]
    sensorReadings: SensorReadings  # noqa: N815
    priorPoses: Annotated[tuple[GeoPoseResp, ...], Field(max_length=1000)] | None = None  # noqa: N815


# The W3C's accuracy holds 95 % of the errors; so many sigmas of one axis does a circle that holds them have.
_SIGMAS_OF_95 = math.sqrt(-2.0 * math.log(0.05))
# A camera may have moved since a prior pose: by car in a town. After five minutes it says nothing of use.
_PRIOR_POSE_SPEED_M_S = 15.0
_PRIOR_POSE_AGE_S = 300.0
_CHANNELS = {"RGBA32": 4, "GRAY8": 1}
_FILE_BEGINNINGS = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"RIFF", b"II*\x00", b"MM\x00*", b"BM")
_VERSION = re.compile(r";\s*version\s*=\s*\"?(\d{1,4})")


class NotLocalisedError(ServiceError):
    """The photo's place is not known: `reply` says why."""

    def __init__(self, reply: LocaliseReply, geopose_id: str) -> None:
        why = f"{reply.reason}: {reply.detail}"
        if reply.in_map is not None:
            why = f"found in map {reply.in_map.map_id}, which has no place on Earth"
        super().__init__(NOT_LOCALISED, why, reply.request_id)
        self.reply = reply
        self.geopose_id = geopose_id


def parse(body: bytes) -> GeoPoseReq:
    """Read a request. Raises ServiceError: BAD_REQUEST with the fields."""
    try:
        return GeoPoseReq.model_validate_json(body)
    except ValidationError as error:
        # Without the values found: a missing id would print the whole request with its picture.
        raise bad_request(explain(error, "body", inputs=False)) from error


def check_version(accept: str) -> bool:
    """Whether the client asks for the protocol's media type; the header is that of HTTP, "" without one.

    Raises:
        ServiceError: NOT_ACCEPTABLE, for another version than 2.
    """
    found = [part for part in accept.lower().split(",") if part.strip().startswith(MEDIA_TYPE)]
    versions = [_VERSION.search(part) for part in found]
    if found and not any(version is None or int(version[1]) == 2 for version in versions):
        text = f"Accept: expected {MEDIA_TYPE}; version=2.0, found {accept[:100]!r}"
        raise ServiceError(NOT_ACCEPTABLE, text)
    return bool(found)


def question_of(request: GeoPoseReq, options: GatewayOptions) -> tuple[bytes, LocaliseWireRequest]:
    """What to ask the server: an image file, and what is said of it.

    Raises:
        ServiceError: BAD_REQUEST, BAD_IMAGE, TOO_LARGE.
    """
    readings = request.sensorReadings.cameraReadings
    pictures = [reading for reading in readings if reading.imageFormat.upper() != "DEPTH"]
    if not pictures:
        raise bad_request(
            "sensorReadings.cameraReadings: expected a picture that is no depth image, found none"
        )
    picture = pictures[0]
    if picture.imageOrientation is not None and picture.imageOrientation.mirrored:
        raise bad_request(
            "imageOrientation.mirrored: expected false; mirror the picture back, since no camera sees it so"
        )
    size = _size(picture)
    image = _image_file(_decoded(picture.imageBytes, options.max_image_bytes), picture, size)
    asked = LocaliseWireRequest(
        prior=_prior(request, picture, options),
        camera=_camera(picture, size),
        request_id=request_id_of(request.id),
    )
    return image, asked


def response_of(request: GeoPoseReq, reply: LocaliseReply) -> tuple[GeoPoseResp, str]:
    """The answer, and the datum of its height: `ellipsoidal` as GeoPose wants it wherever it can be had.

    Raises:
        NotLocalisedError: it is none.
    """
    if reply.position is None or reply.quaternion is None or reply.covariance is None:
        raise NotLocalisedError(reply, request.id)
    position, datum = reply.position, reply.height_datum or "unknown"
    if datum in HEIGHT_DATUMS:
        # Without the geoid's grid the height stays what it is, and the answer says so.
        converted = ellipsoidal_height(position.lat, position.lon, position.h, datum).height_m
        if converted is not None:
            position, datum = position.model_copy(update={"h": converted}), "ellipsoidal"
    sigmas = np.sqrt(np.diag(np.array(reply.covariance)))
    response = GeoPoseResp(
        id=request.id,
        timestamp=request.timestamp,
        accuracy=GeoPoseAccuracy(
            position=float(np.mean(sigmas[3:])), orientation=float(np.degrees(np.mean(sigmas[:3])))
        ),
        geopose=GeoPoseBasicQuaternion(position=position, quaternion=reply.quaternion),
    )
    return response, datum


def _decoded(text: str, max_bytes: int) -> bytes:
    if len(text) // 4 * 3 > max_bytes + 2:
        found = f"found {len(text) // 4 * 3}; send a smaller picture"
        raise ServiceError(ErrorCode.TOO_LARGE, f"imageBytes: expected at most {max_bytes} bytes, {found}")
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise bad_request(f"imageBytes: expected base64 without prefix or line breaks ({error})") from error
    if not data:
        raise ServiceError(ErrorCode.BAD_IMAGE, "imageBytes: expected an image file, found none")
    return data


def _size(picture: CameraReading) -> tuple[int, int] | None:
    """Width and height; None where the client does not say."""
    if len(picture.size) != 2 or not any(picture.size):
        return None
    width, height = picture.size
    if not all(side.is_integer() and 1 <= side <= 65_535 for side in (width, height)):
        raise bad_request(f"size: expected [width, height] in pixels, found {picture.size}")
    return int(width), int(height)


def _image_file(data: bytes, picture: CameraReading, size: tuple[int, int] | None) -> bytes:
    """The picture as a file. Clients call files RGBA32, too, so the bytes decide and not `imageFormat`."""
    channels = _CHANNELS.get(picture.imageFormat.upper())
    if channels is None or data.startswith(_FILE_BEGINNINGS) or data[4:8] == b"ftyp":
        return data
    if size is None or len(data) != size[0] * size[1] * channels:
        raise ServiceError(
            ErrorCode.BAD_IMAGE,
            f"imageBytes: expected an image file, or width x height x {channels} bytes of "
            f"{picture.imageFormat} of size {size}, found {len(data)} bytes",
        )
    out = io.BytesIO()
    mode, stored = ("L", "L") if channels == 1 else ("RGBA", "RGB")
    Image.frombytes(mode, size, data).convert(stored).save(out, "PNG", compress_level=1)
    return out.getvalue()


def _camera(picture: CameraReading, size: tuple[int, int] | None) -> CameraRequest | None:
    params = picture.params
    if params is None or not params.modelParams or not params.model:
        return None
    model = params.model.upper()
    if model.startswith("UNKNOWN"):
        return None
    if size is None:
        raise bad_request("size: expected [width, height], to which params belong")
    try:
        return CameraRequest(model=model, width=size[0], height=size[1], params=params.modelParams)
    except ValidationError as error:
        raise bad_request(f"params.{explain(error, '', inputs=False)}") from error


def _prior(request: GeoPoseReq, picture: CameraReading, options: GatewayOptions) -> PriorRequest | None:
    """The position nearest in time to the picture; else the latest of the prior poses; else none."""
    taken = request.timestamp if picture.timestamp is None else picture.timestamp
    # Reference clients send their reading also before anybody has filled it in: all zeros.
    readings = request.sensorReadings.geolocationReadings
    places = [place for place in readings if place.latitude or place.longitude or place.accuracy]
    if places:
        place = min(places, key=lambda p: 0.0 if p.timestamp is None else abs(p.timestamp - taken))
        sigma_m = options.prior_unknown_m
        if place.accuracy is not None and place.accuracy > 0:
            sigma_m = place.accuracy / _SIGMAS_OF_95
        return _prior_request(place.latitude, place.longitude, sigma_m, options)
    poses = request.priorPoses or ()
    if not poses:
        return None
    pose = max(poses, key=lambda p: p.timestamp)
    age_s = abs(request.timestamp - pose.timestamp) / 1e3
    if age_s > _PRIOR_POSE_AGE_S:
        return None
    sigma_m = max(pose.accuracy.position, 0.0) + _PRIOR_POSE_SPEED_M_S * age_s
    return _prior_request(pose.geopose.position.lat, pose.geopose.position.lon, sigma_m, options)


def _prior_request(lat: float, lon: float, sigma_m: float, options: GatewayOptions) -> PriorRequest:
    return PriorRequest(lat=lat, lon=lon, sigma_m=min(max(sigma_m, options.prior_floor_m), 1e6))
