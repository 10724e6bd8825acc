"""A map's photos as poses on Earth: position, angles, accuracy and whose they are, for formats of photos."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from featuredb.export.selection import licence_of
from featuredb.geo.datum import ellipsoidal_height
from featuredb.geo.geopose import GeoPose, geopose_from_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedPhoto:
    """One photo.

    Attributes:
        image: as the map has it; `licence` is the map's where it has none of its own.
        geopose: where it was taken; its height is in `height_datum`.
        height_datum: of `geopose`: "ellipsoidal" wherever the map's datum could be converted.
        map_height_m: in the map's own datum, `map_height_datum`.
        sigma_enu_m: (3,) standard deviation of the position along true east, north, up: what the photo
            leaves open, and the map's place on Earth.
        sigma_rotation_deg: (3,) of the rotation about the same axes.
    """

    map_id: str
    image: MapImage
    camera: Camera
    geopose: GeoPose
    height_datum: str
    map_height_m: float
    map_height_datum: str
    sigma_enu_m: FloatArray
    sigma_rotation_deg: FloatArray
    licence: str


def shots_of(feature_map: FeatureMap) -> Iterator[PosedPhoto]:
    """Every photo of the map, in its order."""
    for image in feature_map.images:
        placed = geopose_from_camera(image.cam_from_local, feature_map.frame)
        converted = ellipsoidal_height(
            placed.latitude_deg, placed.longitude_deg, placed.height_m, feature_map.height_datum
        )
        height = placed.height_m if converted.height_m is None else converted.height_m
        covariance = pose_covariance(feature_map, image)
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        yield PosedPhoto(
            map_id=feature_map.map_id,
            image=image,
            camera=feature_map.cameras[image.camera_id],
            geopose=replace(placed, height_m=height),
            height_datum=feature_map.height_datum if converted.height_m is None else "ellipsoidal",
            map_height_m=placed.height_m,
            map_height_datum=feature_map.height_datum,
            sigma_enu_m=sigmas[3:],
            sigma_rotation_deg=np.degrees(sigmas[:3]),
            licence=licence_of(image, feature_map),
        )


def altitude_of(shot: PosedPhoto) -> tuple[float, str]:
    """Altitude above sea level in metres, and what it is counted from."""
    if shot.map_height_datum != "ellipsoidal":
        return shot.map_height_m, shot.map_height_datum
    geoid = ellipsoidal_height(shot.geopose.latitude_deg, shot.geopose.longitude_deg, 0.0, "egm96")
    if geoid.height_m is None:
        return shot.map_height_m, "ellipsoidal, the grid of EGM96 is not installed"
    return shot.map_height_m - geoid.height_m, "egm96"


def pose_covariance(feature_map: FeatureMap, image: MapImage) -> FloatArray:
    """(6, 6) of a photo's pose on Earth, axes true east, north, up at the camera.

    Small rotations of the camera (rad) before displacements of its centre (m): the photo's own, relative to
    the map's points, and that of the map's placement. The two are taken for independent.
    """
    pose = image.cam_from_local
    by_placement = np.zeros((6, 7))
    by_placement[:3, 1:4] = np.eye(3)
    by_placement[3:] = point_jacobian(pose.center)
    covariance = by_placement @ feature_map.placement.covariance @ by_placement.T
    if image.covariance is not None:
        # exp(xi) @ cam_from_local turns the camera by -R' omega and moves its centre by -R' nu.
        turn = np.kron(np.eye(2), pose.rotation.T)
        covariance = covariance + turn @ image.covariance @ turn.T
    to_true = np.kron(np.eye(2), feature_map.frame.true_enu_from_enu(pose.center))
    covariance = to_true @ covariance @ to_true.T
    return np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)
