"""Where should the line between believed and not believed be? Evidence of right and of wrong poses.

    uv run python tools/acceptance_study.py WORLD DB --out DIR [--real FOLDER ...] [--real-map DB FOLDER]

Every query is localised with the lines of reloc.acceptance out of the way, so that the best pose of each
comes back with its evidence; then it is called right (within 5 m) or wrong by the truth.

- True queries: held-out drone photos of a simulated WORLD whose drone photos are in DB; as they are,
  without a word about the lens, blurred, darkened, cropped, scaled down, turned. With --real-map also the
  photos of FOLDER that its DB does not hold; their own GPS says what is right.
- Impossible ones: the world's negatives, mirrored photos, noise, the photos of the --real folders.

Writes acceptance_study.csv (a line for each query) and acceptance_study.png (histograms and lines); prints
the margins, what the lines let through and hold back, and the coefficients of reloc.acceptance.confidence:
the logistic regression of "right" on the evidence, right and wrong poses weighing the same.
"""

import argparse
import csv
import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize

from featuredb.features.decode import decode_gray
from featuredb.features.exif import read_exif
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.exif_prior import prior_from_exif
from featuredb.simworld.world import open_world
from featuredb.store import Database
from reloc.acceptance import AcceptanceOptions, verdict
from reloc.localiser import Localiser
from reloc.options import LocaliseOptions
from reloc.result import Evidence, LocalisedPose, LocaliseRequest
from tools.photo_variants import Gray, variants

mpl.use("Agg")  # no display is needed

# Everything that is found comes back: six inliers are the fewest that leave the pose some redundancy.
NO_LINES = AcceptanceOptions(
    min_inliers=6, min_log_nfa=-1e9, min_coverage=0.0, min_agreement=0.0, min_spread=0.0, rival_share=np.inf
)
MEASURES = ("inliers", "log_nfa", "coverage", "agreement", "spread", "visible_share")
_LINES = {
    "inliers": "min_inliers",
    "log_nfa": "min_log_nfa",
    "coverage": "min_coverage",
    "agreement": "min_agreement",
    "spread": "min_spread",
}
_RIGHT_PLACE_M = 5.0  # what the evaluations call a wrong answer lies further off
_SUFFIXES = (".jpg", ".jpeg", ".png")
_REAL_GPS_M = 15.0  # a consumer receiver's error, in bad cases, beside the map's own
_PRIOR_SCALE = 2.5  # of standardised coefficients; finite where the data separate (Gelman et al., 2008)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A photo to ask for.

    Attributes:
        map_name: which map it is asked at.
        group: drone, a kind of negative, or a folder's name.
        center: (3,) where it was taken, in `frame`; None where the map does not hold the place.
        right_m: answers so close to it are right; horizontally where `flat`.
    """

    map_name: str
    group: str
    path: Path
    center: FloatArray | None = None
    frame: LocalFrame | None = None
    right_m: float = _RIGHT_PLACE_M
    flat: bool = False

    def error_m(self, pose: LocalisedPose | None) -> float:
        """Distance of a pose from the true place; infinite where there is none."""
        if self.center is None or self.frame is None or pose is None:
            return float("inf")
        offset = self.frame.enu_from_utm(pose.utm, pose.epsg) - self.center
        return float(np.linalg.norm(offset[:2] if self.flat else offset))


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One query and what came of it; evidence is zero where no pose was found."""

    map_name: str
    group: str
    variant: str
    name: str
    possible: bool
    found: bool
    right: bool
    error_m: float
    accepted: bool
    reason: str
    inliers: int
    log_nfa: float
    coverage: float
    agreement: float
    spread: float
    visible_share: float
    rival_inliers: int


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    options = LocaliseOptions(acceptance=NO_LINES)
    maps = {"simulated": Localiser.open(Database.open(args.db), options)}
    queries = list(world_queries(args.world, args.limit))
    if args.real_map is not None:
        database, folder = args.real_map
        maps["real"] = Localiser.open(Database.open(database), options)
        queries += real_queries(Database.open(database), Path(folder), args.limit)
    for name in maps:
        queries += [q for folder in args.real for q in foreign_queries(name, folder, args.limit)]
    rows = []
    for i, query in enumerate(queries):
        rows += measure(query, maps[query.map_name])
        if i % 20 == 0:
            sys.stderr.write(f"{i + 1} of {len(queries)} photos\n")
    _write_csv(args.out / "acceptance_study.csv", rows)
    _plot(args.out / "acceptance_study.png", rows)
    sys.stdout.write("\n\n".join([counts_table(rows), margins_table(rows), fit_text(rows)]) + "\n")
    wrong = [row for row in rows if row.accepted and not row.right]
    for row in wrong:
        sys.stdout.write(f"WRONG AND ACCEPTED: {asdict(row)}\n")
    return 1 if wrong else 0


