"""Where a frame starts, by its map or a rough pose (JSON), and a map without a place by one photo."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from scipy.spatial import cKDTree

from featuredb.errors import RegistrationError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, place_covariance
from featuredb.maps.feature_map import FeatureMap, MapImage, Placement
from featuredb.maps.move import placed_map
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.anchor.proposals import small_camera
from ingest.register.frame_registration import SIGMAS, FramePrior

# Scans and maps of different makers disagree by that much without anyone's fault (datum realisations, plate
# motion).
MIN_SIGMA_HORIZONTAL_M = 1.0
MIN_SIGMA_VERTICAL_M = 1.0  # after the heights of map and scan have been compared
_MIN_SIGMA_ANGLE_DEG = 1.0  # bent reconstructions turn single frames by some tenths of a degree
# A map point that finds no scan point within this horizontal distance says nothing of the height; a few times
# the spacing of sparse airborne scans.
_SHIFT_REACH_M = 3.0
_MIN_SHIFT_POINTS = 30  # fewer give no height
_MAX_SHIFT_POINTS = 5000  # more only take longer
_VIEW_PX = 800  # of the depth image that tells the scale
_MIN_POINTS = 20  # of the photo that must meet the scan; their median then has a fifth of its spread
_MIN_SCALE_SIGMA = 0.02  # the lens of a reconstruction is known to that, and so is its depth


@dataclass(frozen=True, slots=True, kw_only=True)
class HeightShift:
    """What the heights of a map lack to those of a scan.

    Attributes:
        shift_m: median of scan minus map, metres; to be added to the map's heights.
        sigma_m: robust standard deviation of one point's difference (roughness, slope times horizontal
            error, vegetation).
        points: map points that had a scan point near.
    """

    shift_m: float
    sigma_m: float
    points: int


def height_shift(feature_map: FeatureMap, cloud: PointCloud) -> HeightShift | None:
    """Compare heights where map points and scan points lie above each other; None where they hardly do.

    The surface at a place is the scan point nearest in plan. Horizontal errors of some metres only widen the
    spread of the differences where the ground is not a cliff, and the median forgives houses and trees.
    """
    points = feature_map.points_local(cloud.frame)
    points = points[:: max(1, len(points) // _MAX_SHIFT_POINTS)]
    low, high = points.min(axis=0)[:2] - _SHIFT_REACH_M, points.max(axis=0)[:2] + _SHIFT_REACH_M
    near = ((cloud.xyz[:, :2] >= low) & (cloud.xyz[:, :2] <= high)).all(axis=1)
    if not near.any():
        return None
    scan = cloud.xyz[near].astype(np.float64)
    scan = scan[:: max(1, len(scan) // 1_000_000)]  # a point in half a metre is enough for a height
    distance, nearest = cKDTree(scan[:, :2]).query(points[:, :2], distance_upper_bound=_SHIFT_REACH_M)
    found = np.isfinite(distance)
    if found.sum() < _MIN_SHIFT_POINTS:
        return None
    difference = scan[np.asarray(nearest)[found], 2] - points[found, 2]
    median = float(np.median(difference))
    return HeightShift(
        shift_m=median,
        sigma_m=float(1.4826 * np.median(np.abs(difference - median))),
        points=int(found.sum()),
    )


def prior_from_map(feature_map: FeatureMap, image: MapImage, shift: HeightShift | None) -> FramePrior:
    """The pose that the map's present placement gives, with the placement's uncertainty.

    Args:
        shift: moves the prior to the scan's heights, and takes the place of the placement's vertical sigma.
    """
    covariance, pose = feature_map.placement.covariance, image.cam_from_local
    spread = place_covariance(covariance, pose.center)
    horizontal, vertical = np.sqrt([np.linalg.eigvalsh(spread[:2, :2])[-1], spread[2, 2]]).tolist()
    if shift is not None:
        pose = Rigid3.from_center(pose.rotation, pose.center + np.array([0.0, 0.0, shift.shift_m]))
        vertical = shift.sigma_m
    tilt, heading = np.degrees(np.sqrt([max(covariance[1, 1], covariance[2, 2]), covariance[3, 3]])).tolist()
    return honest_prior(pose, horizontal, vertical, heading, tilt)


def honest_prior(
    pose: Rigid3, horizontal_m: float, vertical_m: float, heading_deg: float, tilt_deg: float
) -> FramePrior:
    """A pose with its standard deviations, none smaller than what scans and maps disagree by."""
    return FramePrior(
        cam_from_local=pose,
        sigma_horizontal_m=max(horizontal_m, MIN_SIGMA_HORIZONTAL_M),
        sigma_vertical_m=max(vertical_m, MIN_SIGMA_VERTICAL_M),
        sigma_heading_deg=max(heading_deg, _MIN_SIGMA_ANGLE_DEG),
        sigma_tilt_deg=max(tilt_deg, _MIN_SIGMA_ANGLE_DEG),
    )


def image_named(feature_map: AnyMap, name: str) -> MapImage:
    """The image of a map by its name, or by the last part of it where only one image has that.

    Raises:
        RegistrationError: none, or more than one.
    """
    exact = [image for image in feature_map.images if image.name == name]
    found = exact or [image for image in feature_map.images if image.name.rsplit("/", 1)[-1] == name]
    if len(found) != 1:
        names = ", ".join(image.name for image in (found or feature_map.images)[:6])
        what = "several images are" if found else "no image is"
        raise RegistrationError(
            f"map {feature_map.map_id}: {what} called {name!r}; "
            f"{'write its whole name' if found else 'its images'}: {names}, ..."
        )
    return found[0]


class RoughPose(BaseModel):
    """A rough pose as a person writes it for one photo.

    Attributes:
        image: the photo's name.
        easting, northing, height: of the camera, in the zone of the map (or, without one, of the scan) and
            the scan's datum.
        yaw_deg: clockwise from grid north: where the optical axis points in plan; of a camera that looks
            straight down, where the top of the photo points.
        pitch_deg: of the optical axis above the horizon; -90 looks straight down.
        roll_deg: of the camera about its optical axis, clockwise as the camera sees it.
        look_at: easting, northing, height of what the middle of the photo shows, instead of the pitch.
        sigma_horizontal_m, sigma_vertical_m, sigma_heading_deg, sigma_tilt_deg: how rough.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    image: str | None = None
    easting: FiniteFloat
    northing: FiniteFloat
    height: FiniteFloat
    yaw_deg: FiniteFloat | None = None
    pitch_deg: float | None = Field(default=None, ge=-90, le=90)
    roll_deg: FiniteFloat = 0.0
    look_at: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    sigma_horizontal_m: float = Field(default=10.0, gt=0, lt=1e4)
    sigma_vertical_m: float = Field(default=10.0, gt=0, lt=1e4)
    sigma_heading_deg: float = Field(default=10.0, gt=0, le=180)
    sigma_tilt_deg: float = Field(default=5.0, gt=0, le=90)

    @model_validator(mode="after")
    def _one_direction(self) -> "RoughPose":
        if self.look_at is None and (self.yaw_deg is None or self.pitch_deg is None):
            raise ValueError("give yaw_deg and pitch_deg, or look_at")
        if self.look_at is not None and self.pitch_deg is not None:
            raise ValueError("give pitch_deg or look_at, not both")
        if self.look_at is not None and np.linalg.norm(np.subtract(self.look_at, self.utm)) < 1e-3:
            raise ValueError("look_at is the camera's own position; give a point that it looks at")
        return self

    @property
    def utm(self) -> FloatArray:
        """(3,) easting, northing, height."""
        return np.array([self.easting, self.northing, self.height])

    def angles(self) -> tuple[float, float]:
        """Yaw and pitch in degrees, by look_at where it is given."""
        if self.look_at is None:
            assert self.yaw_deg is not None
            assert self.pitch_deg is not None
            return self.yaw_deg, self.pitch_deg
        east, north, up = np.asarray(self.look_at) - self.utm
        yaw, pitch = np.degrees([np.arctan2(east, north), np.arctan2(up, np.hypot(east, north))])
        return self.yaw_deg if self.yaw_deg is not None and pitch < -89.0 else float(yaw), float(pitch)

    def prior(self, frame: LocalFrame, epsg: int) -> FramePrior:
        """The pose, given in a UTM zone, in a local frame."""
        center = frame.enu_from_utm(self.utm, epsg)
        rotation = cam_from_enu(*self.angles(), self.roll_deg) @ frame.grid_from_enu(center, epsg)
        sigmas = {name: getattr(self, name) for name in SIGMAS}
        return FramePrior(cam_from_local=Rigid3.from_center(rotation, center), **sigmas)


