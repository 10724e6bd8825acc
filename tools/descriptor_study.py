"""Which local features find their like between photos and renders of a scan (paper, figure 4).

    python -m tools.descriptor_study --brighton SCAN.laz PHOTOS poses.json --autzen SCAN.laz ORTHO.tif \\
        --simworld --out docs

Pairs of a picture and a render of known pose: brighton's photos with its coloured scan (poses from `python
-m tools.scan_poses`, to a few centimetres), windows of autzen's ortho image with renders of the scan's
intensity, photos of the simulated town with renders of its airborne scan in intensity, in the colours of an
ortho image of another day, and in shaded relief. Intensities are compared as they are and smoothed
(--smooth-px), for each point has its own noise. Renders are taken from a pose that is wrong as a prior is
(--off-m, --off-deg about the vertical), so that nothing lies where it should.

Each feature of the picture takes its nearest neighbour among the render's. It is right when the scan's
point that the render shows there falls within --tolerance-px of the feature. A feature has a true
correspondence when any of the render's falls so. Recall is right matches over true correspondences,
precision right over all matches kept, as the ratio of distances to the first and second neighbour is
varied; counts are summed over the pairs of a source. Writes descriptors.csv and descriptors.png, in which
sources of earlier runs stay, and prints a table.

Detectors are set to low contrast thresholds, and the strongest --features of each picture are kept. FREAK,
BEBLID, TEBLID, DAISY and VGG describe SIFT's keypoints. SURF is patented and not in the wheels of OpenCV.
"""

import argparse
import csv
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import rasterio
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.spatial import cKDTree

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.lidar.intensity import stretch_of
from featuredb.lidar.ortho import colour_by_ortho, open_ortho
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import render
from featuredb.render.rendering import Rendering
from featuredb.render.shading import shaded_relief
from featuredb.simworld.camera.photograph import take_photo
from featuredb.simworld.camera.sensor import SensorOptions
from featuredb.simworld.camera.shot import look_pose
from featuredb.simworld.flight import FlightOptions, survey
from featuredb.simworld.laser.airborne import scan_town
from featuredb.simworld.laser.scan_options import AirborneScanOptions
from featuredb.simworld.ortho import make_ortho
from featuredb.simworld.town.town import make_town
from tools.worlds.clouds import build_cloud

Floats = NDArray[np.float64]
Gray = NDArray[np.uint8]
Described = tuple[Floats, NDArray[Any]]