def world_queries(folder: Path, limit: int | None) -> Iterator[Query]:
    """Held-out drone photos and negatives of a simulated world."""
    world = open_world(folder)
    for path in world.images("queries")[:limit]:
        true = world.truth.images[path.relative_to(world.folder).as_posix()]
        yield Query(
            map_name="simulated",
            group="drone",
            path=path,
            center=true.cam_from_local.center,
            frame=world.truth.frame,
        )
    for kind in sorted({p.parent.name for p in world.negatives()}):
        for path in [p for p in world.negatives() if p.parent.name == kind][:limit]:
            yield Query(map_name="simulated", group=kind, path=path)


def real_queries(database: Database, folder: Path, limit: int | None) -> list[Query]:
    """The photos of a folder that the database does not hold, with the place that their GPS says."""
    snapshot = database.snapshot()
    held = {image.name for m in snapshot.maps() for image in snapshot.load_map(m.map_id).images}
    queries = []
    for path in [p for p in _photos(folder) if p.name not in held][:limit]:
        prior = prior_from_exif(read_exif(path.read_bytes()))
        if prior is None:
            continue
        height = prior.height_m or 0.0
        frame = LocalFrame(
            latitude_deg=prior.latitude_deg, longitude_deg=prior.longitude_deg, height_m=height
        )
        queries.append(
            Query(
                map_name="real",
                group=folder.parent.name,
                path=path,
                center=np.zeros(3),
                frame=frame,
                right_m=_REAL_GPS_M,
                flat=True,
            )
        )
    return queries


def foreign_queries(map_name: str, folder: Path, limit: int | None) -> list[Query]:
    """The photos of a folder, taken to show nothing of the map."""
    return [Query(map_name=map_name, group=folder.parent.name, path=p) for p in _photos(folder)[:limit]]


def measure(query: Query, localiser: Localiser) -> list[Row]:
    """The photo in all its variants; an impossible one as it is, and without a word about its lens."""
    data = query.path.read_bytes()
    exif = read_exif(data)
    plain = LocaliseRequest(camera_key=exif.camera_key or None, exif_focal_px=exif.focal_px)
    return [
        _row(query, name, gray, request, localiser, possible=possible and query.center is not None)
        for name, gray, request, possible in variants(
            decode_gray(data), plain, degrade=query.center is not None
        )
    ]


def _row(
    query: Query, variant: str, gray: Gray, request: LocaliseRequest, localiser: Localiser, *, possible: bool
) -> Row:
    result = localiser.localise(gray, request)
    evidence = result.evidence or Evidence(
        inliers=0, log_nfa=0.0, coverage=0.0, visible_share=0.0, agreement=0.0, spread=0.0
    )
    rival = result.runner_up.inliers if result.runner_up else 0
    refusal = verdict(evidence, rival, AcceptanceOptions())
    error_m = query.error_m(result.pose) if possible else float("inf")
    return Row(
        map_name=query.map_name,
        group=query.group,
        variant=variant,
        name=query.path.name,
        possible=possible,
        found=result.pose is not None,
        right=error_m <= query.right_m,
        error_m=error_m,
        accepted=result.pose is not None and refusal is None,
        reason=(refusal[0] if refusal else "") if result.pose else str(result.reason),
        rival_inliers=rival,
        **{name: getattr(evidence, name) for name in MEASURES},
    )


def counts_table(rows: Sequence[Row]) -> str:
    """What the present lines do, by group and variant."""
    lines = [
        f"{'map':<11}{'photos':<13}{'variant':<15}{'asked':>6}{'right':>7}{'wrong':>7}"
        f"{'accepted: right':>17}{'wrong':>7}"
    ]
    for key in dict.fromkeys((r.map_name, r.group, r.variant) for r in rows):
        mine = [r for r in rows if (r.map_name, r.group, r.variant) == key]
        right = sum(r.right for r in mine)
        wrong = sum(r.found for r in mine) - right
        accepted = [r for r in mine if r.accepted]
        good = sum(r.right for r in accepted)
        lines.append(
            f"{key[0]:<11}{key[1]:<13}{key[2]:<15}{len(mine):>6}{right:>7}{wrong:>7}"
            f"{good:>17}{len(accepted) - good:>7}"
        )
    return "\n".join(lines)


