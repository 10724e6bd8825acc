"""Where a model in a local frame lies on Earth, as JSON that other programs, and the import, can use."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from featuredb.export.job import write_json
from featuredb.export.selection import licence_of
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import meridian_convergence_deg, point_scale, zone_of
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap

GEOREFERENCE = "georeference.json"
FORMAT = "featuredb georeference 1"
_OF_MAP = ("name", "status", "parents", "source", "licence", "extractor_fingerprint", "camera_keys")

_HOW = (
    "Exactly: x_ecef = ecef_from_local (x, y, z, 1), or PROJ's utm.pipeline on x, y, z. Not by adding the "
    "origin's easting and northing: grid north differs from true north by utm.meridian_convergence_deg, and "
    "the grid's scale is utm.point_scale."
)
_HEIGHTS = (
    "Heights enter the geometry as if they were ellipsoidal, and come out of the pipeline in the map's own "
    "datum, crs.height_datum."
)


def write_georeference(folder: Path, feature_map: AnyMap, names: list[str]) -> None:
    """Write the place of a map's local frame, or that it has none, and what a COLMAP model has no room for.

    Args:
        names: of the images as the model has them, in the map's order.
    """
    of_map = {"id": feature_map.map_id, **{name: getattr(feature_map, name) for name in _OF_MAP}}
    if isinstance(feature_map, UnplacedMap):
        place = _own_frame(feature_map)
    else:
        place, of_map["generation"] = _on_earth(feature_map), feature_map.generation
    seen = feature_map.observations
    described = Counter(seen.image_id[seen.has_descriptor].tolist())
    images = [
        {
            "image_id": image.image_id + 1,
            "name": name,
            "original_name": image.name,
            "sha256": image.sha256,
            "owner": image.owner,
            "licence": licence_of(image, feature_map),
            "capture_time": None if image.capture_time is None else image.capture_time.isoformat(),
            "gps": None if image.gps is None else asdict(image.gps),
            "descriptors": described[image.image_id],
        }
        for image, name in zip(feature_map.images, names, strict=True)
    ]
    write_json(folder / GEOREFERENCE, {"format": FORMAT, **place, "map": of_map, "images": images})


def _on_earth(feature_map: FeatureMap) -> dict[str, Any]:
    frame, epsg = feature_map.frame, feature_map.epsg
    placement = feature_map.placement
    return {
        "frame": {
            "axes": "x east, y north, z up at the origin; metres",
            "origin": asdict(frame),
            "ecef_from_local": frame.ecef_from_enu().matrix().tolist(),
        },
        "crs": {
            "geodetic_datum": "WGS84",
            "ecef": "EPSG:4978",
            "utm": f"EPSG:{epsg}",
            "height_datum": feature_map.height_datum,
            "heights": _HEIGHTS,
        },
        "utm": {
            "epsg": epsg,
            "origin": frame.utm_from_enu((0.0, 0.0, 0.0), epsg).tolist(),
            "meridian_convergence_deg": meridian_convergence_deg(
                frame.latitude_deg, frame.longitude_deg, epsg
            ),
            "point_scale": point_scale(frame.latitude_deg, frame.longitude_deg, epsg),
            "pipeline": utm_pipeline(frame, epsg),
            "how": _HOW,
        },
        "placement": {
            "method": placement.method,
            "residual_rms_m": placement.residual_rms_m,
            "covariance": placement.covariance.tolist(),
            "covariance_of": "left perturbation (log scale, rotation rad, translation m) in the local frame",
        },
    }


def _own_frame(unplaced: UnplacedMap) -> dict[str, Any]:
    frame, why = unplaced.frame, unplaced.no_place
    axes = "z up, x and y anywhere" if frame.upright else "axes in any direction"
    unit = "metres" if frame.metric else "units of any length"
    return {
        "frame": {"axes": f"no place on Earth: {axes}; {unit}", **asdict(frame), "origin": None},
        "placement": None,
        "no_place": {"reason_code": why.reason_code, "reason": why.reason, "ways": why.ways},
    }


def utm_pipeline(frame: LocalFrame, epsg: int) -> str:
    """PROJ's pipeline from the local frame's x, y, z to easting, northing, height."""
    zone, hemisphere = zone_of(epsg)
    south = " +south" if hemisphere == "south" else ""
    return (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={frame.longitude_deg!r} "
        f"+lat_0={frame.latitude_deg!r} +h_0={frame.height_m!r} +step +inv +proj=cart +ellps=WGS84 "
        f"+step +proj=utm +zone={zone}{south} +ellps=WGS84"
    )
