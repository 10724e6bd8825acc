"""Stage: a reconstruction and the photos' features become a map, with a place or without."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.adjust.terms import Block, CenterPriors
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_epsg
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.unplaced_map import NoPlace, OwnPoints, UnplacedMap
from ingest.colmap.bridge import Model
from ingest.colmap.map_errors import MapErrors, map_errors
from ingest.colmap.precision import (
    Linearised,
    linearise,
    point_covariances,
    pose_covariances,
    residual_variance,
    upper_triangle,
)
from ingest.own_frame import own_frame_of
from ingest.photos.photo import Photo, answered_positions
from ingest.positions.center_priors import center_priors
from ingest.sfm.extract import PhotoFeatures

_LOG = logging.getLogger(__name__)

_LEAST_POSITIONS = 3  # tell a similarity
_MOST_PHOTOS = 1000  # whose normal equations are inverted densely


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """What goes into the map.

    Attributes:
        min_track_length: points seen by at least that many photos carry descriptors.
        max_sigma_over_distance: points whose standard deviation exceeds this share of the distance
            to their nearest camera are dropped; they say nothing about where a camera is.
        height_datum: of the photos' heights, see featuredb.geo.datum; EXIF rarely tells.
    """

    min_track_length: int = 3
    max_sigma_over_distance: float = 0.25
    height_datum: str = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapIdentity:
    """What names a map."""

    map_id: str
    name: str
    source: str
    licence: str
    provenance: dict[str, Any]


def build_map(
    model: Model,
    placement: Placement,
    frame: LocalFrame,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapOptions,
) -> FeatureMap | None:
    """The map of one placed model; None if no point is placed well enough.

    Args:
        photos, features: of the model's registered photos, in the order of `model.rows`; features are read
            once, photo by photo.
    """
    positions = _positions(model, placement, photos, frame) if placement.method == "gps" else None
    parts = _parts(model, placement.local_from_sfm, photos, features, identity, options, positions)
    if parts is None:
        return None
    xyz, columns, shared = parts
    epsg = utm_epsg(frame.latitude_deg, frame.longitude_deg)
    return FeatureMap(
        epsg=epsg,
        height_datum=options.height_datum,
        frame=frame,
        points=MapPoints(utm=frame.utm_from_enu(xyz, epsg), **columns),
        placement=placement,
        **shared,
    )


def build_unplaced_map(
    model: Model,
    no_place: NoPlace,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapOptions,
) -> UnplacedMap | None:
    """The map of a model whose place nobody knows, in a frame of its own; arguments as in `build_map`."""
    own_from_sfm, frame = own_frame_of(model, [photo.orientation for photo in photos])
    parts = _parts(model, own_from_sfm, photos, features, identity, options)
    if parts is None:
        return None
    xyz, columns, shared = parts
    return UnplacedMap(frame=frame, points=OwnPoints(xyz=xyz, **columns), no_place=no_place, **shared)


def _parts(
    model: Model,
    frame_from_sfm: Sim3,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapOptions,
    positions: CenterPriors | None = None,
) -> tuple[FloatArray, dict[str, Any], dict[str, Any]] | None:
    """What a map has whatever is known of its place; None if no point is placed well enough.

    Returns:
        Points xyz (n, 3) in its frame, their other columns, and the fields that both kinds of map share.
    """
    used = _used_features(features, model)
    poses = [frame_from_sfm.act_on_pose(pose) for pose in model.cam_from_sfm]
    xyz = frame_from_sfm.act(model.xyz)
    xy = used.xy.astype(np.float64)
    linear = linearise(model.cameras, model.camera_of, poses, xyz, model.point_of, model.photo_of, xy)
    variance = residual_variance(linear, len(poses), len(xyz))
    covariances = point_covariances(linear, len(xyz), variance)
    errors = _errors(replace(model, cam_from_sfm=tuple(poses), xyz=xyz).block(xy), photos, model, positions)
    provenance = identity.provenance | {"residual_sigma_px": variance**0.5}
    if errors is None:
        pose_spread = pose_covariances(linear, len(poses), covariances, variance)
    else:
        pose_spread = errors.poses
        provenance |= errors.modes.as_provenance() | {"picture_shear": errors.shear.size}
        provenance |= {} if errors.lenses is None else errors.lenses.as_provenance()
    kept = _well_placed(xyz, poses, covariances, model, options)
    if not kept.any():
        return None
    shared = {
        "map_id": identity.map_id,
        "name": identity.name,
        "cameras": model.cameras,
        "camera_keys": _camera_keys(model, photos),
        "images": tuple(_images(photos, model, poses, pose_spread)),
        "observations": _observations(model, used, kept, options),
        "extractor_fingerprint": used.fingerprint,
        "source": identity.source,
        "licence": identity.licence,
        "provenance": provenance,
    }
    return xyz[kept], _point_columns(model, used.rgb, linear, covariances, kept), shared


def _positions(
    model: Model, placement: Placement, photos: Sequence[Photo], frame: LocalFrame
) -> CenterPriors | None:
    """Measured centres of the placed model; None where they do not tell a similarity."""
    rows, positions, sigmas = answered_positions(photos, frame)
    if len(rows) < _LEAST_POSITIONS:
        return None
    placed = placement.local_from_sfm.act(model.centers()[rows])
    return center_priors(rows, placed, positions, sigmas, Sim3.identity())


def _errors(
    block: Block, photos: Sequence[Photo], model: Model, positions: CenterPriors | None
) -> MapErrors | None:
    """What the map's lenses, poses and shape leave open; None of what is too large or too small."""
    if not 2 <= len(photos) <= _MOST_PHOTOS:
        return None
    focal_px = {
        int(c): photo.focal_px
        for photo, c in zip(photos, model.camera_of, strict=True)
        if photo.focal_px is not None
    }
    try:
        return map_errors(block, focal_px, positions)
    except np.linalg.LinAlgError as error:  # as of points that lie in a camera
        _LOG.warning(
            "how the map may bend is not known, so its photos' stated errors are too small: %s", error
        )
        return None