RATIOS = (0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)
_FOOT_M = 0.3048
_AUTZEN_OFFSET_PX = (-7.0, -2.0)  # columns, rows by which the ortho image shows things beside the scan
_BORDER_PX = 9  # of what the render shows: features there see its edge
_NOISE_CLASSES = (7, 18)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """A picture, a render, and where the render's pixels are in the picture.

    Attributes:
        source: what is compared. picture, rendered: grey images.
        shown: (h, w) uint8 mask of the render. tolerance_px: within which a match is right.
        to_picture: pixels (n, 2) of the render to pixels (n, 2) of the picture, NaN where there is nothing.
    """

    source: str
    picture: Gray
    rendered: Gray
    shown: Gray
    tolerance_px: float
    to_picture: Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A detector with a descriptor: image and mask to places (n, 2) and descriptors (n, d)."""

    name: str
    binary: bool
    describe: Callable[[Gray, Gray | None], Described]


def methods(count: int) -> list[Method]:
    """All that the installed OpenCV can do."""
    x = cv2.xfeatures2d
    sift = cv2.SIFT_create(contrastThreshold=0.01, enable_precise_upscale=True)
    akaze, kaze = x.AKAZE_create, x.KAZE_create
    upright_mldb = getattr(x, "AKAZE_DESCRIPTOR_MLDB_UPRIGHT", 4)

    def own(detector: Any) -> Callable[[Gray, Gray | None], Described]:
        return lambda image, mask: _describe(detector, detector, image, mask, count, upright=False)

    def on_sift(descriptor: Any, upright: bool = False) -> Callable[[Gray, Gray | None], Described]:
        return lambda image, mask: _describe(sift, descriptor, image, mask, count, upright=upright)

    return [
        Method(name="SIFT", binary=False, describe=on_sift(sift)),
        Method(name="SIFT upright", binary=False, describe=on_sift(sift, upright=True)),
        Method(name="KAZE", binary=False, describe=own(kaze(threshold=2e-4))),
        Method(name="KAZE upright", binary=False, describe=own(kaze(upright=True, threshold=2e-4))),
        Method(name="AKAZE", binary=True, describe=own(akaze(threshold=2e-4))),
        Method(
            name="AKAZE upright",
            binary=True,
            describe=own(akaze(descriptor_type=upright_mldb, threshold=2e-4)),
        ),
        Method(name="ORB", binary=True, describe=own(cv2.ORB_create(nfeatures=count, fastThreshold=5))),
        Method(name="BRISK", binary=True, describe=own(x.BRISK_create(thresh=15))),
        Method(name="FREAK", binary=True, describe=on_sift(x.FREAK_create())),
        Method(name="BEBLID", binary=True, describe=on_sift(x.BEBLID_create(6.75))),
        Method(name="TEBLID", binary=True, describe=on_sift(x.TEBLID_create(6.75))),
        Method(name="TEBLID upright", binary=True, describe=on_sift(x.TEBLID_create(6.75), upright=True)),
        Method(name="DAISY", binary=False, describe=on_sift(x.DAISY_create(use_orientation=True))),
        Method(name="DAISY upright", binary=False, describe=on_sift(x.DAISY_create(), upright=True)),
        Method(name="VGG", binary=False, describe=on_sift(x.VGG_create(scale_factor=6.75))),
        Method(
            name="VGG upright", binary=False, describe=on_sift(x.VGG_create(scale_factor=6.75), upright=True)
        ),
    ]


def _describe(
    detector: Any, descriptor: Any, image: Gray, mask: Gray | None, count: int, *, upright: bool
) -> Described:
    keypoints = sorted(detector.detect(image, mask), key=lambda k: -k.response)
    if upright:
        places = {(k.pt, k.size): k for k in keypoints}  # SIFT gives a place several orientations
        keypoints = sorted(places.values(), key=lambda k: -k.response)
        for keypoint in keypoints:
            keypoint.angle = 0.0
    keypoints, descriptors = descriptor.compute(image, keypoints[:count])
    xy = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    return xy, np.zeros((0, 1), np.float32) if descriptors is None else descriptors


def matched(pair: Pair, method: Method, described: Described) -> tuple[Floats, NDArray[np.bool_], int]:
    """Ratios (n,) and rightness (n,) of the picture's features, and how many could be right."""
    xy, descriptors = described
    there, others = method.describe(pair.rendered, pair.shown)
    if len(xy) == 0 or len(there) < 2:
        return np.empty(0), np.empty(0, bool), 0
    target = pair.to_picture(there)
    good = np.isfinite(target).all(axis=1)
    true = int((cKDTree(target[good]).query(xy)[0] < pair.tolerance_px).sum()) if good.any() else 0
    norm = cv2.NORM_HAMMING if method.binary else cv2.NORM_L2
    found = cv2.BFMatcher(norm).knnMatch(descriptors, others, k=2)
    first = np.array([m[0].trainIdx for m in found])
    distance = np.array([[m[0].distance, m[1].distance] for m in found])
    ratio = distance[:, 0] / np.maximum(distance[:, 1], 1e-9)
    right = np.linalg.norm(target[first] - xy, axis=1) < pair.tolerance_px
    return ratio, right, true


def smoothed(pair: Pair, sigma_px: float) -> Pair:
    """The pair with the render's speckle, a point beside a point, averaged out."""
    rendered = cv2.GaussianBlur(pair.rendered, (0, 0), sigma_px)
    return replace(pair, source=f"{pair.source}, smoothed", rendered=rendered)


def pair_of(
    source: str,
    picture: Gray,
    camera: Camera,
    pose: Rigid3,
    rendering: Rendering,
    gray: Gray,
    tolerance_px: float,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> Pair:
    """A pair whose places are carried over by the render's depth and the picture's true pose."""

    def to_picture(pixels: Floats) -> Floats:
        column, row = np.floor(pixels.T).astype(int)
        z = rendering.depth[row, column].astype(np.float64)
        rays = np.column_stack([rendering.camera.unproject(pixels), np.ones(len(pixels))])
        return camera.project(pose.act(rendering.cam_from_local.inverse().act(rays * z[:, None]))) + shift_px

    shown = cv2.erode(rendering.valid.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8))
    return Pair(
        source=source,
        picture=picture,
        rendered=gray,
        shown=255 * shown,
        tolerance_px=tolerance_px,
        to_picture=to_picture,
    )


