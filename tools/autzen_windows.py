"""Windows of an ortho image registered to an airborne scan as nadir telephoto photos, from intensity alone.

    python -m tools.autzen_windows STADIUM.laz STADIUM_ORTHO.tif [--photos FOLDER ...] [--json OUT] [--seed 0]
    python -m tools.autzen_windows --given OUT ... --figure docs/figures/autzen_windows.png

The scan is added to a database as any other; its colours are thrown away, for they come from that ortho
image. Each window of 400 x 400 pixels becomes the photo of a camera 1000 m above the ground, whose prior is
wrong by 20 m in a random direction of space and by 5 degrees about a random axis: on the ground, up to 107 m.

An ortho image is laid over the ground: what stands above leans away from where the aircraft was, by as much
as the ground's map is wrong for it, and no camera takes such a picture. So before anything is registered a
window counts as having structure by these measures alone:

- at most half of it is higher than 3 m above the ground around the scan's lowest fifth, and
- of its parts of 25 x 25 pixels on the ground, at least a quarter have an edge in the ortho image and in the
scan:
  a gradient (sigma 2 pixels) whose 95th percentile in the part is above the picture's own 75th percentile.

Ortho image and scan disagree by a few feet: 7 columns and 2 rows, says who described the data. That offset is
checked here, from the whole picture and from its quarters, by the correlation of gradient magnitudes over
shifts, with rasters made by counting points into cells: nothing of it is shared with the registration. A
window's error is the root mean square, over 16 places of the window, of the distance on the ground between
where the pose puts them and where the ortho image and the offset do.

Refused must be: mirrored windows, windows whose prior lies elsewhere in the scan, photos of other places.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.geo.crs import scan_crs, utm_transform
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.lidar.add import add_scan
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.render.cloud import PointCloud
from featuredb.store.database import Database
from ingest.register.frame.dense_registration import PICTURES_ALONE, register_by_pictures
from ingest.register.frame_registration import FramePrior

Floats = NDArray[np.float64]
_SIZE = 400  # pixels of a window
_STEPS = (225, 200)  # columns, rows between windows
_HEIGHT_M = 1000.0
_PRIOR_M, _PRIOR_DEG = 20.0, 5.0
_HIGH_M = 3.0
_REACH = 40  # pixels of shift searched for the offset
_KINDS = ("window", "mirrored", "elsewhere", "photo")
_LIMIT_M, _WRONG_M, _WANTED = 1.5, 5.0, 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
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
class Outcome:
    """What became of one window."""

    kind: str
    column: int
    row: int
    has_structure: bool
    accepted: bool
    error_m: float | None
    message: str
    share: float
    score: float
    log_nfa: float
    seconds: float
    pose: list[list[float]] | None


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    cv2.setNumThreads(1)
    if args.given:
        rows = [row for path in args.given for row in json.loads(path.read_text())["rows"]]
        return _report([Outcome(**row) for row in rows], args.figure)
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db")
        added = add_scan(database, [args.scan])
        frame = scan_frame(added.scan)
        cloud = replace(load_cloud(database, frame), rgb=None)
    print(f"scan: {len(cloud):,} points, {added.scan.height_datum} heights, EPSG:{added.scan.epsg}")
    place = _place(args.ortho, frame, added.scan.epsg, cloud)
    measured = _measured_offset(place)
    offset = place.on_ground(np.array([args.offset]))[0] - place.on_ground(np.zeros((1, 2)))[0]
    apart = float(np.hypot(*(offset - measured)))
    taken = f"columns {args.offset[0]:+g}, rows {args.offset[1]:+g}"
    print(f"offset taken: {taken}; the measured one is {apart:.2f} m from it")
    outcomes = []
    for kind, column, row, photo in _photos(place, args.photos, args.count):
        if kind not in args.kinds:
            continue
        rng = np.random.default_rng([args.seed, _KINDS.index(kind), column, row])
        outcome = _one(place, cloud, kind, column, row, photo, offset, rng)
        outcomes.append(outcome)
        print(_line(outcome), flush=True)
    if args.json:
        args.json.write_text(json.dumps({"offset_m": offset.tolist(), "rows": [asdict(o) for o in outcomes]}))
    return _report(outcomes, args.figure)


def _place(path: Path, frame: LocalFrame, epsg: int, cloud: PointCloud) -> Place:
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
    return Place(
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


def _measured_offset(place: Place) -> Floats:
    """Where the scan has what the ortho image shows, less where the image does: (2,) metres east, north."""
    ortho, scan = _gradients(place.gray.astype(np.float32), 1.0), _gradients(place.intensity, 1.5)
    ok = ~place.high
    h, w = ortho.shape
    halves = [(slice(0, h // 2), "north"), (slice(h // 2, h), "south")]
    sides = [(slice(0, w // 2), "west"), (slice(w // 2, w), "east")]
    parts = [(f"{a} {b}", rows, columns) for rows, a in halves for columns, b in sides]
    found = np.zeros(2)
    for name, rows, columns in [*parts, ("whole", slice(0, h), slice(0, w))]:
        found, height = _best_shift(ortho[rows, columns], scan[rows, columns], ok[rows, columns])
        print(f"offset, {name}: columns {found[0]:+.1f}, rows {found[1]:+.1f}, correlation {height:.3f}")
    offset: Floats = place.on_ground(found[None])[0] - place.on_ground(np.zeros((1, 2)))[0]
    return offset


def _best_shift(a: NDArray[Any], b: NDArray[Any], ok: NDArray[np.bool_]) -> tuple[Floats, float]:
    """The shift (columns, rows) of b against a with the highest correlation, to a fraction of a pixel."""
    inner = np.zeros(a.shape, bool)
    inner[_REACH:-_REACH, _REACH:-_REACH] = True
    rows, columns = np.nonzero(inner & ok)
    values = a[rows, columns] - a[rows, columns].mean()
    reach = 15
    grid = np.empty((2 * reach + 1, 2 * reach + 1))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            other = b[rows + i, columns + j]
            other = other - other.mean()
            grid[i + reach, j + reach] = values @ other / np.sqrt((values @ values) * (other @ other))
    i, j = (int(np.clip(k, 1, 2 * reach - 1)) for k in divmod(int(grid.argmax()), 2 * reach + 1))

    def top(low: float, middle: float, high: float) -> float:
        return 0.5 * (high - low) / max(2 * middle - low - high, 1e-9)

    x = j - reach + top(grid[i, j - 1], grid[i, j], grid[i, j + 1])
    y = i - reach + top(grid[i - 1, j], grid[i, j], grid[i + 1, j])
    return np.asarray([x, y], dtype=np.float64), float(grid.max())


def _has_structure(place: Place, column: int, row: int) -> bool:
    window = (slice(row, row + _SIZE), slice(column, column + _SIZE))
    if place.high[window].mean() > 0.5:
        return False
    part, good, parts = 25, 0, 0
    pictures = [_gradients(p.astype(np.float32), 2.0) for p in (place.gray, place.intensity)]
    limits = [float(np.percentile(p, 75)) for p in pictures]
    for r in range(row, row + _SIZE, part):
        for c in range(column, column + _SIZE, part):
            here = (slice(r, r + part), slice(c, c + part))
            if place.high[here].mean() > 0.5:
                continue
            parts += 1
            good += all(np.percentile(p[here], 95) > limit for p, limit in zip(pictures, limits, strict=True))
    return good >= 0.25 * parts


def _photos(
    place: Place, folders: Sequence[Path], count: int | None
) -> Iterator[tuple[str, int, int, NDArray[np.uint8]]]:
    """Kind, column, row and picture of windows to be found and of those to be refused."""
    h, w = place.gray.shape
    spots = [(c, r) for r in range(0, h - _SIZE + 1, _STEPS[1]) for c in range(0, w - _SIZE + 1, _STEPS[0])]
    spots = spots[:count]
    for c, r in spots:
        yield "window", c, r, place.gray[r : r + _SIZE, c : c + _SIZE]
    for c, r in spots[::3]:
        yield "mirrored", c, r, np.ascontiguousarray(place.gray[r : r + _SIZE, c : c + _SIZE][:, ::-1])
    for c, r in spots[1::3]:
        # The picture of one end with the prior in the corner farthest from it, out of the search's reach.
        far = (0 if 2 * c >= w - _SIZE else w - _SIZE, 0 if 2 * r >= h - _SIZE else h - _SIZE)
        yield "elsewhere", *far, place.gray[r : r + _SIZE, c : c + _SIZE]
    for i, path in enumerate(_foreign(folders, 8)):
        gray = decode_gray(path)
        scale = 2.2 * _SIZE / max(gray.shape)
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        y, x = (gray.shape[0] - _SIZE) // 2, (gray.shape[1] - _SIZE) // 2
        c, r = spots[i % len(spots)]
        yield "photo", c, r, np.ascontiguousarray(gray[y : y + _SIZE, x : x + _SIZE])


def _foreign(folders: Sequence[Path], each: int) -> list[Path]:
    """A few photos of each folder, spread over it."""
    found = []
    for folder in folders:
        photos = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
        found += photos[:: max(1, len(photos) // each)][:each]
    return found


def _one(
    place: Place,
    cloud: PointCloud,
    kind: str,
    column: int,
    row: int,
    photo: NDArray[np.uint8],
    offset: Floats,
    rng: np.random.Generator,
) -> Outcome:
    camera, truth = _nadir_camera(place, column, row)
    prior = _wrong_prior(truth, rng)
    start = time.process_time()
    pose, confirmation = register_by_pictures(photo, camera, prior, cloud, "intensity")
    seconds = time.process_time() - start
    error = None if pose is None else _ground_error(place, camera, pose.cam_from_local, column, row, offset)
    return Outcome(
        kind=kind,
        column=column,
        row=row,
        has_structure=_has_structure(place, column, row),
        accepted=bool(confirmation and confirmation.confirmed),
        error_m=error,
        message=confirmation.message if confirmation else "nothing to search for",
        share=confirmation.share if confirmation else 0.0,
        score=confirmation.score if confirmation else 0.0,
        log_nfa=confirmation.log_nfa if confirmation else 0.0,
        seconds=seconds,
        pose=None
        if pose is None
        else np.column_stack([pose.cam_from_local.rotation, pose.cam_from_local.translation]).tolist(),
    )


def _nadir_camera(place: Place, column: int, row: int) -> tuple[Camera, Rigid3]:
    """The camera that would have taken the window, its heading that of the ortho image's columns."""
    middle = place.on_ground(np.array([[column + _SIZE / 2, row + _SIZE / 2]]))[0]
    right = np.array([place.east[0], place.north[0], 0.0])
    pixel_m = float(np.linalg.norm(right))
    right /= pixel_m
    forward = np.array([0.0, 0.0, -1.0])
    rotation = np.array([right, np.cross(forward, right), forward])
    center = np.array([*middle, place.ground_m + _HEIGHT_M])
    camera = Camera.from_focal(_SIZE, _SIZE, _HEIGHT_M / pixel_m, "SIMPLE_PINHOLE")
    return camera, Rigid3(rotation=rotation, translation=-rotation @ center)


