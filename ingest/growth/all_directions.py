"""A grown map's covariance on Earth as answers carry it: of one size in all directions.

How far a chain of maps may have drifted, the pose graph says well; in which direction, it does not. It finds
height and tilt the weakest, and takes what lenses turn for equal about all axes that they turn; a chain may
bend to one side by more than it says for that side, while the bound of each map, that of its worst direction,
holds (measured along a simulated walk; docs/growth.md).
"""

from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap
from ingest.growth.map_graph import at_most_places, place_sigmas_m, places_of


def with_all_directions(feature_map: FeatureMap) -> FeatureMap:
    """The map with its placement's covariance `in_all_directions`."""
    placement = feature_map.placement
    alike = in_all_directions(feature_map, placement.covariance)
    return replace(feature_map, placement=replace(placement, covariance=alike))


def in_all_directions(feature_map: FeatureMap, covariance: FloatArray) -> FloatArray:
    """(7, 7) that turns and shifts the map in all directions as much as the given one in its worst.

    About the middle of its photos; not less, anywhere that the map answers for, than the given one says for
    the worst direction there.

    Args:
        feature_map: whose places are meant.
        covariance: (7, 7) of the placement's left perturbation, in the map's frame.
    """
    middle = np.mean([image.cam_from_local.center for image in feature_map.images], axis=0)
    jacobian = point_jacobian(middle)
    shift_m2 = float(np.linalg.eigvalsh(jacobian @ covariance @ jacobian.T)[-1])
    turn = float(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1])
    about = np.vstack([np.zeros((1, 3)), np.eye(3), skew(middle)])
    grow = np.concatenate([[1.0, 0.0, 0.0, 0.0], -middle])[:, None]
    alike = covariance[0, 0] * grow @ grow.T + turn * about @ about.T
    alike += np.diag([0.0] * 4 + [shift_m2] * 3)
    places = places_of(feature_map)
    ratio = place_sigmas_m(covariance, places) / place_sigmas_m(alike, places)
    return np.asarray(max(1.0, at_most_places(ratio)) ** 2 * alike)
