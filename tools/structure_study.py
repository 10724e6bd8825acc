"""How well structure projection places a map on a scan, in the simulated world, where points have a truth.

    python -m tools.structure_study --work FOLDER [--world default] [--repeats 10] [--frames 1 3]

A town is photographed and scanned from the air; its photos become a map that is placed by their (noisy) GPS.
Frames are drawn at random and registered: by default their pose is estimated from scan points at noisy
pixels, through the map's own lens, as registration would (--pixel-noise, --correspondences); with --register
they are registered by ingest/register/frame from a prior that is wrong by metres. Then the map is placed
on the scan by structure projection and, with --adjust, adjusted to it. A point's error is its distance from
where the rays of its observations, from the true cameras, meet the town.

Printed: the error of the map's points with descriptors: mean, median, 90 %, and what the best similarity
would leave, which is the map's own bend and noise.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from featuredb.render.levels import build_cloud
from featuredb.render.renderer import RenderOptions, render
from featuredb.simworld.airborne import ScanOptions, scan_town
from featuredb.simworld.photograph import render_depth, render_view
from featuredb.simworld.scene import Scene
from featuredb.simworld.truth import Truth
from featuredb.simworld.world import World, WorldOptions, open_world, town_of, write_world
from featuredb.store import Database
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.precision import linearise
from ingest.register.frame_registration import FramePrior, FrameRegistration
from ingest.register.structure.adjustment import adjust_to_scan, adjusted_map
from ingest.register.structure.pairs import RegisteredImage
from ingest.register.structure.projection import placed_map, project_structure
from ingest.register.structure.similarity import similarities

_NOISE_CLASSES = (7, 18)
_STEP_REL = 0.02  # neighbouring depths that differ by more lie on both sides of an edge: no truth there


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setting:
    """What all draws share."""

    scene: Scene
    truth: Truth
    cloud: PointCloud
    feature_map: FeatureMap
    true_points: FloatArray
    judged: np.ndarray[Any, np.dtype[np.bool_]]


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    cv2.setNumThreads(1)
    setting = prepare(
        args.work, WorldOptions.short() if args.world == "short" else WorldOptions(), args.density
    )
    placed = setting.feature_map.points_local(setting.scene.frame)
    _print_head(setting, placed)
    generator = np.random.default_rng(args.seed)
    good = True
    for count, limit in zip(args.frames, args.limits, strict=True):
        rows = [one_draw(setting, count, generator, args) for _ in range(args.repeats)]
        good &= _print_rows(count, limit, rows)
        if args.json:
            args.json.write_text(json.dumps({"frames": count, "draws": rows}) + "\n")
    return 0 if good else 1


def prepare(work: Path, options: WorldOptions, density: float) -> Setting:
    """World, scan and map, kept in the working folder."""
    folder = work / "world"
    world = open_world(folder) if (folder / "truth.json").exists() else write_world(folder, options)
    scene = town_of(options)
    cloud = scan_cloud(scene, density)
    database = work / "db"
    store = Database.open(database) if database.exists() else Database.create(database)
    if not store.snapshot().maps():
        ingest_photos(store, folder / "drone", IngestOptions())
    snapshot = store.snapshot()
    largest = max(snapshot.maps(), key=lambda m: m.points)
    feature_map = snapshot.load_map(largest.map_id)
    true_points = true_positions(scene, world, feature_map)
    with_descriptor = np.zeros(len(feature_map.points), dtype=bool)
    observations = feature_map.observations
    with_descriptor[observations.point_index[observations.has_descriptor]] = True
    return Setting(
        scene=scene,
        truth=world.truth,
        cloud=cloud,
        feature_map=feature_map,
        true_points=true_points,
        judged=with_descriptor & np.isfinite(true_points).all(axis=1),
    )


def scan_cloud(scene: Scene, density: float) -> PointCloud:
    """The airborne scan without the points that are labelled as noise."""
    scan = scan_town(scene, ScanOptions(density_per_m2=density))
    kept = ~np.isin(scan.classification, _NOISE_CLASSES)
    bright = np.clip(scan.intensity[kept] / np.percentile(scan.intensity[kept], 99) * 255, 0, 255)
    return build_cloud(
        scan.frame,
        "ellipsoidal",
        scan.xyz[kept],
        intensity=bright.astype(np.uint8),
        classification=scan.classification[kept],
    )


def true_positions(scene: Scene, world: World, feature_map: FeatureMap) -> FloatArray:
    """(n, 3) where the true rays of each point's observations meet the town, median; NaN at edges."""
    observations = feature_map.observations
    hits = np.full((len(observations), 3), np.nan)
    for image in feature_map.images:
        true = world.truth.images[f"drone/{image.name}"]
        rows = np.flatnonzero(observations.image_id == image.image_id)
        depth = render_depth(scene, true.camera, true.cam_from_local).depth.astype(np.float64)
        xy = observations.xy[rows].astype(np.float64)
        hits[rows] = _hit(depth, true.camera, true.cam_from_local, xy)
    result = np.full((len(feature_map.points), 3), np.nan)
    order = np.argsort(observations.point_index, kind="stable")
    starts = np.searchsorted(observations.point_index[order], np.arange(len(result) + 1))
    for point in range(len(result)):
        seen = hits[order[starts[point] : starts[point + 1]]]
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen) >= 2:
            result[point] = np.median(seen, axis=0)
    return result


