"""Do street photos find an anchored drone map? By its points, its scan, and street views drawn of both.

    python -m tools.street_views --world WORLD --db DB --scan SCAN_DB [--near 25] [--frames 5] [--out DIR]

WORLD is a simulated world, DB the database of its drone photos, SCAN_DB one with its scan (`featuredb lidar
add`). Every street photo is asked

- of the drone map, as it is, with nothing but the file;
- of the map of street views (`ingest.street`) alone, so too, and again with its true lens;

and so is every drone photo of another town and every mirrored one. The first `--frames` photos are also
registered to the scan directly (`ingest.register.frame`), from a prior that is wrong by 30 m (one standard
deviation), with unknown heading.

`--near` draws places within so many metres of a street photo only, to save time: places farther away show
other streets. The map is kept in DIR and used again. Writes street_views.jpg: photos beside what is drawn at
their true poses.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray, decode_rgb
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.lidar.load import load_cloud
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from featuredb.simworld.scoring import PoseError, pose_error, summarise
from featuredb.simworld.shot import look_pose
from featuredb.simworld.truth import TrueImage
from featuredb.simworld.world import World, open_world
from featuredb.store import Database
from ingest.register.frame.options import FrameOptions
from ingest.register.frame.register import register_frame
from ingest.register.frame_registration import FramePrior
from ingest.street.stand import standing_places
from ingest.street.street_map import StreetOptions, street_map_at
from ingest.street.synthesis import source_photo, surfaces_of_scan, synthesise
from reloc.candidates import IndexedArea
from reloc.localise import localise
from reloc.result import LocaliseRequest
from reloc.service.handler import localise_request
from reloc.wire import LocaliseWireRequest


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    cv2.setNumThreads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    world = open_world(args.world)
    drone = _largest(args.db)
    cloud = load_cloud(args.scan, drone.frame)
    street = _street_map(args, world, drone, cloud)
    say = sys.stdout.write
    say(f"street views: {len(street.images)} views, {len(street.points)} points\n")
    maps = {"street views": street} if args.street_only else {"drone map": drone, "street views": street}
    for name, feature_map in maps.items():
        indexed = [_indexed(feature_map)]
        for lens in (False, True) if name == "street views" else (False,):
            errors = [_asked(world, image, indexed, lens) for image in world.truth.group("street")]
            s = summarise(errors)
            far = sum(e is not None and e.position_m > 2.0 for e in errors)
            near = sum(e is not None and e.position_m <= 0.5 and e.angle_deg <= 1.0 for e in errors)
            say(
                f"{name}, {'true lens' if lens else 'file only'}: {s.localised} of {s.queries} street photos "
                f"localised, {near} within 0.5 m and 1 degree, median {s.position_m[0]:.2f} m, "
                f"{s.angle_deg[0]:.2f} degrees, more than 2 m off: {far}\n"
            )
            sys.stdout.flush()
    wrong = [*world.negatives("other_town"), *world.negatives("mirrored")][: args.negatives]
    indexed = [_indexed(street)]
    found = 0
    for path in wrong:
        gray, request = _query(path)
        found += localise(gray, request, indexed).pose is not None
    say(f"street views: {found} of {len(wrong)} photos of another town and mirrored ones localised\n")
    _sheet(args.out / "street_views.jpg", world, drone, cloud)
    for image in world.truth.group("street")[
        :: max(1, len(world.truth.group("street")) // max(args.frames, 1))
    ][: args.frames]:
        say(_registered(world, image, drone, cloud, args.seed) + "\n")
        sys.stdout.flush()
    return 0


def _street_map(args: argparse.Namespace, world: World, drone: FeatureMap, cloud: PointCloud) -> FeatureMap:
    """From DIR, or drawn now."""
    kept = args.out / "street.db"
    if not kept.exists():
        options = StreetOptions()
        low, high = np.percentile(drone.points_local()[:, :2], (2, 98), axis=0)
        places = standing_places(cloud, low, high, options.stand)
        photos = np.array([_pose(world, i, drone).center for i in world.truth.group("street")])
        gap = np.linalg.norm(places[:, None, :2] - photos[None, :, :2], axis=2).min(axis=1)
        near = places[gap < args.near]
        start = time.process_time()
        made = street_map_at(drone, cloud, _gray_of(world), near, options)
        sys.stdout.write(
            f"{len(places)} places, {len(near)} within {args.near:g} m of a photo; drawn in "
            f"{time.process_time() - start:.0f} s of CPU\n"
        )
        Database.create(kept).commit_map(replace(made, status="active"))
    return _largest(kept)


def _pose(world: World, image: TrueImage, drone: FeatureMap) -> Rigid3:
    """True pose in the frame of the drone map, which need not be that of the truth."""
    return image.cam_from_local @ world.truth.frame.enu_from(drone.frame)


def _gray_of(world: World) -> Callable[[MapImage], NDArray[np.uint8]]:
    def gray(image: MapImage) -> NDArray[np.uint8]:
        return decode_gray(world.folder / "drone" / Path(image.name).name)

    return gray


def _asked(world: World, image: TrueImage, indexed: Sequence[IndexedArea], lens: bool) -> PoseError | None:
    gray, request = _query(world.folder / image.name)
    if lens:
        request = replace(request, camera=image.camera, camera_key=None, exif_focal_px=None)
    pose = localise(gray, replace(request, prior=None), indexed).pose
    return (
        None
        if pose is None
        else pose_error(world.truth, image.name, pose.epsg, pose.utm, pose.cam_from_utm_xyzw)
    )


def _query(path: Path) -> tuple[NDArray[np.uint8], LocaliseRequest]:
    data = path.read_bytes()
    gray = decode_gray(data)
    return gray, localise_request(LocaliseWireRequest(), data, gray)


def _registered(world: World, image: TrueImage, drone: FeatureMap, cloud: PointCloud, seed: int) -> str:
    """One photo to the scan itself, from a geotag with 30 m of error."""
    rng = np.random.default_rng((seed, 91, len(image.name), int(image.name[-8:-4])))
    true = _pose(world, image, drone).center
    center: FloatArray = true + np.append(rng.normal(0, 30.0, 2), rng.normal(0, 1.0))
    prior = FramePrior(
        cam_from_local=look_pose(center, float(rng.uniform(0, 360)), 6.0), sigma_horizontal_m=30.0,
        sigma_vertical_m=2.0, sigma_heading_deg=180.0, sigma_tilt_deg=8.0,
    )  # fmt: skip
    start = time.process_time()
    picture = cv2.cvtColor(decode_rgb(world.folder / image.name), cv2.COLOR_RGB2BGR)
    found = register_frame(np.asarray(picture, np.uint8), image.camera, prior, cloud, FrameOptions(threads=1))
    cpu_s = time.process_time() - start
    if found.cam_from_local is None:
        return f"{image.name} to the scan: {found.reason} ({found.message}), {cpu_s:.0f} s"
    error = float(np.linalg.norm(found.cam_from_local.center - true))
    return f"{image.name} to the scan: accepted, {error:.2f} m off, {cpu_s:.0f} s"


def _sheet(path: Path, world: World, drone: FeatureMap, cloud: PointCloud) -> None:
    """Four street photos beside the views that are drawn at their true poses."""
    surfaces, gray = surfaces_of_scan(cloud), _gray_of(world)
    sources = [
        source_photo(cloud, gray(i), drone.cameras[i.camera_id], i.cam_from_local) for i in drone.images
    ]
    street = world.truth.group("street")
    lines = []
    for image in street[:: max(1, len(street) // 4)][:4]:
        camera: Camera = image.camera.scaled_to(480, round(480 * image.camera.height / image.camera.width))
        view = synthesise(surfaces, camera, _pose(world, image, drone), sources)
        photo = cv2.resize(
            decode_gray(world.folder / image.name),
            (camera.width, camera.height),
            interpolation=cv2.INTER_AREA,
        )
        line = np.hstack([photo, view.gray])[:360]
        lines.append(np.pad(line, ((0, 360 - len(line)), (0, 0))))
    cv2.imwrite(
        str(path), np.vstack([np.hstack(lines[:2]), np.hstack(lines[2:])]), [cv2.IMWRITE_JPEG_QUALITY, 85]
    )


def _indexed(feature_map: FeatureMap) -> IndexedArea:
    area = build_area([feature_map])
    return IndexedArea(area=area, index=build_index(area.descriptors))


def _largest(database: Path) -> FeatureMap:
    snapshot = Database.open(database).snapshot()
    maps = [m for m in snapshot.maps() if m.status == "active"]
    return snapshot.load_map(max(maps, key=lambda m: m.images).map_id)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--db", type=Path, required=True)
    parser.add_argument("--scan", type=Path, required=True, metavar="SCAN_DB")
    parser.add_argument("--near", type=float, default=25.0, metavar="M")
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--negatives", type=int, default=40)
    parser.add_argument("--street-only", action="store_true", help="do not ask the drone map")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
