"""A map without a place, placed by one that shows the same: how right, and is a strange one left alone?

    python -m tools.unplaced_grown --photos FOLDER --scan LAZ --poses poses.json --work DIR [--strange FOLDER]

1. Every second photo, with its GPS, is a map; the others, without any position, are one without a place, and
   so are the first ten photos of --strange, which show another town.
2. `featuredb grow` places what it can.
3. The photos of both maps of the place are compared with the poses of tools/scan_poses.py, once these lie
   where the map by GPS has its own photos: what is left is what growing adds, not what GPS does not know.

"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from tools import scan_poses
from tools.anchor_brighton import read_poses
from tools.anchor_simworld import featuredb
from tools.figures import study_parser, write_figures
from tools.made_maps import copied, photo_names

_STRANGE = 10


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    if not args.poses.exists():
        scan_poses.main([str(args.scan), str(args.photos), "--poses", str(args.poses)])
    frame, poses = read_poses(args.poses)
    names, url = photo_names(args.photos), str(args.work / "db")
    copied(args.photos, names[::2], args.work / "placed", strip=False)
    copied(args.photos, names[1::2], args.work / "loose", strip=True)
    folders = ["placed", "loose"]
    if args.strange is not None:
        copied(args.strange, photo_names(args.strange)[:_STRANGE], args.work / "strange", strip=True)
        folders.append("strange")
    for folder in folders:
        featuredb("ingest", "photos", url, str(args.work / folder), "--quiet", may_refuse=True)
    featuredb("grow", url)
    snapshot = Database.open(url).snapshot()
    maps = {m.name: snapshot.load_map(m.map_id) for m in snapshot.maps()}
    figures: dict[str, object] = {
        "photos": len(names[1::2]),
        "grown": len(maps["loose"].images) if "loose" in maps else 0,
        "strange_placed": int("strange" in maps),
    }
    move = placed_like(maps["placed"], frame, poses)
    for name in ("placed", "loose"):
        if name in maps:
            figures |= {f"{name}_{what}": v for what, v in errors(maps[name], frame, poses, move).items()}
    if "loose" in maps:
        figures["bound_m"] = maps["loose"].placement.evidence["growth"]["drift_m"]
    write_figures(args.json, figures)
    return 0


def placed_like(feature_map: FeatureMap, frame: LocalFrame, poses: Mapping[str, Rigid3]) -> Sim3:
    """The similarity that lays the true poses where a map has the photos, turned as orientations say."""
    mine = _poses(feature_map, frame)
    shared = [name for name in mine if name in poses]
    turn = Rotation.from_matrix([mine[n].rotation.T @ poses[n].rotation for n in shared]).mean().as_matrix()
    true = np.array([turn @ poses[n].center for n in shared])
    there = np.array([mine[n].center for n in shared])
    a, b = true - true.mean(axis=0), there - there.mean(axis=0)
    scale = float((a * b).sum() / (a * a).sum())
    return Sim3(scale=scale, rotation=turn, translation=there.mean(axis=0) - scale * true.mean(axis=0))


def errors(
    feature_map: FeatureMap, frame: LocalFrame, poses: Mapping[str, Rigid3], move: Sim3
) -> dict[str, float]:
    """Of the photos' centres (metres) and orientations (degrees) from the moved true poses."""
    metres: list[float] = []
    degrees: list[float] = []
    for name, pose in _poses(feature_map, frame).items():
        if name in poses:
            true = move.act_on_pose(poses[name])
            metres.append(float(np.linalg.norm(true.center - pose.center)))
            between: FloatArray = pose.rotation @ true.rotation.T
            degrees.append(float(np.degrees(Rotation.from_matrix(between).magnitude())))
    return {
        "median_m": float(np.median(metres)),
        "largest_m": max(metres),
        "median_deg": float(np.median(degrees)),
    }


def _poses(feature_map: FeatureMap, frame: LocalFrame) -> dict[str, Rigid3]:
    there = Sim3.from_rigid3(frame.enu_from(feature_map.frame))
    return {image.name: there.act_on_pose(image.cam_from_local) for image in feature_map.images}


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__)
    parser.add_argument("--photos", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--scan", type=Path, required=True, metavar="LAZ")
    parser.add_argument("--poses", type=Path, required=True, metavar="JSON", help="of tools/scan_poses.py")
    parser.add_argument("--strange", type=Path, default=None, metavar="FOLDER", help="photos of elsewhere")
    parser.add_argument("--work", type=Path, required=True, help="copies and database are kept there")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