def _hit(depth: FloatArray, camera: Camera, pose: Rigid3, xy: FloatArray) -> FloatArray:
    """Points behind pixels: inverse depth is linear between the four pixel centres around them."""
    height, width = depth.shape
    left, top = np.floor(xy - 0.5).astype(np.int64).T
    left, top = np.clip(left, 0, width - 2), np.clip(top, 0, height - 2)
    corners = np.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    a, b = (xy - 0.5 - np.column_stack([left, top])).T
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1.0 / (weights / corners).sum(axis=0)
        smooth = corners.max(axis=0) <= (1 + _STEP_REL) * corners.min(axis=0)
    rays = np.column_stack([camera.unproject(xy), np.ones(len(xy))])
    points = pose.inverse().act(rays * z[:, None])
    points[~(smooth & np.isfinite(z))] = np.nan
    return points


def one_draw(
    setting: Setting, count: int, generator: np.random.Generator, args: argparse.Namespace
) -> dict[str, Any]:
    """Place the map by `count` random frames; errors in metres."""
    registered: list[RegisteredImage] = []
    refused = 0
    for index in generator.permutation(len(setting.feature_map.images)):
        image = setting.feature_map.images[index]
        registration = (
            by_register_frame(setting, image, generator)
            if args.register
            else by_noisy_points(setting, image, generator, args.correspondences, args.pixel_noise)
        )
        if registration is not None and registration.accepted:
            registered.append(RegisteredImage(image_id=image.image_id, registration=registration))
        else:
            refused += 1
        if len(registered) == count:
            break
    start, cpu = time.perf_counter(), time.process_time()
    structure = project_structure(setting.feature_map, registered, setting.cloud)
    row: dict[str, Any] = {
        "images": [r.image_id for r in registered],
        "frames_refused": refused,
        "reason": structure.reason,
        "seconds": time.perf_counter() - start,
        "cpu_s": time.process_time() - cpu,
    }
    if not structure.accepted:
        return row
    placed = placed_map(setting.feature_map, structure, setting.cloud)
    row["structure"] = _errors(setting, placed)
    row["gicp"] = structure.figures["gicp"]["accepted"]
    if not args.adjust:
        return row
    start = time.perf_counter()
    adjustment = adjust_to_scan(setting.feature_map, structure, registered, setting.cloud)
    row["adjust_seconds"] = time.perf_counter() - start
    row["adjust_reason"] = adjustment.reason
    final = adjusted_map(setting.feature_map, adjustment, setting.cloud) if adjustment.accepted else placed
    row["final"] = _errors(setting, final)
    return row


def by_noisy_points(
    setting: Setting, image: MapImage, generator: np.random.Generator, count: int, noise_px: float
) -> FrameRegistration | None:
    """A pose through the map's lens from scan points at noisy pixels of the true camera."""
    true = setting.truth.images[f"drone/{image.name}"]
    lens = setting.feature_map.cameras[image.camera_id]
    small = true.camera.scaled_to(true.camera.width // 2, true.camera.height // 2)
    index = render(setting.cloud, small, true.cam_from_local, RenderOptions(attributes=False)).index
    seen = np.unique(index[index >= 0])
    if len(seen) < count:
        return None
    points = setting.cloud.xyz[generator.choice(seen, count, replace=False)].astype(np.float64)
    pixels = true.camera.project(true.cam_from_local.act(points)) + generator.normal(0, noise_px, (count, 2))
    pose = true.cam_from_local
    none = np.zeros(count, dtype=np.int64)
    for _ in range(10):
        linear = linearise((lens,), none[:1], [pose], points, np.arange(count), none, pixels)
        jacobian, residual = linear.by_pose.reshape(-1, 6), linear.residual.ravel()
        normal = jacobian.T @ jacobian
        pose = Rigid3.exp(np.linalg.solve(normal, jacobian.T @ residual)) @ pose
    variance = float((residual**2).sum()) / (residual.size - 6)
    return FrameRegistration(
        cam_from_local=pose,
        covariance=np.linalg.inv(normal) * variance,
        reason=None,
        message="",
        source="intensity",
        points_local=points,
        pixels=pixels,
    )


def by_register_frame(
    setting: Setting, image: MapImage, generator: np.random.Generator
) -> FrameRegistration | None:
    """The frame registered from a prior that is wrong by 5 m and 3 degrees."""
    from ingest.register.frame.register import register_frame

    true = setting.truth.images[f"drone/{image.name}"]
    picture = render_view(setting.scene, true.camera, true.cam_from_local, moment=int(image.image_id))
    turn = so3_exp(np.radians(generator.normal(0, 3.0, 3)))
    center = true.cam_from_local.center + generator.normal(0, 5.0, 3)
    rotation = true.cam_from_local.rotation @ turn
    prior = FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        sigma_horizontal_m=5.0,
        sigma_vertical_m=5.0,
        sigma_heading_deg=3.0,
        sigma_tilt_deg=3.0,
    )
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    lens = setting.feature_map.cameras[image.camera_id]
    return register_frame(np.asarray(gray, dtype=np.uint8), lens, prior, setting.cloud)