def wrong(pose: Rigid3, args: argparse.Namespace, rng: np.random.Generator) -> Rigid3:
    """The pose moved sideways by --off-m and turned about the vertical by --off-deg."""
    way = rng.uniform(0, 2 * np.pi)
    center = pose.center + args.off_m * np.array([np.cos(way), np.sin(way), 0.0])
    turn = so3_exp(np.array([0.0, 0.0, np.radians(args.off_deg) * rng.choice([-1, 1])]))
    rotation = pose.rotation @ turn
    return Rigid3(rotation=rotation, translation=-rotation @ center)


def brighton_pairs(args: argparse.Namespace, rng: np.random.Generator) -> Iterator[Pair]:
    scan, photos, poses = (Path(p) for p in args.brighton)
    found = json.loads(poses.read_text())
    las = laspy.read(scan)
    frame = LocalFrame.from_utm(*found["origin"], int(found["crs"].split(":")[1]))
    utm = np.column_stack([las.x, las.y, las.z])
    rgb = np.column_stack([las.red, las.green, las.blue]).astype(np.uint8)  # 8 bits in 16
    cloud = build_cloud(frame, "unknown", frame.enu_from_utm(utm, int(found["crs"].split(":")[1])), rgb=rgb)
    c = found["camera"]
    full = Camera(model=c["model"], width=c["width"], height=c["height"], params=tuple(c["params"]))
    camera = full.scaled_to(1280, 720)
    for name in sorted(found["poses"])[:: max(1, len(found["poses"]) // args.pairs)][: args.pairs]:
        p = found["poses"][name]
        pose = Rigid3(
            rotation=np.array(p["cam_from_local_rotation"]),
            translation=np.array(p["cam_from_local_translation"]),
        )
        picture = cv2.resize(
            cv2.imread(str(photos / name), cv2.IMREAD_GRAYSCALE), (1280, 720), interpolation=cv2.INTER_AREA
        )
        rendering = render(cloud, camera, wrong(pose, args, rng))
        assert rendering.rgb is not None
        gray = cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2GRAY)
        yield pair_of("brighton, colour", picture, camera, pose, rendering, gray, args.tolerance_px)
        gray = shaded_relief(rendering)
        yield pair_of("brighton, shaded", picture, camera, pose, rendering, gray, args.tolerance_px)


def autzen_pairs(args: argparse.Namespace, rng: np.random.Generator) -> Iterator[Pair]:
    """Windows of the ortho image as photos from 3 km above, in a plane frame of feet made metres."""
    scan, ortho = (Path(p) for p in args.autzen)
    las = laspy.read(scan)
    kept = ~np.isin(np.asarray(las.classification), _NOISE_CLASSES)
    feet = np.column_stack([las.x, las.y, las.z])[kept]
    middle = feet.mean(axis=0)
    frame = LocalFrame(latitude_deg=44.06, longitude_deg=-123.07, height_m=130.0)
    intensity = _bytes_of(np.asarray(las.intensity)[kept])
    cloud = build_cloud(frame, "unknown", (feet - middle) * _FOOT_M, intensity=intensity)
    with rasterio.open(ortho) as file:
        image, transform = np.moveaxis(file.read()[:3], 0, -1), file.transform
    gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    size, height_m = 400, 3000.0
    scale = abs(transform.a) * _FOOT_M
    camera = Camera.from_focal(size, size, height_m / scale, model="SIMPLE_PINHOLE")
    rows = range(50, gray.shape[0] - size - 50, size // 2)
    columns = range(50, gray.shape[1] - size - 50, size // 2)
    places = [(y, x) for y in rows for x in columns]
    for y, x in places[:: max(1, len(places) // (5 * args.pairs))]:  # windows are small
        place = np.array(transform * (x + size / 2, y + size / 2))
        east, north = (place - middle[:2]) * _FOOT_M
        pose = look_pose((east, north, height_m), 0.0, -90.0)
        rendering = render(cloud, camera, wrong(pose, args, rng))
        assert rendering.intensity is not None
        # A feature of the ortho image at p is one of the scan at p + offset.
        shift = (-_AUTZEN_OFFSET_PX[0], -_AUTZEN_OFFSET_PX[1])
        pair = pair_of(
            "autzen, intensity",
            gray[y : y + size, x : x + size],
            camera,
            pose,
            rendering,
            rendering.intensity,
            max(args.tolerance_px, 5.0),  # the offset itself varies by pixels over the picture
            shift,
        )
        yield pair
        yield smoothed(pair, args.smooth_px)


def _bytes_of(raw: NDArray[np.uint16]) -> Gray:
    stretch = stretch_of(np.bincount(raw, minlength=65536), 1.0, 99.0)
    assert stretch is not None
    return stretch.apply(raw)


def simulated_pairs(args: argparse.Namespace, rng: np.random.Generator) -> Iterator[Pair]:
    scene = make_town(args.seed)
    scan = scan_town(scene, AirborneScanOptions(seed=args.seed))
    kept = ~np.isin(scan.classification, _NOISE_CLASSES)
    intensity, utm = _bytes_of(scan.intensity[kept]), scan.utm()[kept]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ortho.tif"
        _write_geotiff(path, make_ortho(scene))
        rgb, _ = colour_by_ortho(utm, scan.epsg, np.repeat(intensity[:, None], 3, axis=1), open_ortho(path))
    cloud: PointCloud = build_cloud(
        scan.frame, "WGS84 ellipsoid", scan.xyz[kept], rgb=rgb, intensity=intensity
    )
    shots = survey(scene, FlightOptions(width=1280), args.seed)
    for shot in shots[:: max(1, len(shots) // args.pairs)][: args.pairs]:
        camera, pose = shot.device.camera, shot.cam_from_local
        picture = cv2.cvtColor(take_photo(scene, shot, SensorOptions()), cv2.COLOR_RGB2GRAY)
        r = render(cloud, camera, wrong(pose, args, rng))
        assert r.rgb is not None
        assert r.intensity is not None
        for name, gray in (
            ("simulated, intensity", r.intensity),
            ("simulated, ortho colours", cv2.cvtColor(r.rgb, cv2.COLOR_RGB2GRAY)),
            ("simulated, shaded", shaded_relief(r)),
        ):
            pair = pair_of(name, picture, camera, pose, r, gray, args.tolerance_px)
            yield pair
            if name.endswith("intensity"):
                yield smoothed(pair, args.smooth_px)


def _write_geotiff(path: Path, ortho: Any) -> None:
    h, w, _ = ortho.rgb.shape
    transform = from_origin(ortho.west, ortho.north, ortho.pixel_m, ortho.pixel_m)
    profile = {"width": w, "height": h, "count": 3, "dtype": "uint8", "crs": f"EPSG:{ortho.epsg}"}
    with rasterio.open(path, "w", driver="GTiff", transform=transform, **profile) as file:
        file.write(np.moveaxis(ortho.rgb, -1, 0))


Counts = dict[tuple[str, str], NDArray[np.int64]]


def study(pairs: Iterator[Pair], kinds: list[Method]) -> tuple[Counts, dict[tuple[str, str], float]]:
    """Right matches, matches and true correspondences (ratios, 3) by source and method, and seconds."""
    counts: Counts = defaultdict(lambda: np.zeros((len(RATIOS), 3), np.int64))
    seconds: dict[tuple[str, str], float] = defaultdict(float)
    picture: Gray | None = None
    described: dict[str, Described] = {}
    for k, pair in enumerate(pairs):
        if pair.picture is not picture:
            picture, described = pair.picture, {m.name: m.describe(pair.picture, None) for m in kinds}
        for method in kinds:
            start = time.process_time()
            ratio, right, true = matched(pair, method, described[method.name])
            seconds[pair.source, method.name] += time.process_time() - start
            for i, limit in enumerate(RATIOS):
                kept = ratio <= limit
                counts[pair.source, method.name][i] += (right[kept].sum(), kept.sum(), true)
        print(f"# pair {k + 1}: {pair.source}", flush=True)
    return counts, seconds


def read_csv(path: Path) -> Counts:
    """Counts of an earlier run; none where there is no file."""
    counts: Counts = defaultdict(lambda: np.zeros((len(RATIOS), 3), np.int64))
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                values = [int(row[name]) for name in ("right", "matches", "true")]
                counts[row["source"], row["feature"]][RATIOS.index(float(row["ratio"]))] = values
    return counts


def write_csv(path: Path, counts: Counts) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["source", "feature", "ratio", "right", "matches", "true", "recall", "precision"])
        for (source, name), table in counts.items():
            for limit, (right, kept, true) in zip(RATIOS, table.tolist(), strict=True):
                recall, precision = right / max(true, 1), right / max(kept, 1)
                out.writerow([source, name, limit, right, kept, true, f"{recall:.4f}", f"{precision:.4f}"])


def draw(path: Path, counts: Counts) -> None:
    """Recall over 1 - precision, one panel per source."""
    sources = list(dict.fromkeys(source for source, _ in counts))
    names = list(dict.fromkeys(name for _, name in counts))
    colours = dict(
        zip(dict.fromkeys(n.split()[0] for n in names), [f"C{i}" for i in range(10)], strict=False)
    )
    across = min(3, len(sources))
    down = -(-len(sources) // across)
    figure = Figure(figsize=(4.3 * across, 3.5 * down), layout="constrained")
    FigureCanvasAgg(figure)
    for i, source in enumerate(sources):
        axes = figure.add_subplot(down, across, i + 1)
        for name in names:
            right, kept, true = counts[source, name].T.astype(float)
            some = kept >= 10  # fewer make no share
            style = "--" if "upright" in name else "-"
            precision = right[some] / kept[some]
            axes.plot(
                1 - precision,
                right[some] / np.maximum(true[some], 1),
                style,
                color=colours[name.split()[0]],
                label=name,
                lw=1.2,
                marker=".",
                ms=3,
            )
        axes.set_title(source, fontsize=9)
        axes.set_xlabel("1 - precision", fontsize=8)
        axes.set_ylabel("recall of true correspondences", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=8, fontsize=7)
    figure.savefig(path, dpi=75)


def print_table(counts: Counts, seconds: dict[tuple[str, str], float]) -> None:
    print(
        "\n| source | feature | true | right at 0.8 (precision) | right at 0.9 (precision) "
        "| right of all (precision) | s |"
    )
    print("|---|---|---|---|---|---|---|")
    for key, table in counts.items():
        cells = []
        for limit in (0.8, 0.9, 1.0):
            right, kept, _ = table[RATIOS.index(limit)]
            cells.append(f"{right} ({100 * right / max(kept, 1):.1f} %)")
        print(f"| {key[0]} | {key[1]} | {table[0, 2]} | {' | '.join(cells)} | {seconds[key]:.1f} |")


def surf_note() -> str:
    try:
        cv2.xfeatures2d.SURF_create()
    except cv2.error as error:
        return f"SURF: {str(error).strip().splitlines()[0]}"
    return "SURF is in this OpenCV, but not in this study"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--brighton", nargs=3, metavar=("SCAN", "PHOTOS", "POSES"))
    parser.add_argument("--autzen", nargs=2, metavar=("SCAN", "ORTHO"))
    parser.add_argument("--simworld", action="store_true")
    parser.add_argument("--pairs", type=int, default=2, help="photos of each source")
    parser.add_argument("--features", type=int, default=1500)
    parser.add_argument("--off-m", type=float, default=6.0)
    parser.add_argument("--off-deg", type=float, default=8.0)
    parser.add_argument("--smooth-px", type=float, default=2.0, help="of renders of intensity, a second time")
    parser.add_argument("--tolerance-px", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    args.out.mkdir(parents=True, exist_ok=True)

    def pairs() -> Iterator[Pair]:
        for wanted, make in (
            (args.brighton, brighton_pairs),
            (args.autzen, autzen_pairs),
            (args.simworld, simulated_pairs),
        ):
            if wanted:
                yield from make(args, np.random.default_rng(args.seed))

    counts, seconds = study(pairs(), methods(args.features))
    print_table(counts, seconds)
    both = read_csv(args.out / "descriptors.csv") | counts
    write_csv(args.out / "descriptors.csv", both)
    draw(args.out / "descriptors.png", both)
    print(surf_note())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
