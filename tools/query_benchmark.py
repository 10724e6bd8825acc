"""How long one query takes, step by step, beside the same query done by pycolmap alone.

    uv run python tools/query_benchmark.py DB IMAGE... --photos FOLDER [--repeat 5]

Ours: each image with its own GPS as prior, decoded, localised and answered in this process, and then the
same over Zenoh on loopback; medians over images and repeats. The stages of each answer must add up to the
measured wall time within 1 ms and 2 %; transport is the client's wall time less the server's own.

pycolmap alone, on one thread, for the first --pycolmap-images of the images: its SIFT of the query, its
matcher against the features of every image of the map (extracted once, outside the clock), and its robust
and refined absolute pose. Its image side and feature limit are ours unless --own-limits. It needs 3D points
for its keypoints: a keypoint of a map image takes the point whose observation by our map lies within 1.5
pixels (at 1600). Both find extrema of the same scale space, so most of them coincide, and no second
reconstruction with errors of its own comes between the two poses that are compared. All observations of the
map serve, also those that carry no descriptor for us.

Exit code 0 if the median with a prior is within 250 ms with transport under 10 ms and the sums hold, else 1.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.features.decode import DEFAULT_LIMITS, decode_gray
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, rotation_angle
from featuredb.maps.feature_map import FeatureMap
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from reloc.client import Client, LocaliseReply
from reloc.localise.options import LocaliseOptions
from reloc.localise.search import camera_hypotheses
from reloc.localiser import Localiser
from reloc.service.handler import answer_query, localise_request
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from reloc.service.threads import capped_process
from reloc.wire.query import LocaliseWireRequest, RequestOptions
from tools.figures import add_json_option, write_figures

MAX_QUERY_MS, MAX_TRANSPORT_MS = 250.0, 10.0
_SUM_TOLERANCE_MS, _SUM_TOLERANCE_REL = 1.0, 0.02
_SAME_KEYPOINT_REL = 1.5 / 1600.0  # of the longer side: two detectors on one structure
_WITH_PRIOR = LocaliseWireRequest(options=RequestOptions(exif_prior=True))
# Steps of ours that do the work of one of pycolmap's.
_STEPS = {
    "decode": ("decode", "exif"),
    "features": ("features",),
    "matching": ("candidates", "matching"),
    "pose": ("pose", "guided", "answer", "localise_rest", "reply"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Timed:
    """One query.

    Attributes:
        wall_ms: measured from outside.
        stages_ms: as the answer says them, without their total.
        total_ms: of the stages, as the answer says it.
    """

    reply: LocaliseReply
    wall_ms: float
    stages_ms: dict[str, float]
    total_ms: float

    @property
    def adds_up(self) -> bool:
        """Whether the stages account for the wall time."""
        tolerance_ms = _SUM_TOLERANCE_MS + _SUM_TOLERANCE_REL * self.wall_ms
        return abs(sum(self.stages_ms.values()) - self.wall_ms) <= tolerance_ms


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alone:
    """One query by pycolmap alone.

    Attributes:
        cam_from_local: pose in the map's frame, None where it found none.
    """

    stages_ms: dict[str, float]
    inliers: int
    matches: int
    cam_from_local: Rigid3 | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColmapMap:
    """pycolmap's features of the map images, and the 3D points of those keypoints that have one.

    Attributes:
        images: (keypoints, descriptors, (n,) row of `points` or -1) for each map image.
        points: (p, 3) metres in the map's frame.
    """

    images: list[tuple[Any, Any, NDArray[np.int64]]]
    points: FloatArray


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database = Database.open(args.db)
    with capped_process(args.threads):
        localiser = Localiser.open(database)
        direct = run_direct(localiser, args.images, args.repeat)
        served = run_served(database, args.images, args.repeat, args.threads)
        holds, figures = report_ours(direct, served)
        if args.pycolmap_images:
            compare(localiser, database, args, direct)
    write_figures(args.json, figures)
    return 0 if holds else 1


def run_direct(localiser: Localiser, images: Sequence[Path], repeat: int) -> list[Timed]:
    """Each image `repeat` times in this process, after one round that is not counted."""

    def ask(data: bytes) -> LocaliseReply:
        return answer_query(
            data,
            _WITH_PRIOR,
            localiser,
            limits=DEFAULT_LIMITS,
            request_id="",
            clock=StageClock(),
        )

    return _rounds(ask, images, repeat)


def run_served(database: Database, images: Sequence[Path], repeat: int, threads: int) -> list[Timed]:
    """The same over Zenoh."""
    options = ServeOptions(listen=("tcp/127.0.0.1:0",), threads_per_worker=threads)
    with start_server(database, options) as server, Client(server.endpoints[0]) as client:
        return _rounds(lambda data: client.localise(data, exif_prior=True, timeout_s=60.0), images, repeat)


def _rounds(ask: Callable[[bytes], LocaliseReply], images: Sequence[Path], repeat: int) -> list[Timed]:
    timed = []
    contents = [path.read_bytes() for path in images]
    for number in range(repeat + 1):
        for data in contents:
            start = time.perf_counter()
            reply = ask(data)
            wall_ms = 1e3 * (time.perf_counter() - start)
            stages = {name: ms for name, ms in reply.timings_ms.items() if name != "total"}
            if number:
                timed.append(
                    Timed(reply=reply, wall_ms=wall_ms, stages_ms=stages, total_ms=reply.timings_ms["total"])
                )
    return timed


def report_ours(direct: Sequence[Timed], served: Sequence[Timed]) -> tuple[bool, dict[str, float]]:
    """Print both ways of asking; whether the promises hold, and the figures."""
    names = list(dict.fromkeys(name for one in served for name in one.stages_ms))
    lines = [f"{'median ms':<16}{'in process':>12}{'over Zenoh':>12}"]
    for name in names:
        a, b = (median(one.stages_ms.get(name, 0.0) for one in group) for group in (direct, served))
        lines.append(f"{name:<16}{a:>12.2f}{b:>12.2f}")
    transport = [one.wall_ms - one.total_ms for one in served]
    walls = [median(one.wall_ms for one in group) for group in (direct, served)]
    lines.append(f"{'transport':<16}{'':>12}{median(transport):>12.2f}")
    lines.append(f"{'wall':<16}{walls[0]:>12.2f}{walls[1]:>12.2f}")
    adding = sum(one.adds_up for one in direct)
    localised = sum(one.reply.status == "localised" for one in served)
    checks = {
        f"{adding} of {len(direct)} answers in process add up to their wall time": adding == len(direct),
        f"median over Zenoh {walls[1]:.0f} ms, at most {MAX_QUERY_MS:.0f}": walls[1] <= MAX_QUERY_MS,
        f"median transport {median(transport):.1f} ms, under {MAX_TRANSPORT_MS:.0f}": (
            median(transport) < MAX_TRANSPORT_MS
        ),
        f"{localised} of {len(served)} localised": localised == len(served),
    }
    lines += [f"{'holds' if holds else 'FAILS'}  {text}" for text, holds in checks.items()]
    sys.stdout.write("\n".join(lines) + "\n\n")
    sys.stdout.flush()
    figures = {
        "wall_ms": walls[1],
        "in_process_ms": walls[0],
        "transport_ms": median(transport),
        "asked": len(served),
        "localised": localised,
    }
    return all(checks.values()), figures


def compare(
    localiser: Localiser, database: Database, args: argparse.Namespace, direct: Sequence[Timed]
) -> None:
    """The first images by pycolmap alone, step by step beside ours."""
    snapshot = database.snapshot()
    (summary, *_) = sorted((m for m in snapshot.maps() if m.status == "active"), key=lambda m: -m.images)
    feature_map = snapshot.load_map(summary.map_id)
    extractor = colmap_extractor(own_limits=args.own_limits)
    start = time.perf_counter()
    colmap_map = colmap_features(feature_map, args.photos, extractor, _max_side(args.own_limits))
    known = sum(int((rows >= 0).sum()) for _, _, rows in colmap_map.images)
    total = sum(len(rows) for _, _, rows in colmap_map.images)
    sys.stdout.write(
        f"pycolmap {pycolmap.__version__}: {total} features of {len(colmap_map.images)} map images in "
        f"{time.perf_counter() - start:.0f} s (not counted), {known} with a 3D point\n"
    )
    for number, path in enumerate(args.images[: args.pycolmap_images]):
        ours = [one for i, one in enumerate(direct) if i % len(args.images) == number]
        alone = ask_alone(path, feature_map, colmap_map, localiser, extractor, args.own_limits)
        sys.stdout.write(_comparison(path.name, ours, alone, feature_map) + "\n")
        sys.stdout.flush()


def _max_side(own_limits: bool) -> int:
    return 3200 if own_limits else LocaliseOptions().extractor.max_side_px  # 3200: COLMAP's own


def colmap_extractor(*, own_limits: bool) -> Any:
    """pycolmap's SIFT on one CPU thread."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    if not own_limits:
        options.sift.max_num_features = LocaliseOptions().extractor.max_features
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def extract_alone(gray: NDArray[np.uint8], extractor: Any, max_side: int) -> tuple[Any, Any, FloatArray]:
    """Keypoints, descriptors, and the keypoints' pixels (n, 2) in the full image."""
    height, width = gray.shape
    factor = min(1.0, max_side / max(height, width))
    if factor < 1.0:
        size = round(width * factor), round(height * factor)
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    keypoints, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    xy = np.array([(k.x, k.y) for k in keypoints], dtype=np.float64).reshape(-1, 2)
    return keypoints, descriptors, xy * [width / gray.shape[1], height / gray.shape[0]]


