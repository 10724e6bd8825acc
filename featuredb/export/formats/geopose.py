"""OGC GeoPose 1.0 (21-056r11): every photo as Basic-YPR, every map as an Irregular Series.

The body is the camera with axes x forward, y left, z up. Heights are above the ellipsoid, as the standard
wants, where the map's datum can be converted here; `manifest.json` says of each map what its heights are.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from featuredb.export.job import Exported, ExportJob, folder_for_each, folder_name, write_json
from featuredb.export.shots import PosedPhoto, shots_of
from featuredb.geo.geopose import basic_ypr, irregular_series
from featuredb.maps.feature_map import FeatureMap

BASIC, SERIES, MANIFEST = "basic_ypr", "series.json", "manifest.json"


def write_geopose(job: ExportJob) -> Exported:
    """Write `job.out`/<map>/basic_ypr/<photo>.json for every photo, and series.json of those whose time is
    known.
    """
    return folder_for_each(job, job.maps(), _write_map)


def _write_map(folder: Path, feature_map: FeatureMap) -> None:
    shots = list(shots_of(feature_map))
    names = _file_names(shots)
    for shot, name in zip(shots, names, strict=True):
        write_json(folder / BASIC / name, basic_ypr(shot.geopose))
    times = ((shot.image.capture_time, shot) for shot in shots)
    # Of photos that say in which time zone they were taken.
    timed = [(round(1000.0 * time.timestamp()), shot) for time, shot in times if time and time.tzinfo]
    if timed:
        timed.sort(key=lambda row: (row[0], row[1].image.image_id))
        write_json(folder / SERIES, irregular_series([(unix_ms, shot.geopose) for unix_ms, shot in timed]))
    manifest = {
        "map_id": feature_map.map_id,
        "height_datum": shots[0].height_datum if shots else feature_map.height_datum,
        "body_axes": "x forward, y left, z up",
        "photos": [
            {"file": name, "image": shot.image.name, "sha256": shot.image.sha256, "owner": shot.image.owner}
            | {"licence": shot.licence, "sigma_enu_m": [round(float(v), 4) for v in shot.sigma_enu_m]}
            | {"sigma_rotation_enu_deg": [round(float(v), 5) for v in shot.sigma_rotation_deg]}
            for shot, name in zip(shots, names, strict=True)
        ],
    }
    write_json(folder / MANIFEST, manifest)


def _file_names(shots: Sequence[PosedPhoto]) -> list[str]:
    counts = Counter(shot.image.name for shot in shots)
    return [
        folder_name(
            shot.image.name if counts[shot.image.name] == 1 else f"{shot.image.image_id}_{shot.image.name}"
        )
        + ".json"
        for shot in shots
    ]
