"""The formats that maps are exported to, and the export itself: what the command line and Python share."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.errors import ExportError

if TYPE_CHECKING:
    from featuredb.export.job import Exported
    from featuredb.export.selection import Selection
    from featuredb.store import Database


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One way to write maps.

    Attributes:
        write: module and function in `featuredb.export`; imported when it is wanted, so that a missing extra
            concerns nobody else. It is given an ExportJob.
        options: arguments of its own, by the parser's names, which the function is given; others refuse them.
        given: what it is given besides.
    """

    text: str
    write: str
    options: tuple[str, ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)


FORMATS: dict[str, Format] = {
    "dataset": Format(
        text="one folder to publish, GeoParquet and more, which `featuredb import` reads",
        write="dataset.write:write_dataset",
        options=("with_lidar",),
    ),
    "colmap": Format(
        text="a folder for each map, placed or not: model, database, place",
        write="formats.colmap:write_colmap",
        options=("text",),
    ),
    "las": Format(
        text="points, a LAS 1.4 file for each UTM zone and height datum",
        write="formats.las:write_las_files",
        given={"compressed": False},
    ),
    "laz": Format(
        text="the same, compressed", write="formats.las:write_las_files", given={"compressed": True}
    ),
    "ply": Format(
        text="points, a binary PLY file for each UTM zone and datum, or map without a place",
        write="formats.ply:write_ply_files",
    ),
    "geojson": Format(text="positions and angles of photos, one file", write="formats.geojson:write_geojson"),
    "kml": Format(text="photos in space for Google Earth, one file", write="formats.kml:write_kml"),
    "geopose": Format(text="OGC GeoPose, a file for each photo", write="formats.geopose:write_geopose"),
    "opensfm": Format(
        text="a folder for each map as OpenSfM and OpenDroneMap have it",
        write="formats.opensfm:write_opensfm",
    ),
    "exif": Format(
        text="copies of the photos with their pose in EXIF and XMP",
        write="formats.exif:write_exif",
        options=("photos",),
    ),
}
# Options that belong to some formats only, with what they are when they are not given.
OWN_OPTIONS: dict[str, Any] = {"text": False, "photos": None, "with_lidar": False}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedMaps:
    """What was written where, of which version of the database."""

    out: Path
    format: str
    version: int
    written: "Exported"

    def as_text(self) -> str:
        """For the terminal."""
        done = self.written
        return (
            f"{self.out}: {self.format}, {done.maps} maps, {done.images} images, {done.points} points, "
            f"{done.observations} observations, {done.bytes / 1e6:.1f} MB, of version {self.version}\n"
        )

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.as_text())}</pre>"


def export_maps(
    database: "Database",
    out: Path,
    name: str,
    selection: "Selection",
    *,
    as_of: int | datetime | None = None,
    told: Callable[[int, int], None] = lambda done, total: None,
    **options: Any,
) -> ExportedMaps:
    """Write maps for another system, whole or not at all.

    Args:
        name: of the format. told: hears of maps that are done, and their total.
        options: of OWN_OPTIONS.

    Raises:
        ExportError: an unknown format, an option of another one, nothing to export, or `out` is there.
        SnapshotNotFoundError, StoreError, MissingExtraError
    """
    from featuredb.export.job import ExportJob

    chosen = FORMATS.get(name)
    if chosen is None:
        raise ExportError(f"format: expected one of {', '.join(FORMATS)}, found {name!r}")
    if unknown := options.keys() - OWN_OPTIONS.keys():
        raise ExportError(f"export: expected options {', '.join(OWN_OPTIONS)}, found {', '.join(unknown)}")
    for option, value in options.items():
        if value != OWN_OPTIONS[option] and option not in chosen.options:
            wanted = " or ".join(n for n, entry in FORMATS.items() if option in entry.options)
            raise ExportError(
                f"--{option.replace('_', '-')}: expected --format {wanted} beside it, found {name}"
            )
    snapshot = database.snapshot(as_of)
    job = ExportJob(database=database, snapshot=snapshot, selection=selection, out=out, told=told)
    module, function = chosen.write.split(":")
    write = getattr(import_module(f"featuredb.export.{module}"), function)
    own = {option: options.get(option, OWN_OPTIONS[option]) for option in chosen.options}
    return ExportedMaps(
        out=out, format=name, version=snapshot.version, written=write(job, **chosen.given, **own)
    )
