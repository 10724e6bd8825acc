"""One query from bytes to reply: parse, decode, localise, word the answer. No network here."""

import uuid
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import (
    ImageError,
    IncompatibleExtractorError,
    InvalidValueError,
    MapNotFoundError,
    UnplacedBesideOthersError,
)
from featuredb.features.decode import DEFAULT_LIMITS, DecodeLimits, decode_gray, probe
from featuredb.features.exif.read import read_exif
from featuredb.features.stored_image import ImageHeader
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import prior_from_exif
from featuredb.stage_clock import StageClock
from reloc.answered_view import camera_of, geo_prior
from reloc.localise.lens_prior import QueryLensPrior, known_within
from reloc.localise.result import LocalisedPose, LocaliseRequest, LocaliseResult, OnEarth
from reloc.localiser import Localiser
from reloc.wire.query import (
    Accuracy,
    CameraRequest,
    CameraUsed,
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    Position,
    Quaternion,
    RequestError,
    UtmPose,
    bad_request,
)

_LEAST_FOCAL = 0.1  # of the longer side, as COLMAP's: 157 degrees; fisheyes of 360 degrees have 0.16


def answer_query(
    wire_request: LocaliseWireRequest,  # without a request id it gets one
    data: bytes,
    localiser: Localiser,
    *,
    limits: DecodeLimits = DEFAULT_LIMITS,
) -> LocaliseReply:
    """Localise the image file in `data`. Raises RequestError: why the query has no answer."""
    clock = StageClock()
    try:
        gray, header = decode_photo(data, localiser, limits)
        clock.lap("decode")
        request = localise_request(wire_request, data, header)
        clock.lap("exif")
        result = localiser.localise(gray, request, header.size)
    except ImageError as error:
        raise image_refused(error) from error
    except IncompatibleExtractorError as error:
        raise RequestError(ErrorCode.INCOMPATIBLE_EXTRACTOR, str(error)) from error
    except (MapNotFoundError, UnplacedBesideOthersError) as error:
        raise bad_request(f"options.maps: {error}") from error
    clock.lap("localise_rest", result.timings_ms)
    request_id = wire_request.request_id or uuid.uuid4().hex
    reply = reply_from_result(result, request_id=request_id, timings_ms={})
    clock.lap("reply")
    return reply.model_copy(update={"timings_ms": clock.milliseconds()})


def decode_photo(
    data: bytes, localiser: Localiser, limits: DecodeLimits = DEFAULT_LIMITS
) -> tuple[NDArray[np.uint8], ImageHeader]:
    """Grey pixels of an image file, not much larger than the localiser needs them, and its header.

    Raises:
        ImageError: no usable image.
    """
    header = probe(data, limits)
    side_px = localiser.options.extractor.first_octave_px
    return decode_gray(data, limits, header=header, side_px=side_px), header


def localise_request(wire_request: LocaliseWireRequest, data: bytes, header: ImageHeader) -> LocaliseRequest:
    """What the localiser needs to know, from the request and the file's EXIF.

    Args:
        data: bytes of the image file. header: of `probe`.

    Raises:
        RequestError: BAD_REQUEST, the camera is none, or does not fit the image.
    """
    exif = read_exif(data, header)
    lens = wire_request.camera
    camera = None if lens is None else query_camera(lens, header.width, header.height)
    return LocaliseRequest(
        camera=camera,
        camera_prior=None if lens is None or camera is None else _camera_prior(lens, camera),
        camera_is_exact=lens is not None and lens.sigmas is None,
        camera_key=exif.camera_key or None,
        exif_focal_px=exif.focal_px,
        prior=None if wire_request.prior is None else geo_prior(wire_request.prior),
        own_position=prior_from_exif(exif) if wire_request.options.exif_prior else None,
        map_ids=wire_request.options.maps,
        want_inliers=wire_request.options.inliers,
    )


