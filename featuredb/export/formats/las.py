"""LAS and LAZ: the maps' points, a file for each UTM zone and height datum. Needs the extra `lidar`."""

from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from featuredb.export.formats.point_files import MapList, sigma_m, zones_of
from featuredb.export.job import Exported, ExportJob, whole_or_nothing
from featuredb.lidar.formats.las_stream import LasStream, offset_and_step

EXTRA: dict[str, tuple[DTypeLike, str]] = {
    "map_index": (np.uint32, "row of maps.csv"),
    "track_length": (np.uint16, "photos that see the point"),
    "error_px": (np.float32, "mean reprojection error"),
    "sigma_m": (np.float32, "std. dev. in the worst direction"),
}


def write_las_files(job: ExportJob, *, compressed: bool) -> Exported:
    """Write the points to `job.out`/epsgNNNNN_DATUM.las (or .laz), with maps.csv and attribution.csv.

    Raises:
        ExportError, MissingExtraError, InvalidValueError: maps of one zone too far apart for one file.
    """
    zones, maps = zones_of(job.summaries()), MapList()
    ending = ".laz" if compressed else ".las"
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        with ExitStack() as stack:
            streams: dict[tuple[int, str], LasStream] = {}
            for feature_map in job.maps():
                key = feature_map.epsg, feature_map.height_datum
                index = maps.add(feature_map, zones[key].name + ending if key in zones else "")
                if not len(feature_map.points):
                    continue
                if key not in streams:
                    zone = zones[key]
                    offset, step_m = offset_and_step(zone.low, zone.high)
                    stream = LasStream(
                        part / (zone.name + ending),
                        zone.wkt,
                        offset=offset,
                        step_m=step_m,
                        day=zone.day,
                        extra=EXTRA,
                    )
                    streams[key] = stack.enter_context(stream)
                points = feature_map.points
                columns: dict[str, NDArray[Any]] = {
                    "map_index": np.full(len(points), index, np.uint32),
                    "track_length": np.clip(points.track_length, 0, 65535).astype(np.uint16),
                    "error_px": points.error_px,
                    "sigma_m": sigma_m(points),
                }
                streams[key].write(points.utm, columns, points.rgb)
        maps.write(part)
        return job.exported(part)