def margins_table(rows: Sequence[Row]) -> str:
    """For each measure: how far the wrong ones reach, where the right ones begin, where the line is."""
    right = [r for r in rows if r.right]
    wrong = [r for r in rows if r.found and not r.right]
    lines = [
        f"{len(right)} right poses, {len(wrong)} wrong ones, "
        f"{sum(not r.found for r in rows)} queries without any",
        f"{'measure':<15}{'wrong: median':>14}{'99 %':>8}{'most':>8}{'right: least':>14}{'1 %':>8}{'5 %':>8}"
        f"{'median':>9}{'line':>8}{'wrong over':>12}{'right under':>13}",
    ]
    for name in MEASURES:
        low = np.array([getattr(r, name) for r in wrong] or [np.nan], dtype=float)
        high = np.array([getattr(r, name) for r in right] or [np.nan], dtype=float)
        line = _line_of(name)
        lines.append(
            f"{name:<15}{np.median(low):>14.2f}{np.percentile(low, 99):>8.2f}{low.max():>8.2f}"
            f"{high.min():>14.2f}{np.percentile(high, 1):>8.2f}{np.percentile(high, 5):>8.2f}"
            f"{np.median(high):>9.2f}"
            + (
                f"{'-':>8}"
                if line is None
                else f"{line:>8g}{(low >= line).sum():>12}{(high < line).sum():>13}"
            )
        )
    return "\n".join(lines)


def _line_of(measure_name: str) -> float | None:
    option = _LINES.get(measure_name)
    return None if option is None else float(getattr(AcceptanceOptions(), option))


def regressors(rows: Sequence[Row]) -> FloatArray:
    """(n, 3): one, logarithm of the evidence against chance, share of the rival."""
    nfa = np.log1p([max(r.log_nfa, 0.0) for r in rows])
    rival = [r.rival_inliers / max(r.inliers, 1) for r in rows]
    return np.stack([np.ones(len(rows)), nfa, np.minimum(rival, 1.0)], axis=1)


def fit(rows: Sequence[Row]) -> FloatArray:
    """Coefficients (3,) of the logistic regression of "right", both classes weighing the same."""
    x, y = regressors(rows), np.array([r.right for r in rows], dtype=float)
    weight = np.where(y > 0, 0.5 / max(y.mean(), 1e-9), 0.5 / max(1.0 - y.mean(), 1e-9))
    spread = np.maximum(x.std(axis=0), 1e-9)

    def cost(b: FloatArray) -> float:
        score = x @ b
        likelihood = weight @ (np.logaddexp(0.0, score) - y * score)
        return float(likelihood + 0.5 * np.sum((b[1:] * spread[1:] / _PRIOR_SCALE) ** 2))

    return np.asarray(minimize(cost, np.zeros(x.shape[1]), method="BFGS").x)


def fit_text(rows: Sequence[Row]) -> str:
    """The coefficients, and how the fitted probability compares with what happened."""
    found = [r for r in rows if r.found]
    b = fit(found)
    chance = 1.0 / (1.0 + np.exp(-regressors(found) @ b))
    right = np.array([r.right for r in found])
    lines = [
        f"confidence = 1 / (1 + exp(-s)), s = {b[0]:.2f} + {b[1]:.2f} ln(1 + log_nfa) "
        f"+ {b[2]:.2f} rival / inliers",
        f"{'confidence':<14}{'poses':>7}{'right':>8}",
    ]
    edges = (0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0)
    for low, high in itertools.pairwise(edges):
        mine = (chance >= low) & ((chance < high) | (high == 1.0))
        share = f"{right[mine].mean():.1%}" if mine.any() else "-"
        lines.append(f"{low:.2f} to {high:<6.2f}{int(mine.sum()):>7}{share:>8}")
    return "\n".join(lines)


def _plot(path: Path, rows: Sequence[Row]) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(14, 7), layout="constrained")
    right = [r for r in rows if r.right]
    wrong = [r for r in rows if r.found and not r.right]
    for axis, name in zip(axes.ravel(), MEASURES, strict=False):
        scale = np.log1p if name in ("inliers", "log_nfa") else np.asarray
        classes = [scale(np.maximum([getattr(r, name) for r in c], 0.0)) for c in (right, wrong)]
        bins = np.linspace(0.0, max(float(np.max(c, initial=0.01)) for c in classes), 50)
        axis.hist(classes, bins=bins, label=("right poses", "wrong poses"), color=("C0", "C3"), stacked=False)
        line = _line_of(name)
        if line is not None:
            axis.axvline(float(scale(line)), color="black", linestyle="--", label=f"line: {line:g}")
        if scale is np.log1p:
            ticks = [t for t in (0, 3, 10, 30, 100, 300, 1000, 3000) if np.log1p(t) <= bins[-1]]
            axis.set_xticks(np.log1p(ticks), [str(t) for t in ticks])
        axis.set(xlabel=name, ylabel="queries", yscale="log")
        axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def _photos(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("world", type=Path, help="a simulated world")
    parser.add_argument("db", help="the database of its drone photos")
    parser.add_argument("--out", type=Path, default=Path("acceptance-study"))
    parser.add_argument(
        "--real", type=Path, action="append", default=[], metavar="FOLDER", help="photos of other places"
    )
    parser.add_argument(
        "--real-map",
        nargs=2,
        metavar=("DB", "FOLDER"),
        help="a map of real photos, and more of the same place",
    )
    parser.add_argument("--limit", type=int, default=None, metavar="N", help="N photos of each group")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
