"""PLY: the maps' points, binary, with double precision: a file for each UTM zone and height datum, in UTM,
and one for each map without a place, in its own frame.
"""

import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from featuredb.export.formats.point_files import MapList, Zone, sigma_m, zones_of
from featuredb.export.job import Exported, ExportJob, folder_name, whole_or_nothing
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import PointColumns
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store.snapshot import MapSummary

ROW = np.dtype(
    [
        *((name, "<f8") for name in ("x", "y", "z")),
        *((name, "u1") for name in ("red", "green", "blue")),
        ("map_index", "<u4"),
        ("track_length", "<i4"),
        ("error_px", "<f4"),
        ("sigma_m", "<f4"),
    ]
)
_TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar", "<u4": "uint", "<i4": "int"}


def write_ply_files(job: ExportJob) -> Exported:
    """Write the points to `job.out`/epsgNNNNN_DATUM.ply, its .wkt beside it, maps.csv and attribution.csv.

    The points of a map without a place go to own_frame_MAP.ply.
    """
    placed = [m for m in job.any_summaries() if isinstance(m, MapSummary)]
    zones, maps = zones_of(placed) if placed else {}, MapList()
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        counts: dict[tuple[int, str], int] = {}
        with ExitStack() as stack:
            bodies: dict[tuple[int, str], IO[bytes]] = {}
            for feature_map in job.any_maps():
                if isinstance(feature_map, UnplacedMap):
                    _write_own(part, feature_map, maps)
                    continue
                key = feature_map.epsg, feature_map.height_datum
                file = f"{zones[key].name}.ply" if key in zones else ""
                index = maps.add(feature_map, file)
                if not len(feature_map.points):
                    continue
                if key not in bodies:
                    bodies[key] = stack.enter_context(_body(part, zones[key]).open("wb"))
                counts[key] = counts.get(key, 0) + len(feature_map.points)
                bodies[key].write(_rows(feature_map.points.utm, feature_map.points, index).tobytes())
        for key, count in counts.items():
            zone = zones[key]
            comment = f"EPSG:{zone.epsg}: x easting, y northing; z height, {zone.height_datum}; metres"
            _finish(_body(part, zone), part / f"{zone.name}.ply", comment, count)
            (part / f"{zone.name}.wkt").write_text(zone.wkt + "\n", encoding="utf-8")
        maps.write(part)
        return job.exported(part)


def _body(folder: Path, zone: Zone) -> Path:
    return folder / f"{zone.name}.body"


def _write_own(folder: Path, unplaced: UnplacedMap, maps: MapList) -> None:
    file = f"own_frame_{folder_name(unplaced.map_id)}.ply"
    index = maps.add(unplaced, file)
    if not len(unplaced.points):
        return
    body = folder / f"{file}.body"
    body.write_bytes(_rows(unplaced.points.xyz, unplaced.points, index).tobytes())
    up = "z up" if unplaced.frame.upright else "axes in any direction"
    unit = "metres" if unplaced.frame.metric else "units of any length, sigma_m too"
    comment = f"no place on Earth: own frame of the map, {up}; {unit}"
    _finish(body, folder / file, comment, len(unplaced.points))


def _rows(xyz: FloatArray, points: PointColumns, index: int) -> NDArray[np.void]:
    rows = np.empty(len(xyz), dtype=ROW)
    for column, name in enumerate(("x", "y", "z")):
        rows[name] = xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = points.rgb[:, column]
    rows["map_index"], rows["track_length"] = index, points.track_length
    rows["error_px"], rows["sigma_m"] = points.error_px, sigma_m(points)
    return rows


def _finish(body: Path, out: Path, comment: str, count: int) -> None:
    """The header needs the number of points, which is known at the end: header, then body."""
    properties = [f"property {_TYPES[ROW[name].str]} {name}" for name in ROW.names or ()]
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment {comment}",
            f"element vertex {count}",
            *properties,
            "end_header\n",
        ]
    )
    with out.open("wb") as file, body.open("rb") as rows:
        file.write(header.encode("ascii"))
        shutil.copyfileobj(rows, file)
    body.unlink()