def _errors(setting: Setting, placed: FeatureMap) -> dict[str, float]:
    return _summary(placed.points_local(setting.scene.frame), setting)


def _summary(points: FloatArray, setting: Setting) -> dict[str, float]:
    lengths = np.linalg.norm(points - setting.true_points, axis=1)[setting.judged]
    return {
        "mean_m": float(lengths.mean()),
        "median_m": float(np.median(lengths)),
        "p90_m": float(np.percentile(lengths, 90)),
    }


def best_similarity(points: FloatArray, setting: Setting) -> FloatArray:
    """The points by the similarity that brings them closest to the truth, robustly."""
    used = setting.judged.copy()
    for _ in range(4):
        scale, rotation, shift, _ = similarities(points[used][None], setting.true_points[used][None])
        moved = scale[0] * points @ rotation[0].T + shift[0]
        lengths = np.linalg.norm(moved - setting.true_points, axis=1)
        used = setting.judged & (lengths <= 3 * np.median(lengths[setting.judged]))
    return np.asarray(moved)


def _print_head(setting: Setting, placed: FloatArray) -> None:
    frame: LocalFrame = setting.scene.frame
    print(f"frame {frame.latitude_deg:.4f} {frame.longitude_deg:.4f}, scan of {len(setting.cloud)} points")
    print(
        f"map of {len(setting.feature_map.images)} images, {len(placed)} points, "
        f"{int(setting.judged.sum())} with descriptors and a truth"
    )
    for name, points in (("placed by GPS", placed), ("best similarity", best_similarity(placed, setting))):
        print(f"{name:<24}{_words(_summary(points, setting))}")


def _print_rows(count: int, limit: float, rows: list[dict[str, Any]]) -> bool:
    done = [row for row in rows if row["reason"] is None]
    print(f"{count} frame(s), {len(rows)} draws, {len(done)} placed")
    for row in rows:
        if row["reason"] is not None:
            print(f"  images {row['images']}: {row['reason']}")
    if not done:
        return False
    for step in ("structure", "final") if "final" in done[0] else ("structure",):
        mean = {key: float(np.mean([row[step][key] for row in done])) for key in done[0][step]}
        worst = max(row[step]["mean_m"] for row in done)
        name = "structure projection" if step == "structure" else "adjusted to the scan"
        print(f"  {name:<22}{_words(mean)}  worst mean {worst:.3f}")
    seconds = float(np.median([row["cpu_s"] for row in done]))
    print(f"  GICP accepted {sum(row['gicp'] for row in done)} times; {seconds:.2f} s of CPU")
    if "final" in done[0]:
        accepted = sum(row["adjust_reason"] is None for row in done)
        seconds = float(np.median([row["adjust_seconds"] for row in done]))
        print(f"  adjustment accepted {accepted} times; {seconds:.1f} s")
    mean_structure = float(np.mean([row["structure"]["mean_m"] for row in done]))
    print(f"  mean error after structure projection {mean_structure:.3f} m, wanted at most {limit:g} m")
    return mean_structure <= limit


def _words(summary: dict[str, float]) -> str:
    return "  ".join(f"{key[:-2]} {value:.3f}" for key, value in summary.items())


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, required=True, metavar="FOLDER", help="world and database")
    parser.add_argument("--world", choices=("short", "default"), default="short")
    parser.add_argument("--density", type=float, default=8.0, help="pulses per square metre; default 8")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 3])
    parser.add_argument("--limits", type=float, nargs="+", default=[0.10, 0.05], help="metres, per --frames")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--adjust", action="store_true", help="adjust the placed map to the scan, too")
    parser.add_argument("--register", action="store_true", help="register frames instead of simulating it")
    parser.add_argument("--correspondences", type=int, default=150)
    parser.add_argument("--pixel-noise", type=float, default=1.5, help="standard deviation; default 1.5")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
