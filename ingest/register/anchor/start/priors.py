"""Where the registration of a frame starts by its map's place; heights of map and scan compared."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from featuredb.errors import RegistrationError
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap
from featuredb.render.cloud import PointCloud
from ingest.register.frame_registration import FramePrior

# Scans and maps of different makers disagree by that much without anyone's fault (datum realisations, plate
# motion).
MIN_SIGMA_HORIZONTAL_M = 1.0
MIN_SIGMA_VERTICAL_M = 1.0  # after the heights of map and scan have been compared
MIN_SIGMA_ANGLE_DEG = 1.0  # bent reconstructions turn single frames by some tenths of a degree
# A map point that finds no scan point within this horizontal distance says nothing of the height; a few times
# the spacing of sparse airborne scans.
_SHIFT_REACH_M = 3.0
_MIN_SHIFT_POINTS = 30  # fewer give no height
_MAX_SHIFT_POINTS = 5000  # more only take longer


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
    step = max(1, len(points) // _MAX_SHIFT_POINTS)
    points = points[::step]
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    near = ((cloud.xyz[:, :2] >= low - _SHIFT_REACH_M) & (cloud.xyz[:, :2] <= high + _SHIFT_REACH_M)).all(
        axis=1
    )
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
    covariance = feature_map.placement.covariance
    pose = image.cam_from_local
    center = pose.center
    jacobian = point_jacobian(center)
    spread = jacobian @ covariance @ jacobian.T
    vertical = float(np.sqrt(spread[2, 2]))
    if shift is not None:
        center = center + np.array([0.0, 0.0, shift.shift_m])
        pose = Rigid3(rotation=pose.rotation, translation=-pose.rotation @ center)
        vertical = shift.sigma_m
    return FramePrior(
        cam_from_local=pose,
        sigma_horizontal_m=max(
            float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])), MIN_SIGMA_HORIZONTAL_M
        ),
        sigma_vertical_m=max(vertical, MIN_SIGMA_VERTICAL_M),
        sigma_heading_deg=max(float(np.degrees(np.sqrt(covariance[3, 3]))), MIN_SIGMA_ANGLE_DEG),
        sigma_tilt_deg=max(
            float(np.degrees(np.sqrt(max(covariance[1, 1], covariance[2, 2])))), MIN_SIGMA_ANGLE_DEG
        ),
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
