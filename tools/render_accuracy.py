"""Rendered depth against ray-cast truth: how far off, where, and how many holes.

    uv run python tools/render_accuracy.py [--density 8 25] [--seed 7] [--out FOLDER]

A simulated town is sampled by casting rays: `density` per square metre straight down and, for the walls, an
eighth of that from each of four sides, 40 degrees off the vertical; a random quarter of a four times denser
grid, so that points lie neither in rows nor by chance alone. No noise: every error is the renderer's. Drone
cameras of 1280x720 pixels with distortion then look down and obliquely at the points, and each pixel's depth
is compared with that of the exact ray through its centre.

Pixels whose exact surface has no point within two spacings of the scan are left out: under trees, behind
walls that face no ray, thin posts. Their share is printed.

A pixel is beside an edge where the exact depth jumps by more than a metre within two pixels. Of pixels that
are off by more than half a metre it is said on which side: nearer is a foreground that grew over what lies
behind it, farther is a background that shines through.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rays import pixel_rays
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.levels import build_cloud
from featuredb.render.renderer import RenderOptions, render
from featuredb.render.rendering import Rendering
from featuredb.simworld.look import scene_look
from featuredb.simworld.photograph import render_depth
from featuredb.simworld.raster import render as cast_rays
from featuredb.simworld.scene import Scene
from featuredb.simworld.shot import look_pose
from featuredb.simworld.town import make_town

WRONG_M = 0.5
EDGE_M, EDGE_PX = 1.0, 2
CAMERA = Camera(
    model="OPENCV",
    width=1280,
    height=720,
    params=(940.0, 941.0, 644.0, 356.0, -0.06, 0.02, 4e-4, -3e-4),
)
# Name, height over the town's origin and pitch (-90 is straight down); each at three places and headings.
VIEWS = (("nadir 80 m", 80.0, -90.0), ("oblique 80 m", 80.0, -45.0), ("low oblique 30 m", 30.0, -25.0))
PLACES = ((0.0, 0.0, 20.0), (60.0, -50.0, 140.0), (-70.0, 40.0, 265.0))
SCAN_DISTANCE_M = 1500.0
SIDE_TILT_DEG, SIDE_SHARE = 40.0, 0.125


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """A ninth of the pixels of one picture, those that show sampled surfaces.

    Attributes:
        unsampled: share of the town's pixels left out, since no point lies near what they show.
        error: (n,) float32 metres, rendered minus exact; NaN for holes.
        edge: (n,) bool, beside a depth edge.
    """

    error: NDArray[np.float32]
    edge: NDArray[np.bool_]
    unsampled: float


def sample_points(scene: Scene, density_per_m2: float, seed: int) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Points (n, 3) and colours (n, 3) where rays from far above and from four sides meet the scene."""
    rng = np.random.default_rng(seed)
    parts = [_cast(scene, 0.0, -90.0, density_per_m2, rng)]
    for heading in (0.0, 90.0, 180.0, 270.0):
        parts.append(_cast(scene, heading, SIDE_TILT_DEG - 90.0, SIDE_SHARE * density_per_m2, rng))
    return np.concatenate([p for p, _ in parts]), np.concatenate([c for _, c in parts])


def _cast(
    scene: Scene, heading: float, pitch: float, density: float, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.uint8]]:
    """A random quarter of the rays of a far camera that holds the town."""
    step = 0.5 / np.sqrt(density)
    side = int(1.1 * np.hypot(*scene.plan.size) / step)
    camera = Camera.from_focal(side, side, SCAN_DISTANCE_M / step, model="SIMPLE_PINHOLE")
    pose = look_pose(np.zeros(3), heading, pitch)
    pose = Rigid3(rotation=pose.rotation, translation=np.array([0.0, 0.0, SCAN_DISTANCE_M]))
    cast = cast_rays(scene.faces, scene.ellipsoids, camera, pose, look=scene_look(scene))
    assert cast.rgb is not None
    depth, colour = cast.depth, cast.rgb
    x, y = pixel_rays(camera)
    kept = np.isfinite(depth) & (rng.random(depth.shape) < 0.25)
    z = depth[kept].astype(np.float64)
    points = pose.inverse().act(np.column_stack([x[kept] * z, y[kept] * z, z]))
    inside = in_town(scene, points)
    return points[inside], colour[kept][inside]


