"""The part of a report that is read off a finished feature map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from featuredb.geo.utm import meridian_convergence_deg, utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.photo import Photo
from ingest.report import CameraOutcome, MapOutcome, MapOutcomeStatus, PhotoOutcome, PlanView


def outcome_of_map(
    feature_map: FeatureMap,
    photos: Mapping[str, Photo],
    *,
    status: MapOutcomeStatus = "committed",
    gps_outliers: frozenset[str] = frozenset(),
) -> MapOutcome:
    """Summary and plan view of a map.

    Args:
        photos: the scanned photos by name, for their focal lengths in EXIF.
        gps_outliers: names of photos whose GPS was not used.
    """
    points, observations = feature_map.points, feature_map.observations
    return MapOutcome(
        map_id=feature_map.map_id,
        name=feature_map.name,
        status=status,
        photos=len(feature_map.images),
        points=len(points),
        observations=len(observations),
        descriptors=int(observations.has_descriptor.sum()),
        epsg=feature_map.epsg,
        height_datum=feature_map.height_datum,
        scale=feature_map.placement.local_from_sfm.scale,
        residual_rms_m=feature_map.placement.residual_rms_m,
        gates=feature_map.placement.evidence,
        cameras=_cameras(feature_map, photos),
        errors_px=points.error_px,
        track_lengths=points.track_length,
        plan=_plan(feature_map, gps_outliers),
    )


def registered_photos(
    feature_map: FeatureMap,
    photos: Mapping[str, Photo],
    *,
    features: Mapping[str, int],
    matches: Mapping[str, int],
    gps_outliers: frozenset[str] = frozenset(),
) -> tuple[PhotoOutcome, ...]:
    """What became of the photos of a map, in the map's order."""
    plan = _plan(feature_map, gps_outliers)
    residuals = plan.gps - plan.cameras
    points_local = feature_map.points_local()
    outcomes = []
    for image, residual in zip(feature_map.images, residuals, strict=True):
        errors = _reprojection_px(feature_map, image, points_local)
        has_gps = image.gps is not None
        outcomes.append(
            photo_outcome(
                photos[image.name],
                status="registered",
                features=features.get(image.name),
                matches=matches.get(image.name),
                observations=len(errors),
                map_id=feature_map.map_id,
                reprojection_px=float(errors.mean()) if len(errors) else None,
                gps_residual_m=tuple(map(float, residual)) if np.isfinite(residual[:2]).all() else None,
                gps_used=image.name not in gps_outliers if has_gps else None,
            )
        )
    return tuple(outcomes)


def photo_outcome(photo: Photo, **what: Any) -> PhotoOutcome:
    """Outcome of a scanned photo; without more it is that of the scan: skipped, or not yet registered."""
    what.setdefault("status", "skipped" if photo.status == "skipped" else "not_registered")
    what.setdefault("reason_code", photo.reason_code)
    what.setdefault("reason", photo.reason)
    return PhotoOutcome(
        name=photo.name,
        width=photo.width,
        height=photo.height,
        camera_key=photo.camera_key,
        capture_time=photo.capture_time,
        has_gps=photo.gps is not None,
        warnings=photo.warnings,
        **what,
    )


def _reprojection_px(feature_map: FeatureMap, image: MapImage, points_local: FloatArray) -> FloatArray:
    """Distances (m,) in pixels between an image's observations and the projections of their points."""
    rows = feature_map.observations.image_id == image.image_id
    points = points_local[feature_map.observations.point_index[rows]]
    pixels = feature_map.cameras[image.camera_id].project(image.cam_from_local.act(points))
    return np.asarray(np.linalg.norm(pixels - feature_map.observations.xy[rows], axis=1), dtype=np.float64)


def _cameras(feature_map: FeatureMap, photos: Mapping[str, Photo]) -> tuple[CameraOutcome, ...]:
    outcomes = []
    for number, camera in enumerate(feature_map.cameras):
        mine: Sequence[str] = [i.name for i in feature_map.images if i.camera_id == number]
        if not mine:
            continue
        first = photos[mine[0]]
        outcomes.append(
            CameraOutcome(
                name=first.camera_key or mine[0],
                model=camera.model,
                width=camera.width,
                height=camera.height,
                photos=len(mine),
                focal_before_px=first.focal_px,
                focal_after_px=camera.focal_px,
            )
        )
    return tuple(outcomes)


def _plan(feature_map: FeatureMap, gps_outliers: frozenset[str]) -> PlanView:
    frame, epsg = feature_map.frame, feature_map.epsg
    centers = np.array([image.cam_from_local.center for image in feature_map.images]).reshape(-1, 3)
    return PlanView(
        points=feature_map.points.utm,
        cameras=frame.utm_from_enu(centers, epsg),
        gps=_gps_utm(feature_map),
        names=tuple(image.name for image in feature_map.images),
        gps_used=np.array([image.name not in gps_outliers for image in feature_map.images], dtype=bool),
        convergence_deg=meridian_convergence_deg(frame.latitude_deg, frame.longitude_deg, epsg),
        epsg=epsg,
    )


def _gps_utm(feature_map: FeatureMap) -> FloatArray:
    """GPS positions (k, 3) in UTM; NaN where there is none, NaN height where only that is missing."""
    gps = np.full((len(feature_map.images), 3), np.nan)
    for row, image in enumerate(feature_map.images):
        if image.gps is not None:
            height = image.gps.height_m
            position = (image.gps.latitude_deg, image.gps.longitude_deg, height or 0.0)
            gps[row] = utm_from_geodetic(position, feature_map.epsg)
            gps[row, 2] = np.nan if height is None else height
    return gps
