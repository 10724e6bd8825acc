"""The simulated world end to end: photos, scan, anchoring without a person, queries against the truth.

1. `featuredb simworld --lidar` writes photos whose GPS has a drone's errors, an airborne scan with
   intensities only, an ortho image of another day, and the same of another town at the same place.
2. `featuredb ingest photos` places the map by GPS; `featuredb lidar add` adds the scan.
3. `featuredb anchor --auto` places the map on the scan of the other town, which it must refuse, and then on
   its own.
4. The map's cameras are compared with the truth, before and after; then the held-out queries.

With --pixels, in place of the other town and of 4: each held-out photo is localised; pixels at random, of
what stands still, are located on the scan. Bounds: poses and lenses are drawn around the truth as each
answer's covariance says, and pixels located from them. So the bounds are tested by themselves: one map has
one error, which is in all of its answers. What the scan's strips are off by is stated, as from a data sheet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from featuredb.adjust.terms import whole_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.laser.airborne import AirborneScanOptions
from featuredb.simworld.world import TrueImage, Truth, World, WorldOptions, town_of
from featuredb.store import Database
from reloc.answered_view import AnsweredView
from reloc.localiser import Localiser
from reloc.pixels.locate import PixelPlace, locate
from reloc.pixels.surfaces import scan_surface
from reloc.service.handler import answer_query
from reloc.wire.query import LocaliseWireRequest
from tools.commands import anchor, featuredb, first_map, newest_copy, once
from tools.figures import inside, inside_figures, pose_errors, poses_in, squared, study_parser, write_figures
from tools.real_photos import ask_poses, error_figures
from tools.worlds.scan_world import ScanWorld, make_scan_world
from tools.worlds.sights import SeenPlaces

_SEED = 1
_PIXELS, _DRAWS = 60, 16  # of each photo: pixels, and draws of a pose and a lens
# In height, of one of two strips from their mean.
_STRIPS_M = 0.5 * AirborneScanOptions().strip_shift_m / np.sqrt(2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Miss:
    """How far a place is off, and the square of that in units of the covariance."""

    off_m: float
    squared: float
    at_edge: bool


def main() -> None:
    parser = study_parser(__doc__, "--work", "--inputs")
    parser.add_argument("--pixels", action="store_true", help="locate pixels of the held-out photos")
    args = parser.parse_args()
    work, world = args.work, make_scan_world(args.inputs, _SEED)
    database, placed = anchored(work, world, other=False)
    if args.pixels:
        write_figures(args.json, located(Database.open(database), world.world))
        return
    refused = anchored(work, world, other=True)[1]
    by_gps = camera_errors(first_map(Database.open(work / "mapped")), world.world.truth)[0]
    figures = {"placed": int(placed), "other_placed": int(refused), "gps_cameras_m": float(np.median(by_gps))}
    write_figures(args.json, figures | judged(Database.open(database), world.world))


def anchored(work: Path, world: ScanWorld, *, other: bool) -> tuple[Path, bool]:
    """A copy of the photos' database with one of the scans, anchored; and whether the map was placed."""
    photos = str(world.world.folder / "drone")
    mapped = once(work / "mapped", lambda path: featuredb("ingest", "photos", str(path), photos, "--quiet"))
    database = newest_copy(mapped, work / f"anchored-{'other' if other else 'own'}-intensity")
    featuredb("lidar", "add", str(database), str(world.other_scan if other else world.scan))
    map_id = first_map(Database.open(database)).map_id
    report = work / f"{database.name}-report"
    return database, anchor(database, map_id, world.world.folder / "drone", report)


def judged(database: Database, world: World) -> dict[str, float]:
    """Errors of the map's cameras and of what is answered to queries."""
    metres, degrees = camera_errors(first_map(database), world.truth)
    poses = {image.name: image.cam_from_local for image in world.truth.group("queries")}
    answers = error_figures(ask_poses(database, world.folder, list(poses), world.truth.frame, poses))
    return {
        "scan_cameras_m": float(np.median(metres)),
        "scan_cameras_deg": float(np.median(degrees)),
        "scan_queries": answers["asked"],
        "scan_answered": answers["answered"],
        "scan_queries_m": answers["median_m"],
        "scan_queries_largest_m": answers["largest_m"],
    }


