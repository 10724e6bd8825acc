"""Real photos played as a film: every frame's pose against a reconstruction of all photos.

    python -m tools.real_sequence --photos FOLDER --work DIR

1. `featuredb ingest photos` makes a map of every second photo, and in another database one of all of them.
2. All photos in the order of their names are the frames of a film, a second apart, which is tracked by the
   first map as `featuredb track` does: no lens, no positions. Consecutive photos overlap little, so that most
   frames are looked for anew.
3. Each frame's pose is compared with that of the reconstruction of all photos, laid on the first map by the
   cameras of both: a similarity, so that what GPS says of either does not count.

"""

from collections.abc import Sequence
from pathlib import Path

from featuredb.simworld.scoring import pose_difference
from featuredb.store import Database
from featuredb.video.folder import natural_key
from reloc.localiser import Localiser
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import track_video
from tools.commands import photo_names
from tools.figures import laid_on, poses_in, say, spread, study_parser, write_figures
from tools.real_photos import ingest, reference


def main() -> None:
    args = study_parser(__doc__, "--photos", "--work").parse_args()
    names = sorted(photo_names(args.photos), key=natural_key)
    work = args.work
    for name, left_out in (("part", names[1::2]), ("whole", [])):
        if not (work / name).exists():
            ingest(work / name, args.photos, left_out, "--work", str(work / "cache"))
    part, whole = reference(work / "part"), reference(work / "whole")
    theirs, mine = poses_in(part.frame, whole), poses_in(part.frame, part)
    sim = laid_on(*({name: pose.center for name, pose in of.items()} for of in (theirs, mine)))
    moved = {name: sim.act_on_pose(pose) for name, pose in theirs.items()}
    frames = film_of(args.photos, names, work / "frames")
    tracked = track_video(str(frames), MapFinder(Localiser.open(Database.open(work / "part")).areas))
    poses = {name: p.pose for name, p in zip(names, tracked.trajectory.points, strict=True) if p.pose}
    off = []
    for name, pose in poses.items():
        if name in moved:
            off.append(pose_difference(part.frame, moved[name], pose.epsg, pose.utm, pose.cam_from_utm_xyzw))
            say(f"{name}: {off[-1]}")
    figures = {
        "frames": len(names),
        "lost": len(names) - len(poses),
        "unknown": len(poses.keys() - moved.keys()),
    }
    write_figures(args.json, figures | spread([e.position_m for e in off], [e.angle_deg for e in off]))


def film_of(photos: Path, names: Sequence[str], folder: Path) -> Path:
    """A folder of links to the photos, a second from one to the next."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        link = folder / name
        if not link.is_symlink():
            link.symlink_to((photos / name).resolve())
    lines = ["file,time_s", *(f"{name},{i}" for i, name in enumerate(names))]
    (folder / "timestamps.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


if __name__ == "__main__":
    main()
