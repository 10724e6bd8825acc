"""GeoJSON (RFC 7946): a point for every photo, with its angles, accuracy, owner and licence."""

import json
from typing import Any

from featuredb.export.job import Exported, ExportJob, whole_or_nothing
from featuredb.export.shots import PosedPhoto, shots_of


def write_geojson(job: ExportJob) -> Exported:
    """Write the photos of all selected maps to the file `job.out`, feature by feature.

    Raises:
        ExportError: nothing is selected, or there is something at `job.out`.
    """
    with whole_or_nothing(job.out) as part:
        with part.open("w", encoding="utf-8", newline="\n") as out:
            out.write('{"type": "FeatureCollection", "features": [')
            separator = "\n"
            for feature_map in job.maps():
                for shot in shots_of(feature_map):
                    out.write(separator + json.dumps(feature(shot), allow_nan=False, ensure_ascii=False))
                    separator = ",\n"
            out.write("\n]}\n")
        return job.exported(part)


def feature(shot: PosedPhoto) -> dict[str, Any]:
    """One photo.

    The third coordinate is the height above the ellipsoid, as the standard wants it, where the map's datum
    can be converted here; `height_datum` says what it is.
    """
    place = shot.geopose
    heading, pitch, roll = place.heading_pitch_roll_deg
    return {
        "type": "Feature",
        "geometry": {
            "type": "Point",
            "coordinates": [
                round(place.longitude_deg, 10),
                round(place.latitude_deg, 10),
                round(place.height_m, 4),
            ],
        },
        "properties": {
            "map_id": shot.map_id,
            "image": shot.image.name,
            "sha256": shot.image.sha256,
            "capture_time": None if shot.image.capture_time is None else shot.image.capture_time.isoformat(),
            "heading_deg": round(heading, 5),
            "pitch_deg": round(pitch, 5),
            "roll_deg": round(roll, 5),
            "sigma_enu_m": [round(float(v), 4) for v in shot.sigma_enu_m],
            "sigma_rotation_enu_deg": [round(float(v), 5) for v in shot.sigma_rotation_deg],
            "height_datum": shot.height_datum,
            "map_height_m": round(shot.map_height_m, 4),
            "map_height_datum": shot.map_height_datum,
            "owner": shot.image.owner,
            "licence": shot.licence,
        },
    }
