"""Recall against size: how far can a map be thinned before photos are lost?

    python -m tools.thinning_study --world WORLD --db DB --out docs/figures \\
        [--real PART_DB WHOLE_DB PHOTOS NAME [NAME ...]]

WORLD and DB are what `tools/simulated_evaluation.py` leaves (world/, db/), PART_DB and WHOLE_DB what
`tools/real_photos.py --work` leaves (part, whole). For each K the map is thinned so that every image keeps
seeing K described points, and by chance to the same number of points; then all held-out photos are asked for
as a client does that knows nothing but the file. The held-out photos of a real set are compared with their
poses in the map of all photos.

Recall is the share localised within 0.25 m and 0.3 degrees (simulated), 1.0 m and 0.5 degrees (real, where
both maps are placed by GPS). Bytes are those of the files of a database that holds this map alone; the index
is FAISS' own size; the query's time is CPU without the photo's features, which no map changes.

Writes thinning.csv and thinning.png, and prints the table.
"""

import argparse
import csv
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import faiss
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from featuredb.features.decode import decode_gray
from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.thin import ThinOptions, thin_map, with_descriptors
from featuredb.simworld.scoring import PoseError, pose_difference, pose_error
from featuredb.simworld.world import open_world
from featuredb.store import Database
from reloc.candidates import IndexedArea
from reloc.localise import localise_features
from reloc.options import LocaliseOptions
from reloc.result import LocaliseRequest, LocaliseResult
from reloc.service.handler import localise_request
from reloc.wire import LocaliseWireRequest

mpl.use("Agg")  # no display is needed