def _camera_keys(model: Model, photos: Sequence[Photo]) -> tuple[str, ...]:
    """EXIF key of each camera; "" where its photos name none, or not all the same."""
    keys: list[set[str]] = [set() for _ in model.cameras]
    for photo, camera in zip(photos, model.camera_of, strict=True):
        keys[int(camera)].add(photo.camera_key)
    return tuple(k.pop() if len(k) == 1 else "" for k in keys)


def _images(
    photos: Sequence[Photo], model: Model, poses: Sequence[Rigid3], spread: FloatArray
) -> list[MapImage]:
    return [
        MapImage(
            image_id=k,
            camera_id=int(model.camera_of[k]),
            cam_from_local=poses[k],
            covariance=spread[k],
            name=photo.name,
            sha256=photo.sha256,
            capture_time=photo.capture_time,
            gps=photo.gps,
            owner=photo.owner,
            licence=photo.licence,
        )
        for k, photo in enumerate(photos)
    ]


def _point_columns(
    model: Model, rgb: NDArray[np.uint8], linear: Linearised, covariances: FloatArray, kept: NDArray[np.bool_]
) -> dict[str, Any]:
    """Columns of PointColumns by name."""
    lengths = model.track_lengths()
    errors = np.linalg.norm(linear.residual, axis=1)
    mean_rgb = np.stack([_mean(c.astype(np.float64), model.point_of, lengths) for c in rgb.T], axis=1)
    return {
        "rgb": np.rint(mean_rgb[kept]).astype(np.uint8),
        "track_length": lengths[kept].astype(np.int32),
        "error_px": _mean(errors, model.point_of, lengths)[kept].astype(np.float32),
        "covariance": upper_triangle(covariances[kept]),
    }


def _observations(
    model: Model, used: "_Used", kept: NDArray[np.bool_], options: MapOptions
) -> MapObservations:
    rows = np.flatnonzero(kept[model.point_of])
    row_of_point = np.cumsum(kept) - 1
    long_enough = (model.track_lengths() >= options.min_track_length)[model.point_of[rows]]
    descriptors = np.zeros((len(rows), DESCRIPTOR_SIZE), np.uint8)
    descriptors[long_enough] = used.descriptors[rows[long_enough]]
    return MapObservations(
        point_index=row_of_point[model.point_of[rows]],
        image_id=model.photo_of[rows].astype(np.int32),
        xy=used.xy[rows],
        scale=used.scale[rows],
        angle=used.angle[rows],
        has_descriptor=long_enough,
        descriptors=descriptors,
    )


def _well_placed(
    enu: FloatArray, poses: Sequence[Rigid3], covariances: FloatArray, model: Model, options: MapOptions
) -> NDArray[np.bool_]:
    """Points (n,) whose standard deviation is small against their distance."""
    centers = np.array([pose.center for pose in poses])
    distances = np.linalg.norm(enu[model.point_of] - centers[model.photo_of], axis=1)
    nearest = np.full(len(enu), np.inf)
    np.minimum.at(nearest, model.point_of, distances)
    sigma = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    return np.asarray(sigma <= options.max_sigma_over_distance * nearest)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Used:
    """Features of all observations, in their order: xy (m, 2), scale (m,), angle (m,), descriptors (m, 128)
    and the colour under each (m, 3)."""

    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    rgb: NDArray[np.uint8]
    fingerprint: str


def _used_features(features: Sequence[PhotoFeatures], model: Model) -> _Used:
    """One pass through the photos, one photo's features in memory at a time."""
    count = len(model.photo_of)
    used = _Used(
        xy=np.zeros((count, 2), np.float32),
        scale=np.zeros(count, np.float32),
        angle=np.zeros(count, np.float32),
        descriptors=np.zeros((count, DESCRIPTOR_SIZE), np.uint8),
        rgb=np.zeros((count, 3), np.uint8),
        fingerprint=features[0].features.fingerprint,
    )
    order = np.argsort(model.photo_of, kind="stable")
    ends = np.cumsum(np.bincount(model.photo_of, minlength=len(features)))
    for k, rows in enumerate(np.split(order, ends[:-1])):
        photo, keypoints = features[k], model.keypoint_of[rows]
        used.rgb[rows] = photo.rgb[keypoints]
        for name in ("xy", "scale", "angle", "descriptors"):
            getattr(used, name)[rows] = getattr(photo.features, name)[keypoints]
    return used


def _mean(values: FloatArray, group: NDArray[np.int64], counts: NDArray[np.int64]) -> FloatArray:
    """Mean of values (m,) in each group."""
    return np.bincount(group, weights=values, minlength=len(counts)) / np.maximum(counts, 1)