def in_town(scene: Scene, points: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: points of the rectangle that is sampled."""
    town = points @ scene.enu_from_town
    return np.asarray((np.abs(town[:, :2]) < 0.5 * np.asarray(scene.plan.size)).all(axis=1))


def compare(
    scene: Scene, points_tree: cKDTree, reach_m: float, rendering: Rendering
) -> tuple[Comparison, NDArray[np.float32]]:
    """The comparison, and the error as a picture (h, w): NaN outside the town, infinity in holes."""
    exact = render_depth(scene, rendering.camera, rendering.cam_from_local).depth
    x, y = pixel_rays(rendering.camera)
    seen = np.isfinite(exact)
    z = np.where(seen, exact, 1.0).astype(np.float64)
    points = rendering.cam_from_local.inverse().act(np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3))
    seen &= in_town(scene, points).reshape(seen.shape)
    far = np.where(np.isfinite(exact), exact, 1e4).astype(np.float32)
    window = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    # A jump is what no plane does: the change within the window beyond that of its opposite halves.
    jump = np.maximum(cv2.dilate(far, window) - far, far - cv2.erode(far, window))
    slope = np.abs(cv2.Laplacian(far, cv2.CV_32F, ksize=1))
    edge = (jump > EDGE_M) & (cv2.dilate(slope, window) > EDGE_M)
    error = rendering.depth - exact
    picture = np.where(seen, np.where(np.isnan(error), np.inf, error), np.nan).astype(np.float32)
    chosen = np.zeros_like(seen)
    chosen[::3, ::3] = seen[::3, ::3]
    distance, _ = points_tree.query(points.reshape(*seen.shape, 3)[chosen], distance_upper_bound=reach_m)
    near = np.isfinite(distance)
    return Comparison(
        error=error[chosen][near], edge=edge[chosen][near], unsampled=1.0 - near.mean()
    ), picture


def table_row(name: str, c: Comparison) -> str:
    """One line of the table."""
    hole = np.isnan(c.error)
    size = np.abs(c.error[~hole])
    inner = np.abs(c.error[~hole & ~c.edge])
    with np.errstate(invalid="ignore"):
        nearer, farther = (c.error < -WRONG_M).mean(), (c.error > WRONG_M).mean()
    return (
        f"| {name} | {np.median(size):.3f} | {np.quantile(size, 0.95):.3f} | {np.quantile(inner, 0.95):.3f} "
        f"| {100 * nearer:.2f} | {100 * farther:.2f} | {100 * (inner > WRONG_M).mean():.2f} "
        f"| {100 * hole.mean():.2f} | {100 * c.edge.mean():.1f} | {100 * c.unsampled:.1f} |"
    )


HEADER = (
    "| view | median m | 95 % m | 95 % away from edges m | nearer by > 0.5 m % | farther by > 0.5 m % "
    "| off by > 0.5 m away from edges % | holes % | beside edges % | unsampled % |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def error_picture(rendering: Rendering, error: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colour above; below it errors: grey within 0.5 m, red nearer, blue farther, yellow holes."""
    assert rendering.rgb is not None
    small = np.nan_to_num(np.clip(np.abs(error) / WRONG_M, 0, 1), nan=0.0)
    picture = np.repeat((255 - 110 * small)[..., None], 3, axis=2).astype(np.uint8)
    with np.errstate(invalid="ignore"):
        picture[error < -WRONG_M] = (40, 40, 230)
        picture[error > WRONG_M] = (230, 90, 30)
    picture[np.isposinf(error)] = (0, 220, 255)
    picture[np.isnan(error)] = 0
    return np.vstack([rendering.rgb[..., ::-1], picture])


def measure(scene: Scene, cloud: PointCloud, out: Path | None, options: RenderOptions) -> None:
    """Print the table of one cloud and write a picture per kind of view."""
    print(HEADER)
    tree = cKDTree(cloud.xyz)
    assert cloud.spacing_m is not None
    reach_m = 2.0 * float(np.median(cloud.spacing_m))
    for name, height, pitch in VIEWS:
        parts = []
        for k, (east, north, heading) in enumerate(PLACES):
            pose = look_pose((east, north, height), heading, pitch)
            rendering = render(cloud, CAMERA, pose, options)
            comparison, error = compare(scene, tree, reach_m, rendering)
            parts.append(comparison)
            if out is not None and k == 0:
                path = out / f"{name.replace(' ', '_')}_{len(cloud) // 1000}k.jpg"
                cv2.imwrite(
                    str(path),
                    cv2.resize(
                        error_picture(rendering, error), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
                    ),
                )
        both = Comparison(
            error=np.concatenate([p.error for p in parts]),
            edge=np.concatenate([p.edge for p in parts]),
            unsampled=float(np.mean([p.unsampled for p in parts])),
        )
        print(table_row(name, both), flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--density", type=float, nargs="+", default=[8.0, 25.0], help="rays per m2 from above"
    )
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, help="folder for pictures")
    args = parser.parse_args(argv)
    scene = make_town(args.seed)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
    for density in args.density:
        xyz, rgb = sample_points(scene, density, args.seed)
        cloud = build_cloud(scene.frame, "WGS84 ellipsoid", xyz, rgb=rgb)
        print(f"\n{density:g} rays per m2 from above, {len(cloud)} points\n")
        measure(scene, cloud, args.out, RenderOptions())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
