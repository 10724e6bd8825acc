"""What changes of view SIFT bridges: verified matches and localised photos, by angle and by extractor.

    python -m tools.view_change --work FOLDER --out docs/figures [--sights 5] [--width 800] [--part K N]

Photographs places of the simulated town from the side of a circle around each of them, at one distance, so
that nothing but the view changes:

- facade: a house front across the street, from 9 m at eye height, azimuth 0 to 70 degrees off its normal;
- town: from 80 m, 45 degrees above the horizon, azimuth 0 to 70 degrees;
- descent: from 60 m straight above down to 20 degrees above the horizon (70 degrees of change).

Three photos within 4 degrees of the first view are the map: keypoints of the first that match one of the
others, at their true depth. Each other photo is matched with the first one (mutual ratio test, two-view
geometry as the ingest does) and localised against the map as the server does, with its own true lens. A match
is true when the exact depth says that both pixels show one point, within 4 pixels of 1000.

Extractors: that of this program (RootSIFT of OpenCV); COLMAP's SIFT plain, with affine shape, with domain
size pooling; and this program's, the query alone described under simulated tilts (ASIFT's, one-sided).
Descriptors of different extractors are never compared.

Photos and features are kept in FOLDER. `--part K N` makes every N-th photo only, for several processes.
Writes view_change.csv and view_change.png, a sheet of the photos, and prints the table.
"""

import argparse
import csv
import hashlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

import cv2
import faiss
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.features.selection import spread_strongest
from featuredb.features.tilted import extract_tilted
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.index.nearest import nearest
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.simworld.photograph import render_depth, take_photo
from featuredb.simworld.scene import Scene
from featuredb.simworld.sensor import SensorOptions
from featuredb.simworld.shot import Device, Shot, look_pose
from featuredb.simworld.town import make_town
from ingest.colmap_bridge import verify_pair
from ingest.matching import MatchOptions, mutual_matches
from reloc.candidates import IndexedArea
from reloc.localise import localise_features
from reloc.options import LocaliseOptions
from reloc.result import LocaliseRequest

mpl.use("Agg")  # no display is needed

