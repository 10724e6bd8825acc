"""Databases worth exporting: maps of several zones and datums, of every status, and of nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from featuredb.export.dataset import write_dataset
from featuredb.export.job import Exported, ExportJob
from featuredb.export.selection import Selection
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_epsg
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from tests.support.maps import random_map

EVERYTHING = Selection(statuses=("active", "quarantined", "retired"))


def map_at(seed: int, latitude: float, longitude: float, datum: str, **options: Any) -> FeatureMap:
    """A random map whose frame's origin is at a place."""
    base = random_map(seed, **options)
    epsg = utm_epsg(latitude, longitude)
    frame = LocalFrame(latitude_deg=latitude, longitude_deg=longitude, height_m=100.0)
    utm = frame.utm_from_enu(base.points_local(), epsg)
    return replace(base, epsg=epsg, height_datum=datum, frame=frame, points=replace(base.points, utm=utm))


def varied_maps() -> list[FeatureMap]:
    """Five zones, all datums, the southern hemisphere, the antimeridian, no points, no images, no GPS."""
    no_gps = map_at(6, 49.01, 8.42, "egm2008", map_id="no gps: at all?")
    return [
        map_at(1, 49.0134, 8.4044, "unknown", map_id="karlsruhe"),
        map_at(2, -33.92, 18.42, "egm96", map_id="cape-town"),
        map_at(3, 35.03, -111.02, "navd88", map_id="crater", points=300, observations=900),
        map_at(4, -17.0, 179.999, "ellipsoidal", map_id="fiji"),
        map_at(5, 49.02, 8.41, "unknown", map_id="empty", points=0, images=0),
        replace(no_gps, images=tuple(replace(i, gps=None) for i in no_gps.images), camera_keys=()),
        map_at(7, 49.01, 8.41, "unknown", map_id="poses-only", points=0),
        map_at(8, 49.01, 8.41, "unknown", map_id="child", parents=("karlsruhe",)).with_status("quarantined"),
        map_at(9, 49.01, 8.41, "unknown", map_id="grandchild", parents=("child", "karlsruhe")),
    ]


def varied_database(folder: Path) -> Database:
    """These maps, one of them in quarantine with a reason, and a retired one."""
    database = Database.create(folder)
    for feature_map in varied_maps():
        database.commit_map(feature_map)
    database.commit_map(map_at(10, 49.01, 8.41, "unknown", map_id="old"))
    database.retire("old", "a better one is there")
    database.set_status(["poses-only"], "quarantined", "one owner only")
    return database


def job_of(database: Database, out: Path, selection: Selection = EVERYTHING) -> ExportJob:
    return ExportJob(database=database, snapshot=database.snapshot(), selection=selection, out=out)


def export(
    database: Database, out: Path, selection: Selection = EVERYTHING, *, with_lidar: bool = False
) -> Exported:
    """The newest snapshot as a dataset."""
    return write_dataset(job_of(database, out, selection), with_lidar=with_lidar)


def files_of(folder: Path) -> dict[str, bytes]:
    """Everything in a folder, by path."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
