"""What goes into a localisation and what comes out of it."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.geopose import GeoPose, geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.feature_map import GeoPrior
from featuredb.maps.unplaced_map import OwnFrame
from reloc.localise.lens_prior import QueryLensPrior
from reloc.wire.query import (
    CameraSource,
    InlierPoints,
    InMapPose,
    Lineage,
    OwnPositionUse,
    Reason,
    RunnerUpPose,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocaliseRequest:
    """What is known of a query besides its pixels.

    Attributes:
        camera: intrinsics for the image's full size; None: see the next two.
        camera_prior: how well its intrinsics are known, which are then estimated with the pose; None:
            exactly.
        camera_is_exact: the intrinsics are the true ones, and not lent by a map: they are estimated with the
            pose within what the map's own lenses leave open, which has bent the map.
        camera_key: EXIF make/model/size/focal key (featuredb.features.exif); a map's camera with the same
            key lends its calibrated intrinsics.
        film: of a film that does not name its camera, `featuredb.features.exif.read.unnamed_model`; the
            lenses that maps have of its shots are tried.
        exif_focal_px: focal length from EXIF in pixels, a start for the estimate; None: unknown.
        prior: where the photo may have been taken; None: anywhere in the database.
        own_position: where the photo itself says so, which may be wrong: it settles what nothing else does,
            and moves no answer. Beside `prior` it does not count.
        beyond: a prior that was tried in vain; what it reaches is not tried again.
        map_ids: only these maps; None: all active ones. A map without a place is named alone; it answers in
            its own frame, and a prior does not count.
        want_inliers: the answer carries pixels and UTM points of its inliers.
    """

    camera: Camera | None = None
    camera_prior: QueryLensPrior | None = None
    camera_is_exact: bool = False
    camera_key: str | None = None
    film: str | None = None
    exif_focal_px: float | None = None
    prior: GeoPrior | None = None
    own_position: GeoPrior | None = None
    beyond: GeoPrior | None = None
    map_ids: tuple[str, ...] | None = None
    want_inliers: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnEarth:
    """What every pose on Earth has.

    Attributes:
        epsg: UTM zone of `utm`, (3,) easting, northing, height of the camera centre, metres.
        height_datum: datum of the heights, as the maps have it.
        cam_from_utm_xyzw: (4,) rotation, grid axes (east, north, up) to camera axes.
        geopose: the same as an OGC GeoPose.
        covariance: (6, 6), axes true east-north-up at the camera: small rotation of the camera about those
            axes (rad) before displacement of the camera centre (m). R_true = R(dtheta) R, C_true = C + dC.
            Measurement noise scaled by the residuals, plus the map's own uncertainty.
        horizontal_68_m, vertical_68_m, orientation_68_deg: radii that hold 68 % of the errors.
    """

    epsg: int
    utm: FloatArray
    height_datum: str
    cam_from_utm_xyzw: FloatArray
    geopose: GeoPose
    covariance: FloatArray

    def __post_init__(self) -> None:
        freeze(self, covariance=(6, 6), utm=(3,), cam_from_utm_xyzw=(4,))

    @property
    def horizontal_68_m(self) -> float:
        return error_radius(self.covariance[3:5, 3:5])

    @property
    def vertical_68_m(self) -> float:
        return error_radius(self.covariance[5:, 5:])

    @property
    def orientation_68_deg(self) -> float:
        return float(np.degrees(error_radius(self.covariance[:3, :3])))


def place_on_earth(frame: LocalFrame, cam_from_local: Rigid3, epsg: int) -> dict[str, Any]:
    """The fields of `OnEarth` that say where a camera is whose pose is known in a local frame."""
    center = cam_from_local.center
    return {
        "epsg": epsg,
        "utm": frame.utm_from_enu(center, epsg),
        "cam_from_utm_xyzw": quaternion_from_matrix(
            cam_from_local.rotation @ frame.grid_from_enu(center, epsg).T
        ),
        "geopose": geopose_from_camera(cam_from_local, frame),
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalisedPose(OnEarth):
    """The pose of a photo on Earth.

    Attributes:
        frame: local ENU frame in which the pose was computed.
        cam_from_local: pose, `frame` to camera axes (x right, y down, z forward), metres.
        view_covariance: (6 + n, 6 + n) of the pose, as in `covariance`, and the camera's n parameters, for
            what pixels show: pose and lens err together, mostly so that the map's points stay where they are
            in the picture. None where the lens is exact: then it is `covariance`.
        camera: intrinsics used, full image size.
        map_ids: maps whose points are among the inliers, most inliers first.
        lineage: for each of map_ids, what placed it; its steps, anchors, drift and budget only from a
            `Localiser`, which knows the other maps, too (featuredb.maps.lineage).
        residual_rms_px: of the inliers, in full-size pixels.
    """

    frame: LocalFrame
    cam_from_local: Rigid3
    camera: Camera
    camera_source: CameraSource
    map_ids: tuple[str, ...]
    lineage: tuple[Lineage, ...]
    residual_rms_px: float
    inliers: InlierPoints | None = None
    view_covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        OnEarth.__post_init__(self)
        if self.view_covariance is not None:
            size = 6 + len(self.camera.params)
            freeze(self, view_covariance=(size, size))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnPose:
    """A pose in the own frame of a map without a place; it says nothing of where on Earth that is.

    Attributes:
        map_id: of the map. frame: whether its unit is a metre, and whether its z is up.
        cam_from_map: pose, own frame to camera axes (x right, y down, z forward), units of the frame.
        covariance: (6, 6), axes of the own frame: small rotation of the camera about them (rad) before
            displacement of the camera centre (units of the frame).
    """

    map_id: str
    frame: OwnFrame
    cam_from_map: Rigid3
    covariance: FloatArray

    def __post_init__(self) -> None:
        freeze(self, covariance=(6, 6))


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """The figures behind a decision.

    Attributes:
        inliers: matches that agree with the pose.
        log_nfa: -log10 of the expected number of as good poses among random matches.
        coverage: share of a 10x10 grid over the image that holds inliers.
        agreement: of the parts of the image where the map should be seen, the share that holds inliers.
        spread: the same over the share that as many inliers would reach if they lay like the map's points.
    """

    inliers: int
    log_nfa: float
    coverage: float
    agreement: float
    spread: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocaliseResult:
    """The answer to one query: a pose, or a reason why there is none. Never a fallback pose.

    Attributes:
        reason: None exactly when there is a pose, on Earth or in a map.
        detail: one sentence for people.
        pose: the accepted pose on Earth, or None.
        in_map: the accepted pose in the own frame of a map without a place, which the request named, or None.
        confidence: probability that the pose is right, in [0, 1]; 0 when not localised.
        features, matches, inliers: counts: keypoints of the query, 2D-3D matches of the best cluster,
            matches that agree with the best pose (also of a rejected one: evidence).
        runner_up: the best other hypothesis, or None.
        snapshot: version of the database that answered.
        evidence: for the best pose, believed or not; None where no pose was found at all.
        timings_ms: stage name -> milliseconds, in the order they ran, and their `total`.
        own_position: what the request's own position did; None where it has none.
    """

    reason: Reason | None
    detail: str
    features: int
    matches: int
    inliers: int
    snapshot: int
    pose: LocalisedPose | None = None
    confidence: float = 0.0
    runner_up: RunnerUpPose | None = None
    evidence: Evidence | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)
    in_map: InMapPose | None = None
    own_position: OwnPositionUse | None = None

    def __post_init__(self) -> None:
        said = [value is not None for value in (self.reason, self.pose, self.in_map)]
        if sum(said) != 1:
            raise InvalidValueError(
                "LocaliseResult: expected a reason, a pose on Earth or one in a map, found none or several"
            )
        if not 0.0 <= self.confidence <= 1.0:
            raise InvalidValueError(f"LocaliseResult.confidence: expected 0..1, found {self.confidence}")

    @property
    def status(self) -> Literal["localised", "localised_in_map", "not_localised"]:
        if self.in_map is not None:
            return "localised_in_map"
        return "not_localised" if self.pose is None else "localised"
