"""Real photos end to end: some are held out, localised over Zenoh, and compared with a map of all photos.

1. `featuredb ingest photos` takes all photos but the held-out ones, in a process and a database of its own.
2. The same takes all photos, into another database: what its map says of the held-out ones is the reference.
   Both maps are placed by the photos' GPS, so the differences hold the placements' as well.
3. A server answers from the first database; each held-out photo is asked for as `featuredb query` does, with
   nothing but the file: no camera, no prior.

With --as-film the first map is of every second photo. All photos in the order of their names are the frames
of a film, a second apart, which is tracked by that map as `featuredb track` does: no lens, no positions.
Consecutive photos overlap little, so that most frames are looked for anew. Each frame's pose is compared with
that of the map of all photos, laid on the first one by the cameras of both: a similarity, so that what GPS
says of either does not count.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.scoring import PoseError, pose_difference
from featuredb.store import Database
from featuredb.video.folder import natural_key
from reloc.client import Client, LocaliseReply
from reloc.localise.result import error_radius
from reloc.localiser import Localiser
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import track_video
from reloc.wire.query import CameraRequest
from tools.commands import make
from tools.figures import laid_poses, poses_in, say, spread, study_parser, write_figures
from tools.photo_files import copied, photo_names

_EVERY = 5  # without --held-out, one photo in so many is held out


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutRow:
    """One held-out photo: the answer against the reference, and the 68 % radii that it states."""

    name: str
    reason: str
    error: PoseError | None
    position_68_m: float
    orientation_68_deg: float


def main() -> None:
    parser = study_parser(__doc__, "--photos", "--work")
    parser.add_argument("--held-out", nargs="+", metavar="NAME", help=f"default: every {_EVERY}th photo")
    parser.add_argument("--as-film", action="store_true", help="track all photos by every second one")
    args = parser.parse_args()
    names = sorted(photo_names(args.photos), key=natural_key if args.as_film else None)
    held_out = names[1::2] if args.as_film else args.held_out or names[_EVERY // 2 :: _EVERY]
    more = ("--work", str(args.work / "cache"))
    made = ingest(args.work / "part", args.photos, held_out, *more)
    ingest(args.work / "whole", args.photos, (), *more)
    truth = reference(args.work / "whole")
    if args.as_film:
        write_figures(args.json, as_film(args.photos, names, args.work, truth))
        return
    rows = ask(Database.open(args.work / "part"), args.photos, held_out, truth)
    figures = {"registered": made["mapped"], "ingest_s": made["seconds"]}
    write_figures(args.json, figures | {"usable": len(set(names) - set(held_out))} | error_figures(rows))


def as_film(photos: Path, names: Sequence[str], work: Path, whole: FeatureMap) -> dict[str, float]:
    """All photos tracked by the map in `work`/part, against the map of all."""
    part = reference(work / "part")
    moved = laid_poses(poses_in(part.frame, whole), poses_in(part.frame, part))
    frames = copied(photos, names, work / "frames", strip=False)
    lines = ["file,time_s", *(f"{name},{i}" for i, name in enumerate(names))]
    (frames / "timestamps.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    tracked = track_video(str(frames), MapFinder(Localiser.open(Database.open(work / "part")).areas))
    poses = {name: p.pose for name, p in zip(names, tracked.trajectory.points, strict=True) if p.pose}
    off = []
    for name, pose in poses.items():
        if name in moved:
            off.append(pose_difference(part.frame, moved[name], pose.epsg, pose.utm, pose.cam_from_utm_xyzw))
            say(f"{name}: {off[-1]}")
    unknown, lost = len(poses.keys() - moved.keys()), len(names) - len(poses)
    return {"frames": len(names), "lost": lost, "unknown": unknown, **spread_of(off)}


def ingest(database: Path, photos: Path, exclude: Sequence[str], *more: str) -> dict[str, float]:
    """Make a database that is not there yet of all photos but some, as `make` does."""
    if database.exists():
        raise SystemExit(f"{database} is there already; a map is made from nothing there")
    return make(database, "photos", photos, (*(f"--exclude={name}" for name in exclude), *more))


def reference(database: Path) -> FeatureMap:
    """The active map with most images."""
    snapshot = Database.open(database).snapshot()
    maps = [m for m in snapshot.maps() if m.status == "active"]
    return snapshot.load_map(max(maps, key=lambda m: m.images).map_id)


def ask(database: Database, photos: Path, names: Sequence[str], truth: FeatureMap) -> list[HeldOutRow]:
    """Localise the photos over Zenoh and compare with their poses in the reference map, if it has them."""
    poses = {image.name: image.cam_from_local for image in truth.images}
    return ask_poses(database, photos, [name for name in names if name in poses], truth.frame, poses)


def ask_poses(
    database: Database,
    photos: Path,
    names: Sequence[str],
    frame: LocalFrame,
    poses: Mapping[str, Rigid3],
    camera: CameraRequest | None = None,
) -> list[HeldOutRow]:
    """Localise the photos over Zenoh, each sent with `camera`, and compare with poses `cam_from_local` in a
    frame."""
    rows, options = [], ServeOptions(listen=("tcp/127.0.0.1:0",))
    with start_server(database, options) as server, Client(server.endpoints[0]) as client:
        for name in names:
            reply = client.localise(photos / name, camera=camera, timeout_s=60.0)
            rows.append(_row(name, reply, frame, poses[name]))
            say(f"{rows[-1]}")
    return rows


def _row(name: str, reply: LocaliseReply, frame: LocalFrame, pose: Rigid3) -> HeldOutRow:
    error, nan = None, float("nan")
    if (at := reply.utm) is not None:
        utm = (at.easting, at.northing, at.height)
        error = pose_difference(frame, pose, at.epsg, utm, at.cam_from_utm_xyzw)
    return HeldOutRow(
        name=name,
        reason=reply.reason or "",
        error=error,
        position_68_m=nan if reply.covariance is None else error_radius(np.array(reply.covariance)[3:, 3:]),
        orientation_68_deg=reply.accuracy.orientation_68_deg if reply.accuracy else nan,
    )


def error_figures(rows: Sequence[HeldOutRow]) -> dict[str, float]:
    """How many photos were answered, and the errors of the answers."""
    errors = [row.error for row in rows if row.error is not None]
    return {"asked": len(rows), "answered": len(errors), **spread_of(errors)}


def spread_of(errors: Sequence[PoseError]) -> dict[str, float]:
    """Medians and largest of errors."""
    return spread([e.position_m for e in errors], [e.angle_deg for e in errors])


if __name__ == "__main__":
    main()
