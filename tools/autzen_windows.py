"""Windows of an ortho image registered to an airborne scan as nadir telephoto photos, from intensity alone.

    python -m tools.autzen_windows STADIUM.laz STADIUM_ORTHO.tif [--photos FOLDER ...] [--seed 0] \\
        [--figure FILE.png]

The scan is added to a database as any other; its colours are thrown away, for they come from that ortho
image. Each window of 400 x 400 pixels becomes the photo of a camera 1000 m above the ground, whose prior is
wrong by 20 m in a random direction of space and by 5 degrees about a random axis: on the ground, up to 107 m.
It is registered by `register_frame` as every photo is, with the defaults and a prior that says so.

An ortho image is laid over the ground: what stands above leans away from where the aircraft was, by as much
as the ground's map is wrong for it, and no camera takes such a picture. So before anything is registered a
window counts as having structure by these measures alone:

- at most half of it is higher than 3 m above the ground around the scan's lowest fifth, and
- of its parts of 25 x 25 pixels on the ground, at least a quarter have an edge in the ortho image and in the
scan:
  a gradient (sigma 2 pixels) whose 95th percentile in the part is above the picture's own 75th percentile.

Ortho image and scan disagree by a few feet: 7 columns and 2 rows, says who described the data. A
window's error is the root mean square, over 16 places of the window, of the distance on the ground between
where the pose puts them and where the ortho image and the offset do.

Refused must be: mirrored windows, windows whose prior lies elsewhere in the scan, photos of other places.
"""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.geo.crs.scan import scan_crs
from featuredb.geo.crs.utm_transform import utm_transform
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.lidar.add import add_scan
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.render.cloud import PointCloud
from featuredb.store.database import Database
from ingest.register.frame.dense.confirmation import MIN_LOG_NFA
from ingest.register.frame.register import register_frame
from ingest.register.frame.verdict import SURE_CONFIRMATION_LOG_NFA
from ingest.register.frame_registration import FramePrior
from tools.figures import study_parser, write_figures

Floats = NDArray[np.float64]
WINDOW_PX = 400
_HIGH_M = 3.0
_STEPS = (225, 200)  # columns, rows between windows
_HEIGHT_M = 1000.0
_OFFSET_PX = (-7.0, -2.0)  # columns, rows
_PRIOR_M, _PRIOR_DEG = 20.0, 5.0
_EACH = 8  # photos of a folder
_KINDS = ("window", "mirrored", "elsewhere", "photo")
_LIMIT_M, _WRONG_M = 1.5, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthoOverScan:
    """The ortho image over the scan: grey values, the pixel grid on the ground, rasters of the scan."""

    gray: NDArray[np.uint8]
    east: Floats  # (h + 1, w + 1) would be exact; a plane fitted to the corners is, to a millimetre
    north: Floats
    ground_m: float
    intensity: NDArray[np.float32]  # (h, w), NaN where no point fell
    high: NDArray[np.bool_]

    def on_ground(self, pixels: Floats) -> Floats:
        """East and north (n, 2) of ortho pixels (n, 2), metres."""
        full = np.column_stack([pixels, np.ones(len(pixels))])
        found: Floats = np.column_stack([full @ self.east, full @ self.north])
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowOutcome:
    """What became of one window; `error_m` is None where no pose was tried."""

    kind: str
    column: int
    row: int
    has_structure: bool
    accepted: bool
    error_m: float | None
    log_nfa: float
    message: str