def _wrong_prior(truth: Rigid3, rng: np.random.Generator) -> FramePrior:
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    center = truth.center + _PRIOR_M * shift / np.linalg.norm(shift)
    rotation = so3_exp(np.radians(_PRIOR_DEG) * axis / np.linalg.norm(axis)) @ truth.rotation
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        # 20 m in space and 5 degrees about any axis, by axis.
        sigma_horizontal_m=_PRIOR_M / np.sqrt(3.0),
        sigma_vertical_m=_PRIOR_M / np.sqrt(3.0),
        sigma_heading_deg=_PRIOR_DEG / np.sqrt(3.0),
        sigma_tilt_deg=_PRIOR_DEG / np.sqrt(3.0),
    )


def _ground_error(place: Place, camera: Camera, pose: Rigid3, column: int, row: int, offset: Floats) -> float:
    spots = np.array([(x, y) for y in (50.0, 150.0, 250.0, 350.0) for x in (50.0, 150.0, 250.0, 350.0)])
    rays = np.column_stack([camera.unproject(spots), np.ones(len(spots))]) @ pose.rotation
    found = pose.center + rays * ((place.ground_m - pose.center[2]) / rays[:, 2:])
    wanted = place.on_ground(spots + np.array([column, row])) + offset
    return float(np.sqrt(((found[:, :2] - wanted) ** 2).sum(axis=1).mean()))


