"""Photos of simulated towns registered to scans that have intensities alone: one by one, and together.

Of each town, on which nothing was chosen:

- ten photos from 70 m, each from a prior that is 15 m and 10 degrees off, on the town's scan; and on the scan
  of another town, from four such priors each, where none may be registered;
- a map of ten photos from 25 m, of which hardly one is registered by itself (two are tried), moved by 15 m
  and turned by 10 degrees: placed on the town's scan by all photos together, and tried on the scan of another
  town, and with mirrored photos.

What is found of a town is kept in DIR.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.move import move_map
from featuredb.render.cloud import PointCloud
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import TrueImage, WorldOptions, open_world, write_world
from ingest.register.anchor.anchor_map import place_map
from ingest.register.anchor.frames import FRAMES, try_frames
from ingest.register.anchor.start.first_place import plan_box
from ingest.register.anchor.together import register_together
from ingest.register.frame.register import register_frame
from ingest.register.frame_registration import FrameRegistration
from tools.anchor_simworld import camera_errors
from tools.commands import cloud_of, largest_map, make, once
from tools.figures import few, kept, off_pose, prior_off_by, spread, study_parser, write_figures
from tools.worlds.scan_world import ScanWorld, make_scan_world

_TOWNS = tuple(range(301, 311))
_OFF_M, _OFF_DEG = 15.0, 10.0
_RIGHT_M, _RIGHT_DEG, _WRONG_M = 0.3, 0.3, 1.0
_PHOTOS, _ALONE = 10, 2
_NEGATIVES = 40  # of each town
_LOW = FlightOptions(lines=2, per_line=5, oblique=0, width=1024, height_m=25.0)
_AXIS = 1.0 / np.sqrt(3.0)  # of a length along each axis


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    cv2.setNumThreads(1)
    towns, accepted = [], 0
    for seed in _TOWNS:
        of = (seed, args.inputs, args.work)
        towns.append(kept(args.work / f"town-{seed}.json", partial(_found, *of)))
        accepted += kept(args.work / f"elsewhere-{seed}.json", partial(_registered_elsewhere, *of))
    singles = [np.array(one) for town in towns for one in town["singles"]]
    right = sum(one[0] <= _RIGHT_M and one[1] <= _RIGHT_DEG for one in singles)
    placed = [town["own_m"] for town in towns if town["own_m"] is not None]
    write_figures(
        args.json,
        {
            "towns": len(towns),
            "tried": _PHOTOS * len(towns),
            "right_share": right / (_PHOTOS * len(towns)),
            "singles_wrong": sum(one[0] > _WRONG_M for one in singles),
            "negatives": _NEGATIVES * len(towns),
            "negatives_accepted": accepted,
            "alone": sum(town["alone"] for town in towns),
            "alone_tried": _ALONE * len(towns),
            "placed": len(placed),
            "wrong": sum(metres > _WRONG_M for metres in placed),
            **spread(placed),
            "other_placed": sum(town["other"] for town in towns),
            "mirrored_placed": sum(town["mirrored"] for town in towns),
        },
    )


def _found(seed: int, inputs: Path, work: Path) -> dict[str, Any]:
    """What is found of one town."""
    world = make_scan_world(inputs, seed)
    own = _cloud(world.scan, work)
    singles = []
    for number, image in enumerate(few(world.world.truth.group("drone"), _PHOTOS)):
        true, found = _single(world, image, own, (seed, number))
        if found.cam_from_local is not None:
            off = float(np.linalg.norm(found.cam_from_local.center - true.center))
            singles.append((off, found.cam_from_local.angle_to_deg(true)))
    return {"singles": singles} | _together(work / f"low-{seed}", world, work, seed)


def _registered_elsewhere(seed: int, inputs: Path, work: Path) -> int:
    """How many of a town's photos, each from several priors, are registered on another town's scan."""
    world = make_scan_world(inputs, seed)
    other, images = _cloud(world.other_scan, work), few(world.world.truth.group("drone"), _PHOTOS)
    drawn = (_single(world, images[k % len(images)], other, (seed, 1000, k)) for k in range(_NEGATIVES))
    return sum(found.accepted for _, found in drawn)


def _cloud(scan: Path, work: Path, *part: Any) -> PointCloud:
    """A town's scan without colours; `part`: as `cloud_of` has it."""
    return replace(cloud_of(scan, work / f"{scan.parent.name}-{scan.stem}", *part), rgb=None)


def _single(
    world: ScanWorld, image: TrueImage, cloud: PointCloud, seed: tuple[int, ...]
) -> tuple[Rigid3, FrameRegistration]:
    """The pose of a photo in a cloud, and its registration from a prior that is off."""
    true = image.cam_from_local @ cloud.frame.enu_from(world.world.truth.frame).inverse()
    start = off_pose(true, np.random.default_rng(seed), _OFF_M, _OFF_DEG)
    prior = prior_off_by(start, _OFF_M, _OFF_DEG)
    return true, register_frame(decode_gray(world.world.folder / image.name), image.camera, prior, cloud)


def _together(folder: Path, world: ScanWorld, work: Path, seed: int) -> dict[str, Any]:
    """How far off the low map's cameras are, metres, median, None without a place; what else is placed."""

    def make_map(making: Path) -> None:
        rng = np.random.default_rng(seed)
        middle = (float(rng.uniform(-60.0, 60.0)), float(rng.uniform(-50.0, 50.0)))
        none = {"queries": 0, "street": 0, "negatives_per_kind": 0}
        options = replace(WorldOptions.short(seed), flight=replace(_LOW, center_m=middle), **none)
        write_world(folder, options)
        make(making, "photos", folder / "drone")

    once(folder / "db", make_map)
    truth, made = open_world(folder).truth, largest_map(folder / "db")

    def read(image: MapImage) -> NDArray[np.uint8]:
        return decode_gray(folder / "drone" / image.name)

    def mirrored(image: MapImage) -> NDArray[np.uint8]:
        return np.ascontiguousarray(read(image)[:, ::-1])

    start = _misplaced(made, np.random.default_rng((seed, 99)))
    part = start.frame, plan_box(start)
    scans = [_cloud(scan, work, *part) for scan in (world.scan, world.other_scan)]
    alone = 0
    for image in start.images[:_ALONE]:
        prior = prior_off_by(image.cam_from_local, _OFF_M, _OFF_DEG)
        alone += register_frame(read(image), start.cameras[image.camera_id], prior, scans[0]).accepted
    tried = try_frames(start, scans[0], read, FRAMES)
    placed = place_map(start, scans[0], tried, read, FRAMES).feature_map
    return {
        "alone": alone,
        "own_m": None if placed is None else float(np.median(camera_errors(placed, truth)[0])),
        "other": register_together(start, start.images, scans[1], read, 1) is not None,
        "mirrored": register_together(start, start.images, scans[0], mirrored, 1) is not None,
    }


def _misplaced(feature_map: FeatureMap, rng: np.random.Generator) -> FeatureMap:
    """The map moved, turned about its middle, with a placement that says how far."""
    middle = np.mean([image.cam_from_local.center for image in feature_map.images], axis=0)
    move = Sim3.from_rigid3(off_pose(Rigid3.identity(), rng, _OFF_M, _OFF_DEG)).about(middle)
    sigmas = [0.01, *[np.radians(_OFF_DEG) * _AXIS] * 3, *[_OFF_M * _AXIS] * 3]
    covariance = Sim3.shift(move.act(middle)).carried(np.diag(np.square(sigmas)))
    return move_map(feature_map, move, covariance=covariance)


if __name__ == "__main__":
    main()