def read_pose(path: Path, image: str | None) -> RoughPose:
    """A rough pose from a JSON file: easting, northing, height, and yaw_deg, pitch_deg, roll_deg or look_at.

    `yaw_deg` with `look_at` says where the top of the photo points where the camera looks straight down.

    Args:
        image: the photo, where the file names none.

    Raises:
        RegistrationError: unreadable or incomplete.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        pose = RoughPose.model_validate(document)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RegistrationError(f"pose {path}: cannot be read as JSON ({error})") from error
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, e['loc'])) or 'pose'}: {e['msg']}" for e in error.errors(include_url=False)
        )
        raise RegistrationError(
            f"pose {path}: {problems}. Expected easting, northing, height in metres, and yaw_deg, pitch_deg "
            "or look_at"
        ) from error
    name = pose.image or image
    if not name:
        raise RegistrationError(f"pose {path}: names no photo; add image, or give --image")
    return pose.model_copy(update={"image": name})


def place_by_photo(
    unplaced: UnplacedMap, image: MapImage, camera: Camera, prior: FramePrior, cloud: PointCloud
) -> FeatureMap:
    """The map put where one photo's pose on a scan says, with what that leaves open.

    The pose gives rotation and translation; the scale is how far the scan lies in the photo, over how far the
    map's points do. It is a start for registration, not a placement to be kept.

    Args:
        camera: the lens that the pose goes with. prior: pose in the cloud's local frame.

    Raises:
        RegistrationError: the photo does not see the scan from there.
    """
    pose = prior.cam_from_local
    scale, spread = _scale(unplaced, image, camera, prior, cloud)
    own = Sim3.from_rigid3(image.cam_from_local)
    cam_from_own = Sim3(scale=scale, rotation=own.rotation, translation=scale * own.translation)
    local_from_own = Sim3.from_rigid3(pose.inverse()) @ cam_from_own
    depth = scale * float(np.median(_depths(unplaced, image)))
    tilt, heading = np.radians([prior.sigma_tilt_deg, prior.sigma_heading_deg])
    sigmas = np.array(
        [
            np.hypot(max(spread, _MIN_SCALE_SIGMA), prior.sigma_vertical_m / depth),
            *(tilt, tilt, heading),
            *(prior.sigma_horizontal_m, prior.sigma_horizontal_m, prior.sigma_vertical_m),
        ]
    )
    at_camera = Sim3.shift(pose.center)
    evidence = {"start": {"image": image.name, "no_place": unplaced.no_place.reason_code}}
    return placed_on(unplaced, cloud, local_from_own, at_camera.carried(np.diag(sigmas**2)), evidence)


def placed_on(
    unplaced: UnplacedMap,
    cloud: PointCloud,
    local_from_own: Sim3,
    covariance: FloatArray,
    evidence: dict[str, Any],
    residual_rms_m: float = 0.0,
) -> FeatureMap:
    """The map where a similarity with this covariance (7, 7) puts it on a scan."""
    placement = Placement(
        method="lidar",
        local_from_sfm=local_from_own,
        covariance=covariance,
        residual_rms_m=residual_rms_m,
        evidence=evidence,
    )
    return placed_map(unplaced, placement, cloud.frame, cloud.height_datum)


def _depths(unplaced: UnplacedMap, image: MapImage) -> FloatArray:
    """Depth of the map's points in the photo, own units, a row for each of its observations."""
    return image.cam_from_local.act(unplaced.points.xyz[unplaced.points_in(image)])[:, 2]


def _scale(
    unplaced: UnplacedMap, image: MapImage, camera: Camera, prior: FramePrior, cloud: PointCloud
) -> tuple[float, float]:
    """Metres per own unit by the scan's depth at the photo's keypoints, and the relative sigma of that."""
    view = render(
        cloud, small_camera(camera, _VIEW_PX), prior.cam_from_local, RenderOptions(attributes=False)
    )
    rows = unplaced.observations.image_id == image.image_id
    size = np.array([view.camera.width, view.camera.height])
    xy = unplaced.observations.xy[rows] * (size / (camera.width, camera.height))
    at = np.clip(np.floor(xy).astype(int), 0, size - 1)
    ratio = view.depth[at[:, 1], at[:, 0]] / _depths(unplaced, image)
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    if len(ratio) < _MIN_POINTS:
        raise RegistrationError(
            f"photo {image.name}: {len(ratio)} of its map points meet the scan from this pose, at least "
            f"{_MIN_POINTS} are needed to tell the map's size; are the picks or the pose of this photo, and "
            "on this scan?"
        )
    logs = np.log(ratio)
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    return float(np.exp(middle)), spread / np.sqrt(_MIN_POINTS)