def camera_errors(feature_map: FeatureMap, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees between the map's images and the truth."""
    true = {Path(image.name).name: image.cam_from_local for image in truth.group("drone")}
    return pose_errors(poses_in(truth.frame, feature_map), true)


def located(database: Database, world: World) -> dict[str, float]:
    """Places of pixels from the answers to held-out photos, and from poses and lenses that are drawn."""
    scene, truth = town_of(WorldOptions.short(_SEED)), world.truth
    rng, localiser = np.random.default_rng(_SEED), Localiser.open(database)
    answered: list[Miss] = []
    drawn: list[Miss] = []
    asked = 0
    for photo in truth.group("queries"):
        view = view_of(localiser, (world.folder / photo.name).read_bytes())
        if view is None:
            continue
        surface = scan_surface(database, view)
        surface.common_m = _STRIPS_M
        here = view.frame.enu_from(truth.frame)
        seen = SeenPlaces(scene, photo.camera, photo.cam_from_local)
        for draw in range(_DRAWS + 1):  # the first by the answer itself
            one = _drawn(rng, view, photo, here) if draw else view
            pixels = seen.pixels(rng, _PIXELS // 5 if draw else _PIXELS)
            found = misses(view, here.act(seen.places(pixels)), locate(one, surface, pixels))
            (drawn if draw else answered).extend(found)
        asked += _PIXELS
    figures = miss_figures("answered", answered) | miss_figures("drawn", drawn)
    return figures | {"refused": asked - len(answered), "located": len(answered)}


def _drawn(rng: np.random.Generator, view: AnsweredView, photo: TrueImage, here: Rigid3) -> AnsweredView:
    """A pose and a lens that are off from the true ones as the answer's covariance says; `here`: the frame of
    the answer from that of the truth."""
    error = rng.multivariate_normal(np.zeros(len(view.covariance)), view.covariance)
    local_from_cam = (photo.cam_from_local @ here.inverse()).inverse()
    turned = so3_exp(error[:3]).T @ local_from_cam.rotation
    pose = Rigid3(rotation=turned, translation=local_from_cam.translation - error[3:6]).inverse()
    camera = view.camera
    if len(error) > 6:
        camera = whole_camera(photo.camera)
        camera = replace(camera, params=tuple(np.array(camera.params) - error[6:]))
    return replace(view, camera=camera, cam_from_local=pose)


def misses(view: AnsweredView, places: FloatArray, found: Sequence[PixelPlace]) -> list[Miss]:
    """Misses of the pixels that have a place; `places`: (n, 3) true ones, in the frame of the view."""
    missed = []
    for place, true in zip(found, places, strict=True):
        if place.utm is not None and place.covariance is not None:
            error = view.frame.enu_from_utm(place.utm, place.epsg) - true
            square = squared(error, place.covariance)
            missed.append(Miss(off_m=float(np.linalg.norm(error)), squared=square, at_edge=place.at_edge))
    return missed


def miss_figures(name: str, missed: Sequence[Miss]) -> dict[str, float]:
    """Errors in metres and shares inside the bounds, off edges and at them; `name` stands before each."""
    far = np.array([miss.off_m for miss in missed])
    edge = np.array([miss.at_edge for miss in missed])
    squares = np.array([miss.squared for miss in missed])
    return {
        f"{name}_median_m": float(np.median(far)),
        f"{name}_clear_95_m": float(np.quantile(far[~edge], 0.95)),
        f"{name}_edges": float(edge.mean()),
        f"{name}_edge_95": inside(squares[edge], 0.95),
        **inside_figures(name, squares[~edge]),
    }


def view_of(localiser: Localiser, data: bytes) -> AnsweredView | None:
    """The camera of the answer to a photo, asked with nothing but its file; None where there is no answer."""
    reply = answer_query(LocaliseWireRequest(), data, localiser)
    return AnsweredView.of_reply(reply) if reply.status == "localised" else None


if __name__ == "__main__":
    main()