def main(argv: Sequence[str] | None = None) -> int:
    parser = study_parser(__doc__, "--seed")
    parser.set_defaults(seed=0)
    parser.add_argument("scan", type=Path)
    parser.add_argument("ortho", type=Path)
    parser.add_argument("--figure", type=Path, help="draw evidence against error")
    parser.add_argument("--photos", type=Path, nargs="*", default=[], help="folders of other places")
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db")
        added = add_scan(database, [args.scan])
        frame = scan_frame(added.scan)
        cloud = replace(load_cloud(database, frame), rgb=None)
    print(f"scan: {len(cloud):,} points, {added.scan.height_datum} heights, EPSG:{added.scan.epsg}")
    place = place_of(args.ortho, frame, added.scan.epsg, cloud)
    offset = place.on_ground(np.array([_OFFSET_PX]))[0] - place.on_ground(np.zeros((1, 2)))[0]
    outcomes = []
    for kind, column, row, photo in _photos(place, args.photos):
        rng = np.random.default_rng([args.seed, _KINDS.index(kind), column, row])
        outcome = _one(place, cloud, kind, column, row, photo, offset, rng)
        outcomes.append(outcome)
        print(outcome, flush=True)
    if args.figure is not None:
        _draw(outcomes, args.figure)
    write_figures(args.json, figures_of(outcomes))
    return 0


def place_of(path: Path, frame: LocalFrame, epsg: int, cloud: PointCloud) -> OrthoOverScan:
    """The ortho image at `path` in the frame of a cloud; prints how its pixels lie."""
    with rasterio.open(path) as image:
        bands, affine, wkt = image.read(), image.transform, image.crs.to_wkt()
    gray = np.asarray(cv2.cvtColor(np.moveaxis(bands, 0, -1), cv2.COLOR_RGB2GRAY))
    h, w = gray.shape
    corners = np.array([(x, y) for x in (0.0, w / 2, w) for y in (0.0, h / 2, h)])
    a, b, c, d, e, f = tuple(affine)[:6]
    xy = corners @ np.array([[a, d], [b, e]]) + (c, f)
    xyz = np.column_stack([xy, np.full(len(xy), 0.0)])
    utm = utm_transform(scan_crs(wkt=wkt), xyz.min(0), xyz.max(0), epsg).apply(xyz)
    ground = float(np.percentile(cloud.xyz[:, 2], 20))
    utm[:, 2] = frame.utm_from_enu(np.array([0.0, 0.0, ground]), epsg)[2]
    enu = frame.enu_from_utm(utm, epsg)
    full = np.column_stack([corners, np.ones(len(corners))])
    (east, left), (north, right) = (np.linalg.lstsq(full, enu[:, i], rcond=None)[:2] for i in (0, 1))
    worst = float(np.sqrt(max(left.max(initial=0), right.max(initial=0)) / len(corners)))
    print(f"ortho: {w} x {h} pixels of {np.hypot(east[0], north[0]):.4f} m; flat to {1000 * worst:.1f} mm")
    turn = np.array([[east[0], north[0]], [east[1], north[1]]])
    pixel = np.floor((cloud.xyz[:, :2] - (east[2], north[2])) @ np.linalg.inv(turn)).astype(int)
    inside = ((pixel >= 0) & (pixel < (w, h))).all(axis=1)
    cell = pixel[inside] @ (1, w)
    count = np.bincount(cell, minlength=w * h)
    assert cloud.intensity is not None
    total = np.bincount(cell, cloud.intensity[inside].astype(float), minlength=w * h)
    top = np.full(w * h, -np.inf)
    np.maximum.at(top, cell, cloud.xyz[inside, 2].astype(np.float64))
    intensity = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(h, w)
    high = cv2.dilate((top.reshape(h, w) > ground + _HIGH_M).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return OrthoOverScan(
        gray=gray, east=east, north=north, ground_m=ground, intensity=intensity.astype(np.float32), high=high
    )


def _gradients(picture: NDArray[Any], sigma: float) -> NDArray[np.float32]:
    known = np.isfinite(picture).astype(np.float32)
    filled = np.where(known > 0, picture, 0).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), sigma) / np.maximum(
        cv2.GaussianBlur(known, (0, 0), sigma), 1e-3
    )
    dy, dx = np.gradient(smooth)
    return np.asarray(np.hypot(dx, dy), dtype=np.float32)


