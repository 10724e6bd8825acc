"""Messages of OSCP GeoPoseProtocol v2.

https://github.com/OpenArCloud/oscp-geopose-protocol; names of fields are the protocol's. Only what is used
here is checked; the other sensors' readings and fields that the protocol does not know are ignored, since its
clients differ in both.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from reloc.wire.query import Position, Quaternion

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
    rotation: float = 0.0


class CameraReading(Message):
    """One picture: `imageBytes` is base64 of an image file, or of raw pixels in RGBA32 or GRAY8."""

    timestamp: Milliseconds | None = None
    sensorId: Text = ""  # noqa: N815
    imageFormat: Annotated[str, Field(max_length=64)] = ""  # noqa: N815
    size: Annotated[tuple[float, ...], Field(max_length=2)] = Field(default=(), description="width, height")
    imageBytes: str = Field(description="base64")  # noqa: N815
    imageOrientation: ImageOrientation | None = None  # noqa: N815
    params: CameraParam | None = None


class GeolocationReading(Message):
    """As of the W3C's Geolocation: degrees, and metres that hold 95 % of the errors."""

    timestamp: Milliseconds | None = None
    sensorId: Text = ""  # noqa: N815
    latitude: Degrees90
    longitude: Degrees180
    accuracy: float | None = None


class SensorReadings(Message):
    cameraReadings: Annotated[tuple[CameraReading, ...], Field(max_length=16)] = ()  # noqa: N815
    geolocationReadings: Annotated[tuple[GeolocationReading, ...], Field(max_length=1000)] = ()  # noqa: N815


class Sensor(Message):
    id: Text
    type: Text


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
    sensors: Annotated[tuple[Sensor, ...], Field(max_length=1000)] = ()
    sensorReadings: SensorReadings  # noqa: N815
    priorPoses: Annotated[tuple[GeoPoseResp, ...], Field(max_length=1000)] | None = None  # noqa: N815