def colmap_features(feature_map: FeatureMap, photos: Path, extractor: Any, max_side: int) -> ColmapMap:
    """Features of the map's photos and the points that they are observations of."""
    images = []
    seen = feature_map.observations
    for image in feature_map.images:
        camera = feature_map.cameras[image.camera_id]
        keypoints, descriptors, xy = extract_alone(decode_gray(photos / image.name), extractor, max_side)
        mine = seen.image_id == image.image_id
        reach_px = _SAME_KEYPOINT_REL * max(camera.width, camera.height)
        near, row = cKDTree(seen.xy[mine]).query(xy, distance_upper_bound=reach_px)
        point = np.append(seen.point_index[mine], -1)[np.where(np.isfinite(near), row, -1)]
        images.append((keypoints, descriptors, point))
    return ColmapMap(images=images, points=feature_map.points_local())


def ask_alone(
    path: Path,
    feature_map: FeatureMap,
    colmap_map: ColmapMap,
    localiser: Localiser,
    extractor: Any,
    own_limits: bool,
) -> Alone:
    """One query by pycolmap, its steps timed."""
    clock = StageClock()
    data = path.read_bytes()
    gray = decode_gray(data)
    clock.lap("decode")
    keypoints, descriptors, xy = extract_alone(gray, extractor, _max_side(own_limits))
    clock.lap("features")
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 1
    matcher = pycolmap.FeatureMatcher.create(matching, pycolmap.Device.cpu)
    pairs = set()
    for other, other_descriptors, point in colmap_map.images:
        found = matcher.match(keypoints, descriptors, other, other_descriptors)
        pairs |= {(int(q), int(point[m])) for q, m in np.asarray(found) if point[m] >= 0}
    clock.lap("matching")
    rows = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    pose, inliers = _pose_alone(gray, data, xy[rows[:, 0]], colmap_map.points[rows[:, 1]], localiser)
    clock.lap("pose")
    return Alone(
        stages_ms={step: 1e3 * s for step, s in clock.seconds.items()},
        inliers=inliers,
        matches=len(rows),
        cam_from_local=pose,
    )