FAMILIES = ("facade", "town", "descent")
ANGLES = (10, 20, 30, 40, 50, 60, 70)
REFERENCES = (0.0, -4.0, 4.0)  # degrees beside the first view; the photos of the map
EXTRACTORS = ("opencv", "colmap", "colmap affine", "colmap dsp", "opencv, tilted query")
_TRUE_REL = 0.004  # of the longer side
_FEATURES = 6000
_TIME = datetime(2025, 6, 20, 11, 0, 0, tzinfo=UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One photo against the map of its sight.

    Attributes:
        features: of the photo. matches, verified, true: with the first view: tentative, after two-view
            geometry, and those of them that show one point.
        inliers: of the localisation. localised: believed. error_m, error_deg: of what was believed, else NaN.
        cpu_s: of extracting the photo's features.
    """

    family: str
    sight: int
    angle: int
    extractor: str
    features: int
    matches: int
    verified: int
    true: int
    inliers: int
    localised: bool
    error_m: float
    error_deg: float
    cpu_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A photo with its truth: camera, pose, exact depth (h, w) at the pixels' centres."""

    gray: NDArray[np.uint8]
    camera: Camera
    cam_from_local: Rigid3
    depth: NDArray[np.float32]
    path: Path


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.part is not None:
        _prepare(args)
        return 0
    rows: list[Row] = []
    for family in args.families:
        for sight in range(args.sights):
            rows += of_sight(args, family, sight)
            sys.stdout.write(f"{family} {sight} done\n")
            sys.stdout.flush()
    with (args.out / "view_change.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    plot(rows, args.out / "view_change.png")
    _contact_sheet(args, args.out / "view_change_photos.jpg")
    sys.stdout.write(table(rows) + "\n")
    return 0


def of_sight(args: argparse.Namespace, family: str, sight: int) -> list[Row]:
    """All angles and extractors at one place."""
    first, *others = [_view(args, family, sight, angle) for angle in REFERENCES]
    rows = []
    for extractor in EXTRACTORS:
        base = extractor.split(",")[0]
        described = [_features(view, base)[0] for view in (first, *others)]
        area = build_area([small_map([first, *others], described, _scene(args.seed))])
        indexed = IndexedArea(area=area, index=build_index(area.descriptors))
        for angle in ANGLES:
            view = _view(args, family, sight, angle)
            features, cpu_s = _features(view, extractor)
            matches = (
                one_sided(described[0], features)
                if "tilted" in extractor
                else _mutual(described[0], features)
            )
            verified = verify_pair(
                first.camera, described[0].xy, view.camera, features.xy, matches.astype(np.uint32),
                focal_known=True, max_error_px=MatchOptions().max_error_px, seed=0,
            ).inliers  # fmt: skip
            true = _is_true(first, described[0].xy[verified[:, 0]], view, features.xy[verified[:, 1]])
            found = localise_features(features, LocaliseRequest(camera=view.camera), [indexed]).result
            pose = (
                None
                if found.pose is None
                else found.pose.cam_from_local @ area.frame.enu_from(_scene(args.seed).frame)
            )
            rows.append(
                Row(
                    family=family,
                    sight=sight,
                    angle=angle,
                    extractor=extractor,
                    features=len(features),
                    matches=len(matches),
                    verified=len(verified),
                    true=int(true.sum()),
                    inliers=found.inliers,
                    localised=pose is not None,
                    error_m=_distance(pose, view.cam_from_local),
                    error_deg=np.nan if pose is None else pose.angle_to_deg(view.cam_from_local),
                    cpu_s=cpu_s,
                )
            )
    return rows


def small_map(views: Sequence[View], described: Sequence[Features], scene: Scene) -> FeatureMap:
    """The first view's keypoints that match another view truly, at their exact depth."""
    first, features = views[0], described[0]
    pairs = [
        matches[_is_true(first, features.xy[matches[:, 0]], view, other.xy[matches[:, 1]])]
        for view, other, matches in (
            (view, other, _mutual(features, other))
            for view, other in zip(views[1:], described[1:], strict=True)
        )
    ]
    rows = np.unique(np.concatenate([pair[:, 0] for pair in pairs]))
    seen = [(0, rows, rows), *((k, pair[:, 0], pair[:, 1]) for k, pair in enumerate(pairs, start=1))]
    points = _points(first, features.xy[rows])
    take = {
        name: np.concatenate([getattr(described[k], name)[there] for k, _, there in seen])
        for name in ("xy", "scale", "angle", "descriptors")
    }
    point_index = np.concatenate([np.searchsorted(rows, here) for _, here, _ in seen])
    n = len(rows)
    return FeatureMap(
        map_id="sight", name="sight", epsg=scene.epsg, height_datum="ellipsoidal", frame=scene.frame,
        cameras=(first.camera,),
        images=tuple(
            MapImage(
                image_id=k, name=f"{k}", sha256=f"{k:064x}", camera_id=0, cam_from_local=v.cam_from_local
            )
            for k, v in enumerate(views)
        ),
        points=MapPoints(
            utm=scene.frame.utm_from_enu(points, scene.epsg), rgb=np.zeros((n, 3), np.uint8),
            track_length=np.bincount(point_index, minlength=n).astype(np.int32),
            error_px=np.full(n, 0.5, np.float32),
            covariance=np.tile(np.array([1e-4, 0, 0, 1e-4, 0, 1e-4], np.float32), (n, 1)),
        ),
        observations=MapObservations(
            point_index=point_index,
            image_id=np.concatenate([np.full(len(t), k, np.int32) for k, _, t in seen]),
            has_descriptor=np.ones(len(point_index), np.bool_), **take,
        ),
        placement=Placement(
            method="gcp", local_from_sfm=Sim3.identity(), covariance=np.diag([1e-10] * 4 + [1e-6] * 3),
            residual_rms_m=0.0,
        ),
        # Each map and its queries share an extractor; the name is the one that localisation asks for.
        extractor_fingerprint=LocaliseOptions().extractor.fingerprint,
    )  # fmt: skip


def one_sided(base: Features, tilted: Features) -> NDArray[np.int64]:
    """Matches (m, 2) of a photo and a tilted one: the ratio test asks the first only, each row once."""
    options = MatchOptions()
    squared, row = nearest(tilted.descriptors, base.descriptors, 2)
    angle = 2.0 * np.arcsin(np.clip(np.sqrt(squared) / 1024.0, 0.0, 1.0))
    good = np.flatnonzero(
        (angle[:, 0] < options.max_ratio * angle[:, 1]) & (angle[:, 0] <= options.max_angle_rad)
    )
    good = good[np.argsort(angle[good, 0], kind="stable")]
    _, best = np.unique(row[good, 0], return_index=True)
    return np.stack([row[good[best], 0], good[best]], axis=1)


def _mutual(a: Features, b: Features) -> NDArray[np.int64]:
    return mutual_matches(a.descriptors, b.descriptors, MatchOptions()).astype(np.int64)


def _points(view: View, xy: NDArray[np.float32]) -> FloatArray:
    """Where the pixels' rays meet the town (n, 3); NaN in the sky."""
    pixel = np.clip(xy.astype(np.int64), 0, [view.camera.width - 1, view.camera.height - 1])
    depth = view.depth[pixel[:, 1], pixel[:, 0]].astype(np.float64)
    rays = np.column_stack([view.camera.unproject(xy.astype(np.float64)), np.ones(len(xy))])
    depth[~np.isfinite(depth)] = np.nan
    return view.cam_from_local.inverse().act(rays * depth[:, None])


def _is_true(a: View, xy_a: NDArray[np.float32], b: View, xy_b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether the pixels (m, 2) of two views show one point of the town."""
    if not len(xy_a):
        return np.zeros(0, dtype=np.bool_)
    limit = _TRUE_REL * max(a.camera.width, a.camera.height)
    with np.errstate(invalid="ignore"):
        there = b.camera.project(b.cam_from_local.act(_points(a, xy_a)))
        back = a.camera.project(a.cam_from_local.act(_points(b, xy_b)))
        forth_ok = np.linalg.norm(there - xy_b, axis=1) < limit
        return np.asarray(forth_ok & (np.linalg.norm(back - xy_a, axis=1) < limit))


def _view(args: argparse.Namespace, family: str, sight: int, angle: float) -> View:
    """The photo of a sight from an angle, from the folder or taken now."""
    camera = Camera(
        model="SIMPLE_RADIAL", width=args.width, height=args.width * 3 // 4,
        params=(0.75 * args.width, 0.5 * args.width, 0.375 * args.width, -0.03),
    )  # fmt: skip
    scene = _scene(args.seed)
    pose = _pose(scene, family, sight, angle, args.seed)
    path = args.work / f"{family}_{sight}_{angle:+.0f}_{args.width}_{args.seed}.png"
    depth_path = path.with_suffix(".npz")
    if not (path.exists() and depth_path.exists()):
        device = Device(make="Simworld", model="Study", camera=camera, focal_mm=5.0, focal_35mm=27)
        seed = int(hashlib.sha256(path.name.encode()).hexdigest()[:8], 16)
        shot = Shot(name=path.name, device=device, cam_from_local=pose, time=_TIME, seed=seed)
        photo = take_photo(scene, shot, SensorOptions())
        np.savez_compressed(depth_path, depth=render_depth(scene, camera, pose).depth)
        cv2.imwrite(str(path), cv2.cvtColor(photo, cv2.COLOR_RGB2BGR))
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return View(
        gray=np.asarray(gray, dtype=np.uint8), camera=camera, cam_from_local=pose,
        depth=np.load(depth_path)["depth"], path=path,
    )  # fmt: skip


def _pose(scene: Scene, family: str, sight: int, angle: float, seed: int) -> Rigid3:
    """On the circle around the sight; the photo looks at it."""
    target, normal = _sight(scene, family, sight, seed)
    along = np.array([-normal[1], normal[0], 0.0])
    a = np.radians(angle)
    if family == "facade":
        toward = np.cos(a) * normal + np.sin(a) * along
        center = target + 9.0 * toward
        center[2] = float(_ground_height(scene, center)) + 1.6
    elif family == "town":
        flat = np.cos(a) * normal + np.sin(a) * along
        center = target + 80.0 * (np.cos(np.pi / 4) * flat + np.array([0.0, 0.0, np.sin(np.pi / 4)]))
    else:
        center = target + 60.0 * (np.cos(a) * np.array([0.0, 0.0, 1.0]) + np.sin(a) * normal)
    view = (target - center) / np.linalg.norm(target - center)
    heading = np.degrees(np.arctan2(view[0], view[1])) if np.hypot(*view[:2]) > 1e-6 else 0.0
    if family == "descent":  # the picture's top stays, where the heading of a view straight down has none
        heading = np.degrees(np.arctan2(-normal[0], -normal[1]))
        if angle < 0:
            return look_pose(center, float(heading), -90.0 + angle)
    return look_pose(center, float(heading), float(np.degrees(np.arcsin(view[2]))))


@lru_cache(maxsize=64)
def _sight(scene: Scene, family: str, sight: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """A point to look at (3,) and the horizontal direction (3,) from which it is seen first, local frame."""
    rng = np.random.default_rng((seed, 81, FAMILIES.index(family)))
    buildings = [b for b in scene.plan.buildings if b.eaves - b.base > 4.0 and b.width > 7.0]
    found: list[tuple[FloatArray, FloatArray]] = []
    facades: set[str] = set()
    for i in rng.permutation(len(buildings)):
        building = buildings[i]
        yaw = np.radians(building.yaw_deg)
        # The front of a house is its side at -y of its own axes, where the street is.
        normal = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        front = np.array([building.x, building.y, 0.0]) + 0.5 * building.depth * normal
        if family == "facade":
            at = [abs((front[1] if s.along == "x" else front[0]) - s.at) for s in scene.plan.streets]
            # Five facade textures; each sight is another one as long as there are others.
            if min(at) > 9.0 or (building.facade in facades and len(facades) < 5):
                continue
            facades.add(building.facade)
            where = front + np.array([0.0, 0.0, float(scene.plan.height(front[1])) + 2.2])
        else:
            where = front + 6.0 * normal
            where[2] = float(scene.plan.height(where[1]))
        found.append((where, normal))
    where, normal = found[sight]
    return scene.enu_from_town @ where, scene.enu_from_town @ normal


def _ground_height(scene: Scene, center: FloatArray) -> float:
    return float(scene.plan.height(float((scene.enu_from_town.T @ center)[1])))


def _features(view: View, extractor: str) -> tuple[Features, float]:
    """Features of a photo by an extractor, and the CPU seconds that they took; kept beside the photo."""
    path = view.path.with_name(f"{view.path.stem}__{extractor.replace(', ', '_').replace(' ', '_')}.npz")
    if not path.exists():
        start = time.process_time()
        features = _MAKERS[extractor](view.gray)
        cpu_s = time.process_time() - start
        arrays = {n: getattr(features, n) for n in ("xy", "scale", "angle", "response", "descriptors")}
        np.savez(path, cpu_s=cpu_s, **arrays)
    with np.load(path) as file:
        arrays = {n: file[n] for n in ("xy", "scale", "angle", "response", "descriptors")}
        cpu_s = float(file["cpu_s"])
    fingerprint = LocaliseOptions().extractor.fingerprint
    return Features(
        width=view.camera.width, height=view.camera.height, fingerprint=fingerprint, **arrays
    ), cpu_s


def colmap_features(gray: NDArray[np.uint8], *, affine: bool, pooling: bool) -> Features:
    """COLMAP's SIFT on the CPU as 8-bit RootSIFT, spread and limited as the program's own."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = 3 * _FEATURES
    options.sift.estimate_affine_shape, options.sift.domain_size_pooling = affine, pooling
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, described = extractor.extract_from_uint8_array(np.ascontiguousarray(gray))
    xy = np.array([(k.x, k.y) for k in keypoints], dtype=np.float32).reshape(-1, 2)
    scale = np.array([k.compute_scale() for k in keypoints], dtype=np.float32)
    angle = np.array([k.compute_orientation() for k in keypoints], dtype=np.float32)
    h, w = gray.shape
    # COLMAP tells no contrast; it keeps the largest.
    rows = spread_strongest(xy, scale, w, h, _FEATURES)
    return Features(
        xy=xy[rows], scale=scale[rows], angle=np.degrees(angle[rows]) % np.float32(360.0),
        response=np.zeros(len(rows), np.float32), descriptors=np.asarray(described.data)[rows],
        width=w, height=h, fingerprint="colmap",
    )  # fmt: skip


_OWN = ExtractorOptions(max_features=_FEATURES)
_MAKERS: dict[str, Callable[[NDArray[np.uint8]], Features]] = {
    "opencv": lambda gray: extract(gray, _OWN),
    "colmap": lambda gray: colmap_features(gray, affine=False, pooling=False),
    "colmap affine": lambda gray: colmap_features(gray, affine=True, pooling=False),
    "colmap dsp": lambda gray: colmap_features(gray, affine=False, pooling=True),
    "opencv, tilted query": lambda gray: extract_tilted(gray, _OWN),
}


def table(rows: Sequence[Row]) -> str:
    """For each kind of change: localised of all sights, median true verified matches, by angle; cost."""
    lines = []
    for family in dict.fromkeys(r.family for r in rows):
        sights = len({r.sight for r in rows if r.family == family})
        lines.append(f"{family}: localised of {sights} / wrong / median true verified matches")
        lines.append(f"  {'':<22}" + "".join(f"{a:>14}" for a in ANGLES) + f"{'CPU s':>9}{'features':>10}")
        for extractor in EXTRACTORS:
            cells = []
            mine = [r for r in rows if r.family == family and r.extractor == extractor]
            for angle in ANGLES:
                these = [r for r in mine if r.angle == angle]
                found = sum(r.localised for r in these)
                true = np.median([r.true for r in these])
                cells.append(f"{found:>6}/{sum(_wrong(r) for r in these)}/{true:<6.0f}")
            lines.append(
                f"  {extractor:<22}" + "".join(cells) + f"{np.mean([r.cpu_s for r in mine]):>9.2f}"
                f"{np.mean([r.features for r in mine]):>10.0f}"
            )
    return "\n".join(lines)


def plot(rows: Sequence[Row], path: Path) -> None:
    """True verified matches and localised share against the change of view."""
    families = list(dict.fromkeys(r.family for r in rows))
    figure, axes = plt.subplots(
        2, len(families), figsize=(4.6 * len(families), 7), layout="constrained", squeeze=False
    )
    for column, family in enumerate(families):
        for extractor in EXTRACTORS:
            mine = [
                [r for r in rows if (r.family, r.extractor, r.angle) == (family, extractor, a)]
                for a in ANGLES
            ]
            axes[0, column].plot(
                ANGLES,
                [max(float(np.median([r.true for r in these])), 0.5) for these in mine],
                ".-",
                label=extractor,
            )
            axes[1, column].plot(ANGLES, [np.mean([r.localised for r in these]) for these in mine], ".-")
        axes[0, column].axhline(MatchOptions().min_inliers, color="grey", linewidth=0.8, linestyle="--")
        axes[0, column].set(yscale="log", title=family, ylabel="true verified matches, median")
        axes[1, column].set(xlabel="change of view, degrees", ylabel="share localised", ylim=(-0.05, 1.05))
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _contact_sheet(args: argparse.Namespace, path: Path) -> None:
    """The first sight of each kind from 0, 20, 40, 60 and, if descending, 70 degrees."""
    lines = []
    for family in args.families:
        views = [_view(args, family, 0, angle) for angle in (0.0, 20, 40, 60, 70)]
        lines.append(np.hstack([cv2.resize(cv2.imread(str(v.path)), (320, 240)) for v in views]))
    cv2.imwrite(str(path), np.vstack(lines), [cv2.IMWRITE_JPEG_QUALITY, 85])


def _wrong(row: Row) -> bool:
    return row.localised and (row.error_m > 1.0 or row.error_deg > 1.0)


def _distance(pose: Rigid3 | None, truth: Rigid3) -> float:
    return float("nan") if pose is None else float(np.linalg.norm(pose.center - truth.center))


def _prepare(args: argparse.Namespace) -> None:
    """Photos and features of every N-th view."""
    part, parts = args.part
    views = [(f, s, a) for f in args.families for s in range(args.sights) for a in (*REFERENCES, *ANGLES)]
    for family, sight, angle in views[part::parts]:
        view = _view(args, family, sight, angle)
        for extractor in EXTRACTORS:
            _features(view, extractor)


@lru_cache(maxsize=1)
def _scene(seed: int) -> Scene:
    return make_town(seed)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, required=True, metavar="FOLDER", help="kept and used again")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES))
    parser.add_argument("--sights", type=int, default=5)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", type=int, nargs=2, default=None, metavar=("K", "N"))
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
