"""Each image on Earth: its pose against grid north and against true north, and how sure it is."""

from typing import Any

import numpy as np

from featuredb.geo.geopose import geopose_from_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage


def on_earth(feature_map: FeatureMap, image: MapImage) -> dict[str, Any]:
    """Columns of the table `images` that follow from a pose and its map's frame.

    GeoPose's height is that of the local frame: in the map's datum, which stands beside it. Yaw, pitch and
    roll are GeoPose's (body axes x forward, y left, z up; yaw 0 looks east, a positive pitch looks down).
    """
    pose, frame = image.cam_from_local, feature_map.frame
    grid_from_local = frame.grid_from_enu(pose.center, feature_map.epsg)
    geopose = geopose_from_camera(pose, frame)
    yaw, pitch, roll = geopose.yaw_pitch_roll_deg
    return {
        "cam_from_utm_xyzw": [float(q) for q in quaternion_from_matrix(pose.rotation @ grid_from_local.T)],
        "latitude_deg": geopose.latitude_deg,
        "longitude_deg": geopose.longitude_deg,
        "geopose_xyzw": list(geopose.quaternion_xyzw),
        "yaw_deg": yaw,
        "pitch_deg": pitch,
        "roll_deg": roll,
        "earth_covariance": earth_covariance(feature_map, image).ravel().tolist(),
    }


def earth_covariance(feature_map: FeatureMap, image: MapImage) -> FloatArray:
    """Covariance (6, 6) of a camera on Earth: rotations (rad) about true east, north, up, then metres along
    them.

    The pose's own, where it is known, plus that of the map's placement, which all its images share.
    """
    pose, frame = image.cam_from_local, feature_map.frame
    by_placement = np.zeros((6, 7))
    by_placement[:3, 1:4] = np.eye(3)
    by_placement[3:, :] = point_jacobian(pose.center)
    covariance = by_placement @ feature_map.placement.covariance @ by_placement.T
    if image.covariance is not None:
        # exp(xi) @ cam_from_local turns the camera by -R' omega and moves its centre by -R' nu.
        turn = np.kron(np.eye(2), pose.rotation.T)
        covariance = covariance + turn @ image.covariance @ turn.T
    to_true = np.kron(np.eye(2), frame.true_enu_from_enu(pose.center))
    covariance = to_true @ covariance @ to_true.T
    return np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)
