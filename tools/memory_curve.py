"""What a map's memory buys: megabytes a square kilometre against photos answered and their errors.

A map of all photos but every fifth is made, and one of all of them, whose poses of the others are the
reference. Copies of the first database are thinned (`featuredb thin --cover N`), from 800 points that each
image needs to 15, and each is asked for the held-out photos over Zenoh, with nothing but the file.

Bytes are those of what a server lays out for searching (`featuredb.index.segment`). The area is the convex
hull of the whole map's points in plan.
"""

import shutil
from dataclasses import fields

from scipy.spatial import ConvexHull

from featuredb.index.segment import Segment, segment_of
from featuredb.store import Database
from tools.commands import featuredb
from tools.figures import study_parser, write_figures
from tools.photo_files import photo_names
from tools.real_photos import ask, error_figures, ingest, reference

_EVERY = 5  # one photo in so many is held out
_COVERS = (800, 200, 50, 15)  # those that the scoreboard has


def main() -> None:
    args = study_parser(__doc__, "--photos", "--work").parse_args()
    held_out = photo_names(args.photos)[_EVERY // 2 :: _EVERY]
    ingest(args.work / "whole", args.photos, ())
    ingest(args.work / "part", args.photos, held_out)
    truth = reference(args.work / "whole")
    everything = segments(Database.open(args.work / "part"))
    km2 = sum(ConvexHull(one.points[:, :2]).volume for one in everything) / 1e6
    curve = {}
    for cover in (None, *_COVERS):
        database = args.work / f"cover-{cover}"
        shutil.copytree(args.work / "part", database)
        for map_id in active(Database.open(database)) if cover else ():
            featuredb("thin", str(database), map_id, "--cover", str(cover))
        rows = error_figures(ask(Database.open(database), args.photos, held_out, truth))
        laid_out = segments(Database.open(database))
        size = sum(getattr(one, field.name).nbytes for one in laid_out for field in fields(one))
        curve[f"cover_{cover or 'all'}"] = rows | {"megabytes_a_km2": size / 1e6 / km2}
    whole = curve["cover_all"]
    for of in curve.values():
        of["size_ratio"] = of["megabytes_a_km2"] / whole["megabytes_a_km2"]
        of["kept"] = of["answered"] / max(whole["answered"], 1)
    write_figures(args.json, curve)


def active(database: Database) -> list[str]:
    return [found.map_id for found in database.snapshot().maps() if found.status == "active"]


def segments(database: Database) -> list[Segment]:
    snapshot = database.snapshot()
    return [segment_of(snapshot.load_map(map_id)) for map_id in active(database)]


if __name__ == "__main__":
    main()
