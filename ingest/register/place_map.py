"""A map without a place comes to one: moved by a similarity, or put where one photo's pose says."""

import numpy as np

from featuredb.errors import RegistrationError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, Placement
from featuredb.maps.move import placed_map
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.anchor.proposals import small_camera
from ingest.register.frame_registration import FramePrior

_VIEW_PX = 800  # of the depth image that tells the scale
_MIN_POINTS = 20  # of the photo that must meet the scan; their median then has a fifth of its spread
_MIN_SCALE_SIGMA = 0.02  # the lens of a reconstruction is known to that, and so is its depth


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
    at_camera = Sim3(scale=1.0, rotation=np.eye(3), translation=pose.center)
    placement = Placement(
        method="lidar",
        local_from_sfm=local_from_own,
        covariance=at_camera.carried(np.diag(sigmas**2)),
        residual_rms_m=0.0,
        evidence={"start": {"image": image.name, "no_place": unplaced.no_place.reason_code}},
    )
    return placed_map(unplaced, placement, cloud.frame, cloud.height_datum)


def _depths(unplaced: UnplacedMap, image: MapImage) -> FloatArray:
    """Depth of the map's points in the photo, own units, a row for each of its observations."""
    rows = unplaced.observations.image_id == image.image_id
    points = unplaced.points.xyz[unplaced.observations.point_index[rows]]
    return np.asarray(image.cam_from_local.act(points)[:, 2])


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