def _pose_alone(
    gray: NDArray[np.uint8], data: bytes, pixels: FloatArray, points: FloatArray, localiser: Localiser
) -> tuple[Rigid3 | None, int]:
    """Its absolute pose with the lens that our localisation starts from, and our inlier tolerance."""
    request = localise_request(_WITH_PRIOR, data, gray)
    nothing = _no_features(gray)
    camera, source = camera_hypotheses(nothing, localiser.areas[0].area, request)[0]
    estimation, refinement = (
        pycolmap.AbsolutePoseEstimationOptions(),
        pycolmap.AbsolutePoseRefinementOptions(),
    )
    estimation.ransac.max_error = LocaliseOptions().pose.tolerance_rel * max(gray.shape)
    estimation.ransac.random_seed = 0
    estimation.estimate_focal_length = refinement.refine_focal_length = source in ("exif", "estimated")
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, camera.to_pycolmap(), estimation, refinement
    )
    if found is None:
        return None, 0
    return Rigid3.from_matrix(np.asarray(found["cam_from_world"].matrix())), int(found["num_inliers"])


def _no_features(gray: NDArray[np.uint8]) -> Features:
    """The image's size is all that the choice of a lens asks for."""
    none = np.zeros(0, np.float32)
    return Features(
        xy=np.zeros((0, 2), np.float32),
        scale=none,
        angle=none,
        response=none,
        descriptors=np.zeros((0, 128), np.uint8),
        width=gray.shape[1],
        height=gray.shape[0],
        fingerprint="",
    )