def has_structure(place: OrthoOverScan, column: int, row: int) -> bool:
    """Whether a window counts as having structure; the program's help says what that is."""
    window = (slice(row, row + WINDOW_PX), slice(column, column + WINDOW_PX))
    if place.high[window].mean() > 0.5:
        return False
    part, good, parts = 25, 0, 0
    pictures = [_gradients(p.astype(np.float32), 2.0) for p in (place.gray, place.intensity)]
    limits = [float(np.percentile(p, 75)) for p in pictures]
    for r in range(row, row + WINDOW_PX, part):
        for c in range(column, column + WINDOW_PX, part):
            here = (slice(r, r + part), slice(c, c + part))
            if place.high[here].mean() > 0.5:
                continue
            parts += 1
            good += all(np.percentile(p[here], 95) > limit for p, limit in zip(pictures, limits, strict=True))
    return good >= 0.25 * parts


def _photos(
    place: OrthoOverScan, folders: Sequence[Path]
) -> Iterator[tuple[str, int, int, NDArray[np.uint8]]]:
    """Kind, column, row and picture of windows to be found and of those to be refused."""
    h, w = place.gray.shape
    rows, columns = range(0, h - WINDOW_PX + 1, _STEPS[1]), range(0, w - WINDOW_PX + 1, _STEPS[0])
    spots = [(c, r) for r in rows for c in columns]

    def cut(c: int, r: int) -> NDArray[np.uint8]:
        return place.gray[r : r + WINDOW_PX, c : c + WINDOW_PX]

    for c, r in spots:
        yield "window", c, r, cut(c, r)
    for c, r in spots[::3]:
        yield "mirrored", c, r, np.ascontiguousarray(cut(c, r)[:, ::-1])
    for c, r in spots[1::3]:
        # The picture of one end with the prior in the corner farthest from it, out of the search's reach.
        far = (0 if 2 * c >= w - WINDOW_PX else w - WINDOW_PX, 0 if 2 * r >= h - WINDOW_PX else h - WINDOW_PX)
        yield "elsewhere", *far, cut(c, r)
    for i, path in enumerate(_foreign(folders)):
        gray = decode_gray(path)
        scale = 2.2 * WINDOW_PX / max(gray.shape)
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        y, x = (gray.shape[0] - WINDOW_PX) // 2, (gray.shape[1] - WINDOW_PX) // 2
        c, r = spots[i % len(spots)]
        yield "photo", c, r, np.ascontiguousarray(gray[y : y + WINDOW_PX, x : x + WINDOW_PX])


