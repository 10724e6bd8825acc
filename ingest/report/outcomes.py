"""What happened to every file and every component, as the report's values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.utm import utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.place_bounds import PlaceBounds
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from ingest.photos.photo import Photo, shared_key
from ingest.placed_models import Component
from ingest.plot_parts import PlanView
from ingest.reconstruction import MapMakingOptions, Reconstructed, Stage
from ingest.report.values import CameraOutcome, MapOutcome, PhotoOutcome

_AS_IN_PHOTO = ("name", "width", "height", "camera_key", "capture_time", "warnings")
_NO_POSE = (
    "it has matches, but they fit no reconstruction of three photos or more: most are with photos that are "
    "left out, too, or on points that no other two see. Photos between it and the map's help"
)


def map_outcome(component: Component, created: Mapping[str, bool], options: MapMakingOptions) -> MapOutcome:
    """A component for the report.

    Args:
        created: of committed maps, whether this ingest made them visible.
    """
    control = component.control
    shared: dict[str, Any] = {
        "gates": component.placement.figures if control is None else control.evidence,
        "cameras": _cameras(component, options),
        "control": control,
    }
    made = component.made
    if made is None:
        return MapOutcome(
            map_id="",
            name=f"{len(component.photos)} photos from {component.photos[0].name}",
            status="refused",
            reason_code=component.reason_code,
            reason=component.reason,
            photos=len(component.photos),
            points=len(component.model.xyz),
            observations=len(component.model.point_of),
            track_lengths=component.model.track_lengths().astype(np.int32),
            **shared,
        )
    outcome = MapOutcome(
        map_id=made.map_id,
        name=made.name,
        status="committed" if created.get(made.map_id) else "already_there",
        photos=len(made.images),
        points=len(made.points),
        observations=len(made.observations),
        descriptors=int(made.observations.has_descriptor.sum()),
        picture_shear=float(made.provenance.get("picture_shear", 0.0)),
        errors_px=made.points.error_px,
        track_lengths=made.points.track_length,
        **shared,
    )
    if isinstance(made, UnplacedMap):
        why = made.no_place
        return replace(outcome, status="unplaced", reason_code=why.reason_code, reason=why.reason)
    centers = [image.cam_from_local.center for image in made.images]
    return replace(
        outcome,
        epsg=made.epsg,
        height_datum=made.height_datum,
        scale=made.placement.local_from_sfm.scale,
        residual_rms_m=made.placement.residual_rms_m,
        place=PlaceBounds.of(made.placement.covariance, np.median(centers, axis=0)),
        plan=_plan(component, made),
    )


def photo_outcomes(
    photos: Sequence[Photo],
    result: Reconstructed,
    registered: Mapping[str, PhotoOutcome],
    stop_after: Stage | None,
) -> tuple[PhotoOutcome, ...]:
    """Every file of the folder for the report, sorted by name.

    Args:
        registered: of the photos of all components, by name, see `registered_photos`.
    """
    return tuple(
        registered.get(photo.name) or _left_out(photo, result, stop_after)
        for photo in sorted(photos, key=lambda p: p.name)
    )


def _left_out(photo: Photo, result: Reconstructed, stop_after: Stage | None) -> PhotoOutcome:
    if photo.status != "ok":
        code, reason = photo.reason_code, photo.reason
    elif photo.name in result.unreadable:
        code, reason = "unreadable", result.unreadable[photo.name]
    elif stop_after is not None:
        code, reason = "stopped", f"the ingest stopped after {stop_after}, as asked"
    elif photo.name in result.lost:
        code, reason = "lost", result.lost[photo.name]
    elif photo.name in result.copies:
        code, reason = "copy", f"the picture of {result.copies[photo.name]}, cut, framed or marked"
    elif not result.matches_per_photo.get(photo.name):
        code, reason = "no_matches", "no other photo shows the same place"
    else:
        code, reason = "no_pose", _NO_POSE
    skipped = photo.status == "skipped" or code in ("unreadable", "copy")
    status = "skipped" if skipped else "not_registered"
    return _outcome(photo, result, status=status, code=code, reason=reason)


def registered_photos(component: Component, result: Reconstructed) -> dict[str, PhotoOutcome]:
    """The photos of one component; those of a refused one are in no map, and have its reason."""
    made = component.made
    why = {"code": component.reason_code.lower(), "reason": component.reason}
    if made is None:
        return {p.name: _outcome(p, result, status="not_registered", **why) for p in component.photos}
    counts, errors = _counts_and_errors(made)
    what = {"status": "unplaced", **why} if isinstance(made, UnplacedMap) else {"status": "registered"}
    outcomes = {
        photo.name: _outcome(
            photo,
            result,
            **what,
            observations=int(counts[k]),
            map_id=made.map_id,
            reprojection_px=float(errors[k]),
        )
        for k, photo in enumerate(component.photos)
    }
    if isinstance(made, UnplacedMap):
        return outcomes
    _, residuals = _centers_and_residuals(component, made)
    used = _gps_used(component)
    return {
        photo.name: replace(
            outcomes[photo.name],
            gps_residual_m=None if np.isnan(residuals[k, 0]) else tuple(residuals[k].tolist()),
            gps_used=used.get(k),
        )
        for k, photo in enumerate(component.photos)
    }


def _counts_and_errors(any_map: AnyMap) -> tuple[NDArray[np.int64], FloatArray]:
    """Observations of each image (k,), and the mean reprojection error of their points (k,), pixels."""
    seen, photos = any_map.observations, len(any_map.images)
    counts = np.bincount(seen.image_id, minlength=photos)
    weights = any_map.points.error_px[seen.point_index]
    errors = np.bincount(seen.image_id, weights=weights, minlength=photos) / np.maximum(counts, 1)
    return counts, errors


def _outcome(
    photo: Photo, result: Reconstructed, *, status: str, code: str = "", reason: str = "", **more: object
) -> PhotoOutcome:
    same = {name: getattr(photo, name) for name in _AS_IN_PHOTO}
    return PhotoOutcome(
        status=status,  # type: ignore[arg-type]
        reason_code=code,
        reason=reason,
        has_gps=photo.gps is not None,
        features=result.features_per_photo.get(photo.name),
        matches=result.matches_per_photo.get(photo.name),
        **same,
        **more,  # type: ignore[arg-type]
    )


def _plan(component: Component, feature_map: FeatureMap) -> PlanView:
    centers, residuals = _centers_and_residuals(component, feature_map)
    used = _gps_used(component)
    return PlanView(
        title=f"EPSG:{feature_map.epsg}",
        what="GPS",
        points=feature_map.points.utm,
        cameras=centers,
        places=centers,
        residuals=residuals,
        used=np.array([used.get(k, False) for k in range(len(component.photos))]),
        names=tuple(Path(image.name).stem for image in feature_map.images),
    )


def _centers_and_residuals(component: Component, feature_map: FeatureMap) -> tuple[FloatArray, FloatArray]:
    """UTM camera centres (k, 3), and GPS positions less them (k, 3), NaN where there is none."""
    enu = np.array([image.cam_from_local.center for image in feature_map.images])
    centers = feature_map.frame.utm_from_enu(enu, feature_map.epsg)
    gps = np.full_like(centers, np.nan)
    for k, photo in enumerate(component.photos):
        if photo.gps is not None:
            height = photo.gps.height_m
            place = (photo.gps.latitude_deg, photo.gps.longitude_deg, height or 0.0)
            gps[k] = utm_from_geodetic(place, feature_map.epsg)
            gps[k, 2] = np.nan if height is None else gps[k, 2]
    return centers, gps - centers


def _gps_used(component: Component) -> dict[int, bool]:
    """Whether a photo's GPS agrees with the others', by place in the component.

    Empty where that was not asked: control points place a map without it, and too few are not compared.
    """
    placed = component.placement
    if component.control is not None or placed.local_from_sfm is None:
        return {}
    return {k: bool(inner) for k, inner in zip(component.with_gps, placed.inliers, strict=True)}


def _cameras(component: Component, options: MapMakingOptions) -> tuple[CameraOutcome, ...]:
    outcomes = []
    for index, camera in enumerate(component.model.cameras):
        members = [
            p for p, c in zip(component.photos, component.model.camera_of, strict=True) if int(c) == index
        ]
        outcomes.append(
            CameraOutcome(
                name=shared_key(members[0], options.cameras),
                model=camera.model,
                width=camera.width,
                height=camera.height,
                photos=len(members),
                focal_before_px=members[0].focal_px,
                focal_after_px=camera.focal_px,
            )
        )
    return tuple(outcomes)