def _comparison(name: str, ours: Sequence[Timed], alone: Alone, feature_map: FeatureMap) -> str:
    lines = [f"{name:<24}{'ours ms':>10}{'pycolmap ms':>13}{'ratio':>8}"]
    mine = {
        step: median(sum(one.stages_ms.get(part, 0.0) for part in parts) for one in ours)
        for step, parts in _STEPS.items()
    }
    for step, ms in [*mine.items(), ("all", sum(mine.values()))]:
        theirs = sum(alone.stages_ms.values()) if step == "all" else alone.stages_ms[step]
        lines.append(f"  {step:<22}{ms:>10.1f}{theirs:>13.1f}{theirs / ms:>8.1f}")
    reply = ours[0].reply
    lines.append(
        f"  inliers of matches: ours {reply.inliers} of {reply.matches}, pycolmap {alone.inliers} of "
        f"{alone.matches}"
    )
    if reply.utm is None or alone.cam_from_local is None:
        lines.append(f"  ours: {reply.detail}; pycolmap: {'a pose' if alone.cam_from_local else 'no pose'}")
        return "\n".join(lines)
    utm = np.array([reply.utm.easting, reply.utm.northing, reply.utm.height])
    center = feature_map.frame.enu_from_utm(utm, reply.utm.epsg)
    grid = feature_map.frame.grid_from_enu(center, reply.utm.epsg)
    rotation = matrix_from_quaternion(reply.utm.cam_from_utm_xyzw) @ grid
    apart = float(np.linalg.norm(center - alone.cam_from_local.center))
    angle = float(np.degrees(rotation_angle(rotation @ alone.cam_from_local.rotation.T)))
    lines.append(f"  the two poses lie {apart:.3f} m and {angle:.3f} degrees apart")
    return "\n".join(lines)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("db")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE")
    parser.add_argument("--photos", type=Path, required=True, help="the folder that the map was made of")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2, help="of our query; default: 2")
    parser.add_argument(
        "--pycolmap-images",
        type=int,
        default=1,
        metavar="N",
        help="images that pycolmap is asked too; a minute and more each; default: 1",
    )
    add_json_option(parser)
    parser.add_argument("--own-limits", action="store_true", help="pycolmap's own image size and limits")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