def image_refused(error: ImageError) -> RequestError:
    """What the client hears of a picture that cannot be used."""
    code = ErrorCode.TOO_LARGE if error.code == "too_large" else ErrorCode.BAD_IMAGE
    return RequestError(code, f"image: {error}")


def query_camera(camera: CameraRequest, width: int, height: int) -> Camera:
    """The camera that a message speaks of, for pictures of this size.

    Raises:
        RequestError: BAD_REQUEST, it is none, of another shape, or as wide as no lens.
    """
    try:
        found = camera_of(camera)
        least_px = _LEAST_FOCAL * max(found.width, found.height)
        if found.focal_px < least_px:
            raise InvalidValueError(
                f"expected a focal length in pixels, {least_px:.0f} and more in a picture of {found.width} x "
                f"{found.height}, found {found.focal_px:g}; is it in millimetres? Pixels are these times the "
                "picture's width over the sensor's"
            )
        return found.scaled_to(width, height)
    except InvalidValueError as error:
        raise bad_request(f"camera: {error}") from error


def _camera_prior(request: CameraRequest, camera: Camera) -> QueryLensPrior | None:
    """How well the camera, scaled to the image, is known; None: exactly."""
    if request.sigmas is None:
        return None
    lengths = {"OPENCV": 4, "SIMPLE_RADIAL": 3}.get(camera.model, 0)  # in pixels, which grow with the image
    sigmas = np.array(request.sigmas)
    sigmas[:lengths] *= camera.width / request.width
    try:
        return known_within(camera, sigmas)
    except InvalidValueError as error:
        raise bad_request(f"camera.sigmas: {error}") from error


def reply_from_result(
    result: LocaliseResult, *, request_id: str, timings_ms: dict[str, float]
) -> LocaliseReply:
    """Word a result as the wire does; `timings_ms` replaces the result's own."""
    fields: dict[str, Any] = {} if result.pose is None else _pose_fields(result.pose)
    if result.in_map is not None:
        fields = {"in_map": result.in_map, "maps": (result.in_map.map_id,)}
    return LocaliseReply(
        **{name: getattr(result, name) for name in _SAME},
        exif_prior=result.own_position,
        timings_ms=timings_ms,
        request_id=request_id,
        **fields,
    )


# What a result and its reply call alike.
_SAME = (
    "status",
    "reason",
    "detail",
    "confidence",
    "features",
    "matches",
    "inliers",
    "snapshot",
    "runner_up",
)


def place_fields(pose: OnEarth) -> dict[str, Any]:
    """Position, orientation and how surely, as members of a message."""
    x, y, z, w = pose.geopose.quaternion_xyzw
    place = dict(zip(("easting", "northing", "height"), _floats(pose.utm), strict=True))
    return {
        "position": Position(
            lat=pose.geopose.latitude_deg, lon=pose.geopose.longitude_deg, h=pose.geopose.height_m
        ),
        "quaternion": Quaternion(x=x, y=y, z=z, w=w),
        "height_datum": pose.height_datum,
        "utm": UtmPose(epsg=pose.epsg, cam_from_utm_xyzw=_floats(pose.cam_from_utm_xyzw), **place),
        "covariance": tuple(_floats(row) for row in pose.covariance),
        "accuracy": Accuracy.model_validate(pose, from_attributes=True),
    }


def _pose_fields(pose: LocalisedPose) -> dict[str, Any]:
    return {
        **place_fields(pose),
        "camera": CameraUsed(**asdict(pose.camera), source=pose.camera_source),
        "view_covariance": None
        if pose.view_covariance is None
        else tuple(_floats(row) for row in pose.view_covariance),
        "residual_rms_px": pose.residual_rms_px,
        "maps": pose.map_ids,
        "lineage": pose.lineage,
        "inlier_points": pose.inliers,
    }


def _floats(values: FloatArray) -> Any:
    return tuple(values.tolist())
