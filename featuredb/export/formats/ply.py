"""PLY: the maps' points, binary, with double precision: a file for each UTM zone and height datum, in UTM,
and one for each map without a place, in its own frame.
"""

import shutil
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from featuredb.export.formats.point_files import MapList, sigma_m, zones_of
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


class _PlyFile(AbstractContextManager["_PlyFile"]):
    """A file that is being written; its header needs the number of points, which is known at the end."""

    def __init__(self, path: Path, comment: str) -> None:
        self._path, self._comment, self._count = path, comment, 0
        self._body = TemporaryFile(dir=path.parent)  # noqa: SIM115 (`__exit__` closes it)

    def write(self, xyz: FloatArray, points: PointColumns, index: int) -> None:
        """Add the points of a map, whose coordinates (n, 3) come apart."""
        rows = np.empty(len(xyz), dtype=ROW)
        rows["x"], rows["y"], rows["z"] = xyz.T
        rows["red"], rows["green"], rows["blue"] = points.rgb.T
        rows["map_index"], rows["track_length"] = index, points.track_length
        rows["error_px"], rows["sigma_m"] = points.error_px, sigma_m(points)
        self._body.write(rows.tobytes())
        self._count += len(rows)

    def __exit__(self, *failed: object) -> None:
        properties = [f"property {_TYPES[ROW[name].str]} {name}" for name in ROW.names or ()]
        head = ["ply", "format binary_little_endian 1.0", f"comment {self._comment}"]
        lines = [*head, f"element vertex {self._count}", *properties, "end_header\n"]
        with self._body as body, self._path.open("wb") as out:
            out.write("\n".join(lines).encode("ascii"))
            body.seek(0)
            shutil.copyfileobj(body, out)


def write_ply_files(job: ExportJob) -> Exported:
    """Write the points to `job.out`/epsgNNNNN_DATUM.ply, its .wkt beside it, maps.csv and attribution.csv.

    The points of a map without a place go to own_frame_MAP.ply.
    """
    placed = [m for m in job.any_summaries() if isinstance(m, MapSummary)]
    zones, maps = zones_of(placed) if placed else {}, MapList()
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        with ExitStack() as stack:
            files: dict[tuple[int, str], _PlyFile] = {}
            for feature_map in job.any_maps():
                if isinstance(feature_map, UnplacedMap):
                    _write_own(part, feature_map, maps)
                    continue
                key = feature_map.epsg, feature_map.height_datum
                index = maps.add(feature_map, f"{zones[key].name}.ply" if key in zones else "")
                if not len(feature_map.points):
                    continue
                if key not in files:
                    zone = zones[key]
                    comment = (
                        f"EPSG:{zone.epsg}: x easting, y northing; z height, {zone.height_datum}; metres"
                    )
                    files[key] = stack.enter_context(_PlyFile(part / f"{zone.name}.ply", comment))
                    (part / f"{zone.name}.wkt").write_text(zone.wkt + "\n", encoding="utf-8")
                files[key].write(feature_map.points.utm, feature_map.points, index)
        maps.write(part)
        return job.exported(part)


def _write_own(folder: Path, unplaced: UnplacedMap, maps: MapList) -> None:
    file = f"own_frame_{folder_name(unplaced.map_id)}.ply"
    index = maps.add(unplaced, file)
    if not len(unplaced.points):
        return
    up = "z up" if unplaced.frame.upright else "axes in any direction"
    unit = "metres" if unplaced.frame.metric else "units of any length, sigma_m too"
    with _PlyFile(folder / file, f"no place on Earth: own frame of the map, {up}; {unit}") as out:
        out.write(unplaced.points.xyz, unplaced.points, index)
