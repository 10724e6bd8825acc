"""A small made-up world: a box of points that a map has, more beyond it, and cameras that walk east."""

from typing import Any

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from ingest.growth.place.component import GrownMap
from ingest.growth.place.drift import PhotoSpread
from ingest.growth.place.placement import MapsPlacement
from ingest.growth.place.similarity_fit import Correspondences, FittedSimilarity
from tests.support.new_photos import FINGERPRINT, NewPhotos
from tests.support.scenes import (
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    box_points,
    looking_at,
    random_descriptors,
    ring,
    scene_map,
)

FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
KEY = "scene|camera"
RNG = np.random.default_rng(7)
WORLD = box_points(RNG, 600)  # 50 x 50 m, 12 m high
EAST = WORLD + np.array([38.0, 0.0, 0.0])  # beyond the map's points
POINTS = np.concatenate([WORLD, EAST])
DESCRIPTORS = random_descriptors(RNG, len(POINTS))


def walk(count: int = 6, start_m: float = 2.0, step_m: float = 6.0) -> list[Rigid3]:
    """Cameras that walk east and look at the box and beyond."""
    return [
        looking_at(np.array([start_m + step_m * k, -48.0, 30.0]), np.array([6.0 + step_m * k, 0.0, 3.0]))
        for k in range(count)
    ]


def existing(map_id: str = "old", *, sigma_m: float = 0.5) -> FeatureMap:
    placed = np.diag([1e-8, 1e-8, 1e-8, 1e-8, sigma_m**2, sigma_m**2, sigma_m**2])
    return scene_map(
        points=WORLD,
        descriptors=DESCRIPTORS[: len(WORLD)],
        poses=ring(10),
        map_id=map_id,
        camera_keys=(KEY,),
        placement_covariance=placed,
        fingerprint=FINGERPRINT,
        point_covariance=(4e-4, 0.0, 0.0, 4e-4, 0.0, 4e-4),
    )


def prior(pose: Rigid3, offset: tuple[float, float] = (0.0, 0.0), sigma_m: float = 5.0) -> GeoPrior:
    lat, lon, _ = FRAME.geodetic_from_enu(pose.center + np.array([*offset, 0.0]))
    return GeoPrior(
        latitude_deg=float(lat),
        longitude_deg=float(lon),
        height_m=None,
        sigma_horizontal_m=sigma_m,
        sigma_vertical_m=20.0,
    )


def centers_error(grown: GrownMap, new: NewPhotos) -> FloatArray:
    """(k,) metres from the true centres, of the photos of a grown map."""
    truth = np.array([new.poses[int(r)].center for r in grown.model.rows])
    to_frame = grown.feature_map.frame.enu_from(FRAME)
    return np.linalg.norm(grown.model.centers() - to_frame.act(truth), axis=1)


def grown_map(
    feature_map: FeatureMap,
    model: Any,
    *,
    covariance_relative: FloatArray | None = None,
    bending_m: float = 0.0,
    spread: PhotoSpread | None = None,
    left_out: Any = (),
) -> GrownMap:
    """A grown map of a model, without gates, overlaps or anything that its refinement knows."""
    none: Any = dict.fromkeys(Correspondences.__slots__[1:], np.zeros(0))
    return GrownMap(
        feature_map=feature_map,
        covariance_relative=np.zeros((7, 7)) if covariance_relative is None else covariance_relative,
        placement=MapsPlacement(
            frame=feature_map.frame,
            covariance=np.zeros((7, 7)),
            agreeing=(),
            left_out={},
            edges=(),
            fit=FittedSimilarity(
                local_from_sfm=Sim3.identity(),
                covariance=np.zeros((7, 7)),
                spread=1.0,
                neighbours_factor=1.0,
            ),
            held=Correspondences(map_ids=(), **none),
            residual_rms_m=0.0,
            gates=(),
        ),
        model=model,
        left_out=dict(left_out),
        spread=PhotoSpread.unknown(len(feature_map.images)) if spread is None else spread,
        bending_m=bending_m,
    )
