"""A feature map moved by a similarity: points, poses and covariances, as one rigid and scaled whole."""

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_epsg
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapParts, MapPoints, Placement
from featuredb.maps.unplaced_map import UnplacedMap

_UPPER = np.triu_indices(3)  # order of MapPoints.covariance
# Fields that a map keeps where it gets a place.
_STAYING = {f.name for f in fields(MapParts)} - {"images", "points", "status", "parents"}


def move_map(feature_map: FeatureMap, move: Sim3, *, covariance: FloatArray | None = None) -> FeatureMap:
    """The map where a similarity takes it; its local frame, ids, observations and lenses stay.

    A move that is the identity, bit for bit, leaves points, poses and their covariances bit for bit.

    Args:
        move: of coordinates in the map's local frame, metres.
        covariance: (7, 7) of the new placement, left perturbation in the map's own frame; default: the old
            one, carried along.
    """
    placement = feature_map.placement
    moved = replace(
        placement,
        local_from_sfm=placement.local_from_sfm if is_identity(move) else move @ placement.local_from_sfm,
        covariance=move.carried(placement.covariance)
        if covariance is None
        else np.asarray(covariance, dtype=np.float64),
        evidence=dict(placement.evidence),
    )
    if is_identity(move):
        return replace(feature_map, placement=moved)
    points = feature_map.points
    if len(points):
        utm = feature_map.frame.utm_from_enu(move.act(feature_map.points_local()), feature_map.epsg)
        points = replace(points, utm=utm, covariance=moved_covariances(points.covariance, move))
    return replace(
        feature_map,
        images=tuple(moved_image(image, move) for image in feature_map.images),
        points=points,
        placement=moved,
    )


def placed_map(
    unplaced: UnplacedMap, placement: Placement, frame: LocalFrame, height_datum: str
) -> FeatureMap:
    """The map where `placement.local_from_sfm` takes its own frame; ids, lenses and descriptors stay.

    Args:
        placement: its similarity leads from the map's own frame to `frame`, metres.
    """
    move = placement.local_from_sfm
    epsg = utm_epsg(frame.latitude_deg, frame.longitude_deg)
    points = unplaced.points
    return FeatureMap(
        **{name: getattr(unplaced, name) for name in _STAYING},
        epsg=epsg,
        height_datum=height_datum,
        frame=frame,
        images=tuple(moved_image(image, move) for image in unplaced.images),
        points=MapPoints(
            utm=frame.utm_from_enu(move.act(points.xyz), epsg),
            rgb=points.rgb,
            track_length=points.track_length,
            error_px=points.error_px,
            covariance=moved_covariances(points.covariance, move),
        ),
        placement=placement,
    )


def is_identity(move: Sim3) -> bool:
    """Whether it is the identity bit for bit."""
    return bool(move.scale == 1.0 and np.array_equal(move.matrix(), np.eye(4)))


def in_frame(move: Sim3, frame: LocalFrame, other: LocalFrame) -> Sim3:
    """The same move of the same things, of coordinates in another local frame."""
    if frame == other or is_identity(move):
        return move
    other_from_frame = Sim3.from_rigid3(other.enu_from(frame))
    return other_from_frame @ move @ other_from_frame.inverse()


def covariance_in_frame(covariance: FloatArray, frame: LocalFrame, other: LocalFrame) -> FloatArray:
    """The covariance (7, 7) of a left perturbation, of coordinates in another local frame."""
    if frame == other:
        return np.asarray(covariance, dtype=np.float64)
    return Sim3.from_rigid3(other.enu_from(frame)).carried(covariance)


def moved_image(image: MapImage, move: Sim3) -> MapImage:
    """The camera frame grows with the map, so that a pose's shift counts in new metres: exp(omega, s nu)."""
    pose: Rigid3 = move.act_on_pose(image.cam_from_local)
    covariance = image.covariance
    if covariance is not None:
        growth = np.repeat([1.0, move.scale], 3)
        covariance = covariance * np.outer(growth, growth)
    return replace(image, cam_from_local=pose, covariance=covariance)


def moved_covariances(upper: NDArray[np.float32], move: Sim3) -> NDArray[np.float32]:
    """Upper triangles (n, 6) of points that have moved."""
    turned = move.rotation @ full_covariances(upper) @ move.rotation.T
    return (move.scale**2 * turned)[:, _UPPER[0], _UPPER[1]].astype(np.float32)


def full_covariances(upper: NDArray[np.float32]) -> FloatArray:
    """(n, 3, 3) float64 from upper triangles (n, 6) in the order of MapPoints.covariance."""
    full = np.zeros((len(upper), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = upper
    full[:, _UPPER[1], _UPPER[0]] = upper
    return full