def _line(o: Outcome) -> str:
    error = "-" if o.error_m is None else f"{o.error_m:.2f}"
    return (
        f"{o.kind:9} {o.column:4} {o.row:4} structure {o.has_structure!s:5} accepted {o.accepted!s:5} "
        f"error {error:>6} m  share {o.share:.2f} score {o.score:.2f} log_nfa {o.log_nfa:5.1f} "
        f"{o.seconds:.1f} s  {o.message}"
    )


def _report(outcomes: Sequence[Outcome], figure: Path | None) -> int:
    if figure is not None:
        _draw(outcomes, figure)
    return _summary(outcomes)


def _draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Share of agreeing pieces against the error on the ground, with the line of the verdict."""
    chart = Figure(figsize=(7.5, 3.6), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(chart)
    axes = chart.subplots()
    looks = {"window": ("o", "#2e7d32"), "mirrored": ("x", "#c62828"), "elsewhere": ("+", "#ad1457")}
    for kind in _KINDS:
        marker, colour = looks.get(kind, ("^", "#6a1b9a"))
        some = np.array([(o.error_m, o.share) for o in outcomes if o.kind == kind and o.error_m is not None])
        if len(some):
            axes.plot(some[:, 0], some[:, 1], marker, color=colour, ms=5, label=kind)
    axes.axhline(PICTURES_ALONE.min_agreeing, color="#1b2733", lw=0.8, ls="--")
    axes.set(
        xscale="log", xlabel="error on the ground, m", ylabel="share of pieces that agree", ylim=(0, None)
    )
    axes.legend(fontsize=8)
    axes.grid(color="#e6ebef", lw=0.6)
    chart.savefig(path)


def _summary(outcomes: Sequence[Outcome]) -> int:
    windows = [o for o in outcomes if o.kind == "window"]
    structured = [o for o in windows if o.has_structure]
    close = [o for o in structured if o.accepted and o.error_m is not None and o.error_m <= _LIMIT_M]
    wrong = [o for o in windows if o.accepted and (o.error_m is None or o.error_m > _WRONG_M)]
    foreign = [o for o in outcomes if o.kind != "window"]
    taken = [o for o in foreign if o.accepted]
    rate = len(close) / max(len(structured), 1)
    print(f"windows: {len(windows)}, with structure: {len(structured)}")
    print(f"registered within {_LIMIT_M} m: {len(close)} of {len(structured)} ({rate:.0%})")
    accepted = [o for o in windows if o.accepted]
    errors = [o.error_m for o in accepted if o.error_m is not None]
    if errors:
        print(
            f"accepted: {len(accepted)}; error median {np.median(errors):.2f} m, largest {max(errors):.2f} m"
        )
    print(f"accepted and wrong by more than {_WRONG_M} m: {len(wrong)}")
    print(f"windows of another place: {len(foreign)}, accepted: {len(taken)}")
    print(f"CPU seconds each: median {np.median([o.seconds for o in outcomes]):.1f}")
    return 0 if (rate >= _WANTED or not windows) and not wrong and not taken else 1


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scan", type=Path, nargs="?")
    parser.add_argument("ortho", type=Path, nargs="?")
    parser.add_argument("--given", type=Path, nargs="*", help="reports of earlier runs, instead of a run")
    parser.add_argument("--figure", type=Path)
    parser.add_argument(
        "--photos", type=Path, nargs="*", default=[], help="folders with photos of other places"
    )
    parser.add_argument("--count", type=int, help="only the first windows")
    parser.add_argument("--kinds", nargs="*", default=list(_KINDS), choices=_KINDS)
    parser.add_argument("--offset", nargs=2, type=float, default=(-7.0, -2.0), help="columns, rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(argv)
    if not args.given and args.ortho is None:
        parser.error("give a scan and an ortho image, or --given")
    return args


if __name__ == "__main__":
    sys.exit(main())
