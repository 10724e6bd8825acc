"""Where a model in a local frame lies on Earth, as JSON that other programs, and the import, can use."""

import json
from collections import Counter
from dataclasses import asdict
from typing import Any

from featuredb.export.selection import licence_of
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import meridian_convergence_deg, point_scale, zone_of
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap

GEOREFERENCE = "georeference.json"
FORMAT = "featuredb georeference 1"

_HOW = (
    "Exactly: x_ecef = ecef_from_local (x, y, z, 1), or PROJ's utm.pipeline on x, y, z. Not by adding the "
    "origin's easting and northing: grid north differs from true north by utm.meridian_convergence_deg, and "
    "the grid's scale is utm.point_scale."
)
_HEIGHTS = (
    "Heights enter the geometry as if they were ellipsoidal, and come out of the pipeline in the map's own "
    "datum, crs.height_datum."
)


def georeference(feature_map: FeatureMap, names: list[str]) -> dict[str, Any]:
    """The place of a map's local frame, and what of the map a COLMAP model has no room for.

    Args:
        names: of the images as the model has them, in the map's order.
    """
    frame, epsg = feature_map.frame, feature_map.epsg
    easting, northing, height = frame.utm_from_enu((0.0, 0.0, 0.0), epsg)
    placement = feature_map.placement
    return {
        "format": FORMAT,
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
            "origin": [float(easting), float(northing), float(height)],
            "meridian_convergence_deg": meridian_convergence_deg(
                frame.latitude_deg, frame.longitude_deg, epsg
            ),
            "point_scale": point_scale(frame.latitude_deg, frame.longitude_deg, epsg),
            "pipeline": utm_pipeline(frame, epsg),
            "how": _HOW,
        },
        "map": _map(feature_map) | {"generation": feature_map.generation},
        "placement": {
            "method": placement.method,
            "residual_rms_m": placement.residual_rms_m,
            "covariance": placement.covariance.tolist(),
            "covariance_of": "left perturbation (log scale, rotation rad, translation m) in the local frame",
        },
        "images": _images(feature_map, names),
    }


def own_frame(unplaced: UnplacedMap, names: list[str]) -> dict[str, Any]:
    """What says of a map without a place that it has none, and what `georeference` says of its photos."""
    frame, why = unplaced.frame, unplaced.no_place
    return {
        "format": FORMAT,
        "frame": {
            "axes": "no place on Earth: "
            + ("z up, x and y anywhere" if frame.upright else "axes in any direction")
            + ("; metres" if frame.metric else "; units of any length"),
            "metric": frame.metric,
            "upright": frame.upright,
            "origin": None,
        },
        "map": _map(unplaced),
        "placement": None,
        "no_place": {"reason_code": why.reason_code, "reason": why.reason, "ways": list(why.ways)},
        "images": _images(unplaced, names),
    }


def georeference_text(feature_map: AnyMap, names: list[str]) -> str:
    """`georeference`, or `own_frame`, as the text of its file."""
    told = (
        own_frame(feature_map, names)
        if isinstance(feature_map, UnplacedMap)
        else georeference(feature_map, names)
    )
    return json.dumps(told, indent=1, allow_nan=False) + "\n"


def utm_pipeline(frame: LocalFrame, epsg: int) -> str:
    """PROJ's pipeline from the local frame's x, y, z to easting, northing, height."""
    zone, hemisphere = zone_of(epsg)
    south = " +south" if hemisphere == "south" else ""
    return (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={frame.longitude_deg!r} "
        f"+lat_0={frame.latitude_deg!r} +h_0={frame.height_m!r} +step +inv +proj=cart +ellps=WGS84 "
        f"+step +proj=utm +zone={zone}{south} +ellps=WGS84"
    )


def _map(feature_map: AnyMap) -> dict[str, Any]:
    return {
        "id": feature_map.map_id,
        "name": feature_map.name,
        "status": feature_map.status,
        "parents": list(feature_map.parents),
        "source": feature_map.source,
        "licence": feature_map.licence,
        "extractor_fingerprint": feature_map.extractor_fingerprint,
        "camera_keys": list(feature_map.camera_keys),
    }


def _images(feature_map: AnyMap, names: list[str]) -> list[dict[str, Any]]:
    seen = feature_map.observations
    described = Counter(seen.image_id[seen.has_descriptor].tolist())
    return [
        _image(image, feature_map, name, described[image.image_id])
        for image, name in zip(feature_map.images, names, strict=True)
    ]


def _image(image: MapImage, feature_map: AnyMap, name: str, descriptors: int) -> dict[str, Any]:
    return {
        "image_id": image.image_id + 1,
        "name": name,
        "original_name": image.name,
        "sha256": image.sha256,
        "owner": image.owner,
        "licence": licence_of(image, feature_map),
        "capture_time": None if image.capture_time is None else image.capture_time.isoformat(),
        "gps": None if image.gps is None else asdict(image.gps),
        "descriptors": descriptors,
    }
