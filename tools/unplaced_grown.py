"""A map without a place, placed by one that shows the same: how right, and is a strange one left alone?

1. Every second photo, with its GPS, is a map; the others, without any position, are one without a place, and
   so are the first ten photos of --strange, which show another town.
2. `featuredb grow` places what it can.
3. The photos of both maps of the place are compared with those of one map of all photos with their GPS, once
   it lies where the map by GPS has its own photos: what is left is what growing adds, not what GPS does not
   know.
"""

from pathlib import Path

from featuredb.store import Database
from tools.commands import featuredb
from tools.figures import laid_poses, pose_errors, poses_in, spread, study_parser, write_figures
from tools.photo_files import copied, photo_names
from tools.real_photos import ingest, reference

_STRANGE = 10


def main() -> None:
    parser = study_parser(__doc__, "--photos", "--work")
    parser.add_argument("--strange", type=Path, required=True, metavar="FOLDER", help="photos of elsewhere")
    args = parser.parse_args()
    work, names, url = args.work, photo_names(args.photos), str(args.work / "db")
    copied(args.photos, names[::2], work / "placed", strip=False)
    copied(args.photos, names[1::2], work / "loose", strip=True)
    copied(args.strange, photo_names(args.strange)[:_STRANGE], work / "strange", strip=True)
    for folder in ("placed", "loose", "strange"):
        featuredb("ingest", "photos", url, str(work / folder), "--quiet", refusals=(1,))
    featuredb("grow", url)
    ingest(work / "whole", args.photos, ())
    truth = reference(work / "whole")
    snapshot = Database.open(url).snapshot()
    maps = {m.name: snapshot.load_map(m.map_id) for m in snapshot.maps()}
    figures: dict[str, object] = {
        "photos": len(names[1::2]),
        "grown": len(maps["loose"].images) if "loose" in maps else 0,
        "strange_placed": int("strange" in maps),
    }
    poses = laid_poses(poses_in(truth.frame, truth), poses_in(truth.frame, maps["placed"]))
    for name in ("placed", "loose"):
        if name in maps:
            off = spread(*pose_errors(poses_in(truth.frame, maps[name]), poses))
            figures |= {f"{name}_{what}": value for what, value in off.items()}
    if "loose" in maps:
        figures["bound_m"] = maps["loose"].placement.evidence["growth"]["drift_m"]
    write_figures(args.json, figures)


if __name__ == "__main__":
    main()