def _foreign(folders: Sequence[Path]) -> list[Path]:
    """A few photos of each folder, spread over it."""
    found = []
    for folder in folders:
        photos = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
        found += photos[:: max(1, len(photos) // _EACH)][:_EACH]
    return found


def _one(
    place: OrthoOverScan,
    cloud: PointCloud,
    kind: str,
    column: int,
    row: int,
    photo: NDArray[np.uint8],
    offset: Floats,
    rng: np.random.Generator,
) -> WindowOutcome:
    camera, truth = _nadir_camera(place, column, row)
    prior = _wrong_prior(truth, rng)
    found = register_frame(photo, camera, prior, cloud)
    tried = found.evidence.get("pose_tried")
    error = None
    if tried is not None:
        error = _ground_error(place, camera, Rigid3.from_matrix(tried), column, row, offset)
    return WindowOutcome(
        kind=kind,
        column=column,
        row=row,
        has_structure=has_structure(place, column, row),
        accepted=found.accepted,
        error_m=error,
        log_nfa=found.evidence.get("confirmation", {}).get("log_nfa", 0.0),
        message=f"{found.reason}: {found.message}" if found.reason else "",
    )


def _nadir_camera(place: OrthoOverScan, column: int, row: int) -> tuple[Camera, Rigid3]:
    """The camera that would have taken the window, its heading that of the ortho image's columns."""
    middle = place.on_ground(np.array([[column + WINDOW_PX / 2, row + WINDOW_PX / 2]]))[0]
    right = np.array([place.east[0], place.north[0], 0.0])
    pixel_m = float(np.linalg.norm(right))
    right /= pixel_m
    forward = np.array([0.0, 0.0, -1.0])
    rotation = np.array([right, np.cross(forward, right), forward])
    center = np.array([*middle, place.ground_m + _HEIGHT_M])
    camera = Camera.from_focal(WINDOW_PX, WINDOW_PX, _HEIGHT_M / pixel_m, "SIMPLE_PINHOLE")
    return camera, Rigid3(rotation=rotation, translation=-rotation @ center)


def _wrong_prior(truth: Rigid3, rng: np.random.Generator) -> FramePrior:
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    center = truth.center + _PRIOR_M * shift / np.linalg.norm(shift)
    rotation = so3_exp(np.radians(_PRIOR_DEG) * axis / np.linalg.norm(axis)) @ truth.rotation
    # 20 m in space and 5 degrees about any axis, by axis.
    sigma_m, sigma_deg = _PRIOR_M / np.sqrt(3.0), _PRIOR_DEG / np.sqrt(3.0)
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        sigma_horizontal_m=sigma_m,
        sigma_vertical_m=sigma_m,
        sigma_heading_deg=sigma_deg,
        sigma_tilt_deg=sigma_deg,
    )


def _ground_error(
    place: OrthoOverScan, camera: Camera, pose: Rigid3, column: int, row: int, offset: Floats
) -> float:
    spots = np.array([(x, y) for y in (50.0, 150.0, 250.0, 350.0) for x in (50.0, 150.0, 250.0, 350.0)])
    rays = np.column_stack([camera.unproject(spots), np.ones(len(spots))]) @ pose.rotation
    found = pose.center + rays * ((place.ground_m - pose.center[2]) / rays[:, 2:])
    wanted = place.on_ground(spots + np.array([column, row])) + offset
    return float(np.sqrt(((found[:, :2] - wanted) ** 2).sum(axis=1).mean()))


def _draw(outcomes: Sequence[WindowOutcome], path: Path) -> None:
    """Evidence of the pictures against the error on the ground, with the verdict's two lines."""
    chart = Figure(figsize=(7.5, 3.6), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(chart)
    axes = chart.subplots()
    looks = {"window": ("o", "#2e7d32"), "mirrored": ("x", "#c62828"), "elsewhere": ("+", "#ad1457")}
    for kind in _KINDS:
        marker, colour = looks.get(kind, ("^", "#6a1b9a"))
        some = np.array(
            [(o.error_m, o.log_nfa) for o in outcomes if o.kind == kind and o.error_m is not None]
        )
        if len(some):
            axes.plot(some[:, 0], some[:, 1], marker, color=colour, ms=5, label=kind)
    for limit in (SURE_CONFIRMATION_LOG_NFA, MIN_LOG_NFA):
        axes.axhline(limit, color="#1b2733", lw=0.8, ls="--")
    axes.set(xscale="log", xlabel="error on the ground, m", ylabel="evidence, -log10(NFA)", ylim=(0, None))
    axes.legend(fontsize=8)
    axes.grid(color="#e6ebef", lw=0.6)
    chart.savefig(path)


def figures_of(outcomes: Sequence[WindowOutcome]) -> dict[str, float]:
    """How many windows are found, and how many of what has to be refused is accepted."""
    windows = [o for o in outcomes if o.kind == "window"]
    structured = [o for o in windows if o.has_structure]
    close = [o for o in structured if o.accepted and o.error_m is not None and o.error_m <= _LIMIT_M]
    wrong = [o for o in windows if o.accepted and (o.error_m is None or o.error_m > _WRONG_M)]
    foreign = [o for o in outcomes if o.kind != "window"]
    errors = [o.error_m for o in windows if o.accepted and o.error_m is not None]
    return {
        "structured": len(structured),
        "close": len(close),
        "rate": len(close) / max(len(structured), 1),
        "largest_m": max(errors, default=float("nan")),
        "wrong": len(wrong),
        "foreign": len(foreign),
        "foreign_accepted": sum(o.accepted for o in foreign),
    }


if __name__ == "__main__":
    sys.exit(main())
