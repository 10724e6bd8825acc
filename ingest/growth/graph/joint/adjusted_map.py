"""A map made anew of the reconstruction in which it was adjusted with others."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap, MapImage, MapPoints
from featuredb.maps.subset import take_observations
from ingest.colmap.anchored import Anchored
from ingest.colmap.bridge import Model
from ingest.colmap.precision import linearise, point_covariances, residual_variance, upper_triangle
from ingest.growth.graph.joint.joined import JoinedMaps, MapRows, observed_pixels

JOINT = "joint"  # key of Placement.evidence


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedMap:
    """What became of one map.

    Attributes:
        held: it was not to move.
        shape_m: root mean square of what its camera centres moved against each other: what no similarity of
            the map explains. move_m: largest way of a camera centre from where the map has it.
        sigma_before_px, sigma_px: of its reprojection errors, before and after.
        kept: share of its observations that still fit.
    """

    map_id: str
    held: bool
    photos: int
    shape_m: float
    move_m: float
    sigma_before_px: float
    sigma_px: float
    kept: float

    def as_json(self) -> dict[str, Any]:
        return {key: round(v, 4) if isinstance(v, float) else v for key, v in asdict(self).items()}


def precision_of(joined: JoinedMaps, model: Model) -> tuple[FloatArray, FloatArray]:
    """Of all points of the model: covariances (n, 3, 3) in its frame, mean errors (n,) in pixels."""
    linear = linearise(
        model.cameras,
        model.camera_of,
        model.cam_from_sfm,
        model.xyz,
        model.point_of,
        model.photo_of,
        observed_pixels(joined, model),
    )
    count = len(model.xyz)
    variance = residual_variance(linear, len(model.rows), count)
    off = np.linalg.norm(linear.residual, axis=1)
    errors = np.bincount(model.point_of, weights=off, minlength=count) / np.maximum(model.track_lengths(), 1)
    return point_covariances(linear, count, variance), errors


def adjusted_map(
    feature_map: FeatureMap,
    rows: MapRows,
    result: Anchored,
    precision: tuple[FloatArray, FloatArray],
    frame: LocalFrame,
    together: Sequence[FeatureMap],
    report: AdjustedMap,
) -> FeatureMap:
    """The map with its photos, lenses and points as they are now; what no longer fits is gone."""
    model = result.model
    to_own = Sim3.from_rigid3(feature_map.frame.enu_from(frame))
    cameras = list(feature_map.cameras)
    images: list[MapImage] = []
    for image, k in zip(feature_map.images, rows.photos.tolist(), strict=True):
        cameras[image.camera_id] = model.cameras[int(model.camera_of[k])]
        images.append(replace(image, cam_from_local=to_own.act_on_pose(model.cam_from_sfm[k])))
    kept, joint_point = kept_observations(rows, result)
    seen, old = feature_map.observations, feature_map.points
    points, first, index = np.unique(seen.point_index[kept], return_index=True, return_inverse=True)
    index, joint = index.reshape(-1).astype(np.int64), joint_point[first]
    places = to_own.act(model.xyz[joint])
    move = similarity_closed_form(feature_map.points_local()[points], places) if len(points) >= 3 else None
    turned = to_own.rotation @ precision[0][joint] @ to_own.rotation.T
    placement = feature_map.placement
    told = {JOINT: {"with": sorted(m.map_id for m in together), **report.as_json()}}
    return replace(
        feature_map,
        cameras=tuple(cameras),
        images=tuple(images),
        points=MapPoints(
            utm=feature_map.frame.utm_from_enu(places, feature_map.epsg),
            rgb=old.rgb[points],
            track_length=np.bincount(index, minlength=len(points)).astype(np.int32),
            error_px=precision[1][joint].astype(np.float32),
            covariance=upper_triangle(turned),
        ),
        observations=replace(take_observations(seen, kept), point_index=index),
        placement=replace(
            placement,
            local_from_sfm=(move or Sim3.identity()) @ placement.local_from_sfm,
            evidence={**placement.evidence, **told},
        ),
    )


def kept_observations(rows: MapRows, result: Anchored) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (k,) of a map's observations that still fit, and the model's points (k,) that they see."""
    model = result.model
    now = np.stack([result.old_point[model.point_of], model.photo_of, model.keypoint_of], axis=1)
    place = {tuple(key): int(point) for key, point in zip(now.tolist(), model.point_of, strict=True)}
    asked = np.stack([rows.point_of, rows.photo_of, rows.keypoint_of], axis=1).tolist()
    found = np.array([place.get(tuple(key), -1) for key in asked], dtype=np.int64).reshape(-1)
    kept = np.flatnonzero(found >= 0)
    return kept, found[kept]
