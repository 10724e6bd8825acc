"""The truth of studies of photos with a scan: camera and poses, found by the scan alone."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from tools import scan_poses
from tools.figures import study_parser


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanTruth:
    """Cameras and poses `cam_from_local` of photos by name, in a local frame; epsg: of the scan."""

    frame: LocalFrame
    epsg: int
    cameras: dict[str, Camera]
    poses: dict[str, Rigid3]


def scan_parser(doc: str | None, *shared: str) -> argparse.ArgumentParser:
    """What studies of photos with a scan are told; arguments as those of `study_parser`."""
    parser = study_parser(doc, "--photos", "--scan", *shared)
    parser.add_argument("--poses", type=Path, required=True, metavar="JSON", help="of tools/scan_poses.py")
    return parser


def scan_truth(args: argparse.Namespace) -> ScanTruth:
    """The file of --poses, made unless it is there; `args`: of `scan_parser`."""
    if not args.poses.exists():
        scan_poses.main([str(args.scan), str(args.photos), "--poses", str(args.poses)])
    document = json.loads(args.poses.read_text(encoding="utf-8"))
    easting, northing, height = document["origin"]
    epsg = int(document["crs"].removeprefix("EPSG:"))
    cameras = {
        key: Camera(model=one["model"], width=one["width"], height=one["height"], params=tuple(one["params"]))
        for key, one in document["cameras"].items()
    }
    return ScanTruth(
        frame=LocalFrame.from_utm(easting, northing, height, epsg),
        epsg=epsg,
        cameras={name: cameras[entry["camera"]] for name, entry in document["poses"].items()},
        poses={
            name: Rigid3(
                rotation=np.array(entry["cam_from_local_rotation"]),
                translation=np.array(entry["cam_from_local_translation"]),
            )
            for name, entry in document["poses"].items()
        },
    )