COVERS = (20, 30, 40, 60, 80, 120, 160, 240, 400, 600, 800, 1200)
SIMULATED, REAL = (0.25, 0.3), (1.0, 0.5)  # metres, degrees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A held-out photo and how far an answer to it is off."""

    features: Features
    request: LocaliseRequest
    error: Callable[[LocaliseResult], PoseError | None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Study:
    """A map, the photos that are asked for, and the limits (metres, degrees) of a right answer."""

    name: str
    feature_map: FeatureMap
    queries: list[Query]
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One thinned map.

    Attributes:
        how: whole, cover, random; cover: K, 0 where there is none.
        points, observations: that carry descriptors.
        bytes, bytes_dropped: of the database, with the other points kept and with them gone.
        index_bytes: of FAISS.
        localised, recall: shares of the photos: answered; answered within the limits.
        wrong: answers more than 5 m off.
        inliers, median_m, median_deg: medians over the answers.
        query_ms: median CPU of a query without features.
        thin_s: CPU of the thinning.
    """

    study: str
    how: str
    cover: int
    points: int
    observations: int
    bytes: int
    bytes_dropped: int
    index_bytes: int
    photos: int
    localised: float
    recall: float
    wrong: int
    inliers: float
    median_m: float
    median_deg: float
    query_ms: float
    thin_s: float


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for study in _studies(args):
        for row in curve(study, args.covers, args.max_views, args.seed):
            rows.append(row)
            sys.stdout.write(line(row) + "\n")
            sys.stdout.flush()
    with (args.out / "thinning.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(
            {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in asdict(r).items()} for r in rows
        )
    plot(rows, args.out / "thinning.png")
    return 0


def curve(study: Study, covers: Sequence[int], max_views: int, seed: int) -> Iterator[Row]:
    """The whole map, then each cover and chance with as many points."""
    yield _measure(study, study.feature_map, study.feature_map, "whole", 0, 0.0)
    for cover in covers:
        start = time.process_time()
        options = ThinOptions(cover=cover, max_views=max_views)
        thin = thin_map(study.feature_map, options)
        seconds = time.process_time() - start
        dropped = thin_map(
            study.feature_map, ThinOptions(cover=cover, max_views=max_views, keep_points=False)
        )
        yield _measure(study, thin, dropped, "cover", cover, seconds)
        described = thin.observations.point_index[thin.observations.has_descriptor]
        chance = by_chance(study.feature_map, len(np.unique(described)), seed, keep_points=True)
        gone = by_chance(study.feature_map, len(np.unique(described)), seed, keep_points=False)
        yield _measure(study, chance, gone, "random", cover, 0.0)


def by_chance(feature_map: FeatureMap, count: int, seed: int, *, keep_points: bool) -> FeatureMap:
    """The map with so many described points, drawn among those that it has."""
    seen = feature_map.observations
    points = np.unique(seen.point_index[seen.has_descriptor])
    drawn = np.random.default_rng(seed).choice(points, count, replace=False)
    return with_descriptors(feature_map, np.isin(seen.point_index, drawn), keep_points)


def _measure(study: Study, thin: FeatureMap, dropped: FeatureMap, how: str, cover: int, thin_s: float) -> Row:
    area = build_area([thin])
    index = build_index(area.descriptors)
    indexed = [IndexedArea(area=area, index=index)]
    errors, inliers, times = [], [], []
    for query in study.queries:
        start = time.process_time()
        result = localise_features(query.features, query.request, indexed).result
        times.append(1e3 * (time.process_time() - start))
        error = query.error(result)
        if error is not None:
            errors.append(error)
            inliers.append(result.inliers)
    near, turned = study.limits
    right = sum(e.position_m <= near and e.angle_deg <= turned for e in errors)
    nan = [float("nan")]
    return Row(
        study=study.name,
        how=how,
        cover=cover,
        points=len(area.points),
        observations=int(thin.observations.has_descriptor.sum()),
        bytes=stored_bytes(thin),
        bytes_dropped=stored_bytes(dropped),
        index_bytes=int(faiss.serialize_index(index._index).nbytes),
        photos=len(study.queries),
        localised=len(errors) / len(study.queries),
        recall=right / len(study.queries),
        wrong=sum(e.position_m > 5.0 for e in errors),
        inliers=float(np.median(inliers or nan)),
        median_m=float(np.median([e.position_m for e in errors] or nan)),
        median_deg=float(np.median([e.angle_deg for e in errors] or nan)),
        query_ms=float(np.median(times)),
        thin_s=thin_s,
    )


def stored_bytes(feature_map: FeatureMap) -> int:
    """Size of the files of a new database with this map."""
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db")
        database.commit_map(feature_map)
        return sum(p.stat().st_size for p in Path(folder).rglob("*.parquet"))


def line(row: Row) -> str:
    return (
        f"{row.study:<10} {row.how:<7} K {row.cover:>4}: {row.points:>6} points, {row.bytes / 1e6:6.2f} MB "
        f"({row.bytes_dropped / 1e6:6.2f} MB), index {row.index_bytes / 1e6:5.2f} MB; "
        f"localised {row.localised:6.1%}, right {row.recall:6.1%}, wrong {row.wrong}; "
        f"inliers {row.inliers:5.0f}, {row.median_m:.3f} m, {row.median_deg:.3f} deg; "
        f"{row.query_ms:5.0f} ms; thinned in {row.thin_s:.2f} s"
    )


def plot(rows: Sequence[Row], path: Path) -> None:
    """Recall, error and query time against described points."""
    names = list(dict.fromkeys(r.study for r in rows))
    figure, axes = plt.subplots(
        len(names), 3, figsize=(13, 3.6 * len(names)), layout="constrained", squeeze=False
    )
    for name, line_axes in zip(names, axes, strict=True):
        mine = [r for r in rows if r.study == name]
        whole = mine[0]
        for axis, field, label in zip(
            line_axes,
            ("recall", "median_m", "query_ms"),
            ("recall", "median error, m", "query without features, CPU ms"),
            strict=True,
        ):
            for how, colour in (("cover", "tab:blue"), ("random", "tab:orange")):
                these = [r for r in mine if r.how == how]
                axis.plot([r.points for r in these], [getattr(r, field) for r in these], ".-", color=colour,
                          label={"cover": "K-cover", "random": "by chance"}[how])  # fmt: skip
            axis.axhline(getattr(whole, field), color="grey", linewidth=0.8, linestyle="--",
                         label=f"whole map, {whole.points} points")  # fmt: skip
            if field == "recall":
                for r in mine:
                    if r.how == "cover":
                        axis.annotate(str(r.cover), (r.points, r.recall), fontsize=7, xytext=(0, 5),
                                      textcoords="offset points", ha="center")  # fmt: skip
            axis.set(xscale="log", xlabel="described points", ylabel=label, title=name)
        line_axes[0].legend()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _studies(args: argparse.Namespace) -> list[Study]:
    studies = []
    if args.world is not None:
        studies.append(_simulated(args.world, args.db, args.limit))
    if args.real:
        studies.append(_real(Path(args.real[0]), Path(args.real[1]), Path(args.real[2]), args.real[3:]))
    if not studies:
        raise SystemExit("expected --world and --db, or --real, or both")
    return studies


def _simulated(folder: Path, database: Path, limit: int | None) -> Study:
    world = open_world(folder)

    def query(path: Path) -> Query:
        name = path.relative_to(world.folder).as_posix()

        def error(result: LocaliseResult) -> PoseError | None:
            pose = result.pose
            if pose is None:
                return None
            return pose_error(world.truth, name, pose.epsg, pose.utm, pose.cam_from_utm_xyzw)

        return _asked(path, error)

    queries = [query(path) for path in world.images("queries")[:limit]]
    return Study(name="simulated", feature_map=_largest(database), queries=queries, limits=SIMULATED)


def _real(part: Path, whole: Path, photos: Path, names: Sequence[str]) -> Study:
    truth = _largest(whole)
    poses = {image.name: image.cam_from_local for image in truth.images}

    def query(name: str) -> Query:
        def error(result: LocaliseResult) -> PoseError | None:
            pose = result.pose
            if pose is None:
                return None
            return pose_difference(truth.frame, poses[name], pose.epsg, pose.utm, pose.cam_from_utm_xyzw)

        return _asked(photos / name, error)

    return Study(
        name=photos.parent.name, feature_map=_largest(part), queries=[query(n) for n in names], limits=REAL
    )


def _asked(path: Path, error: Callable[[LocaliseResult], PoseError | None]) -> Query:
    data = path.read_bytes()
    gray = decode_gray(data)
    features = extract(gray, LocaliseOptions().extractor)
    return Query(features=features, request=localise_request(LocaliseWireRequest(), data, gray), error=error)


def _largest(database: Path) -> FeatureMap:
    """The active map with most images."""
    snapshot = Database.open(database).snapshot()
    maps = [m for m in snapshot.maps() if m.status == "active"]
    return snapshot.load_map(max(maps, key=lambda m: m.images).map_id)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, default=None)
    parser.add_argument("--db", type=Path, default=None)
    parser.add_argument("--real", nargs="+", default=[], metavar="PART WHOLE PHOTOS NAME")
    parser.add_argument("--covers", type=int, nargs="+", default=list(COVERS))
    parser.add_argument("--max-views", type=int, default=ThinOptions().max_views)
    parser.add_argument("--limit", type=int, default=None, metavar="N", help="ask for N photos only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
