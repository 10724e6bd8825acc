"""What a large database costs: its start, a small commit, a query; beside a small one of the same maps.

Each DB holds one map of the photos in FOLDER. Some of its photos are taken out of the map and asked for.
Copies of the maps are laid out as one city until they have N described points. A copy has its map's shape at
another place, and its descriptors with their cells in another order: real ones, which are neither the map's
nor another copy's. Photos are asked for by their features in a copy's order, with a prior
of 30 m and without one; their true places are where the whole map has them, moved with the copy.

Each database is measured in a process of its own: start to the first answer, a commit of a map of 100 points
until it answers, queries, memory.
"""

import gc
import multiprocessing
import os
import shutil
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from featuredb.features.decode import decode_gray
from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.maps.subset import only_images, only_points
from featuredb.store import Database
from reloc.localise.localise import localise_features
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from tools.commands import first_map
from tools.figures import few, study_parser, write_figures
from tools.service_world import cell_order, copied_map

_HELD_OUT = 4  # photos of each map
_ASKED = 40  # queries of a database
_GAP_M = 50.0
_PRIOR_M = 30.0
_RIGHT_M = 1.0
_COMMITTED = 100  # points
_AT_ONCE = 16  # maps of a commit
_SMALL = 10_000  # points


class MapSource(NamedTuple):
    """A map; photos that are not in it: features, lenses, and centres (3,) in its frame, metres."""

    feature_map: FeatureMap
    photos: list[tuple[Features, Camera, FloatArray]]


class Query(NamedTuple):
    """Features, a lens, a prior, and the true place: latitude, longitude, height."""

    features: Features
    camera: Camera
    prior: GeoPrior
    place: FloatArray


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("sources", nargs="+", metavar="DB:FOLDER")
    parser.add_argument("--points", type=int, default=1_000_000)
    args = parser.parse_args()
    sources = [source_of(*text.rsplit(":", 1)) for text in args.sources]
    small, large = args.work / "small", args.work / f"large-{args.points}"
    databases = {"small": (small, city(small, sources, _SMALL))}
    databases["large"] = (large, city(large, sources, args.points))
    context = multiprocessing.get_context("spawn")
    figures: dict[str, Any] = {}
    for size, (path, queries) in databases.items():
        with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
            figures[f"{size}_first_start_s"] = pool.submit(first_start, path, queries[0]).result()
            measured = pool.submit(measure, path, queries).result()
        figures |= {f"{size}_{name}": value for name, value in measured.items()}
    for name in ("start_s", "commit_s", "with_prior_ms", "without_ms"):
        figures[f"times_{name.rsplit('_', 1)[0]}"] = figures[f"large_{name}"] / figures[f"small_{name}"]
    more = figures["large_points"] - figures["small_points"]
    for kind in ("resident_bytes", "anonymous_bytes"):
        figures[f"{kind}_a_point"] = (figures[f"large_{kind}"] - figures[f"small_{kind}"]) / more
    write_figures(args.json, figures)


def source_of(database: str, folder: str) -> MapSource:
    """The largest placed map of a database without some of its photos, which are spread over it."""
    snapshot = Database.open(database).snapshot()
    whole = snapshot.load_map(max(snapshot.maps(), key=lambda m: m.images).map_id)
    images = sorted(whole.images, key=lambda image: image.name)
    asked = [images[i] for i in np.linspace(0, len(images) - 1, _HELD_OUT + 2).round().astype(int)[1:-1]]
    rest = only_images(whole, {i.image_id for i in whole.images} - {i.image_id for i in asked})
    rest = replace(rest, images=tuple(replace(image, gps=None) for image in rest.images))
    photos = []
    for image in asked:
        features = extract(decode_gray(Path(folder) / image.name), LocaliseOptions().extractor)
        photos.append((features, whole.cameras[image.camera_id], image.cam_from_local.center))
    return MapSource(rest, photos)


def city(path: Path, sources: Sequence[MapSource], points: int) -> list[Query]:
    """A database of at least so many described points, and what to ask it."""
    for folder in (path, Path(f"{path}-cache")):
        shutil.rmtree(folder, ignore_errors=True)
    database = Database.create(str(path))
    total, copies = 0, 0
    queries: list[Query] = []
    waiting: list[FeatureMap] = []
    side = max(1, round(np.sqrt(points / 20_000)))
    pitch = _GAP_M + max(float(np.ptp(s.feature_map.points.utm[:, :2], axis=0).max()) for s in sources)
    while total < points:
        source = sources[copies % len(sources)]
        column, row = copies % side, copies // side
        frame = LocalFrame(
            latitude_deg=45.0 + row * pitch / 111_000.0,
            longitude_deg=8.0 + column * pitch / 78_000.0,
            height_m=source.feature_map.frame.height_m,
        )
        seen = source.feature_map.observations
        waiting.append(copied_map(source.feature_map, frame, copies, f"copy-{copies}"))
        total += len(np.unique(seen.point_index[seen.has_descriptor]))
        if len(waiting) == _AT_ONCE or total >= points:
            database.commit_maps(waiting)
            waiting.clear()
        for photo, camera, place in source.photos:
            geodetic = frame.geodetic_from_enu(place)
            prior = GeoPrior(
                latitude_deg=float(geodetic[0]),
                longitude_deg=float(geodetic[1]),
                height_m=None,
                sigma_horizontal_m=_PRIOR_M,
                sigma_vertical_m=_PRIOR_M,
            )
            features = replace(photo, descriptors=photo.descriptors[:, cell_order(copies)])
            queries.append(Query(features, camera, prior, geodetic))
        copies += 1
    return list(few(queries, _ASKED))


def first_start(path: Path, query: Query) -> float:
    """Seconds to the first answer where nothing has been laid out yet; in a new process."""
    return _started(path, query)[1]


def _started(path: Path, query: Query) -> tuple[Localiser, float]:
    """A localiser on one thread, with a cache of its own, and seconds until it has answered."""
    threadpool_limits(1)
    os.environ["XDG_CACHE_HOME"] = f"{path}-cache"
    began = time.perf_counter()
    localiser = Localiser.open(Database.open(str(path)))
    ask(localiser, query, prior=True)
    return localiser, time.perf_counter() - began


def measure(path: Path, queries: Sequence[Query]) -> dict[str, float]:
    """Of one database, in a new process: seconds, milliseconds of a query (median), shares, then bytes."""
    localiser, start_s = _started(path, queries[0])
    points = sum(len(a.area.points) for a in localiser.areas)
    times: dict[bool, list[float]] = {True: [], False: []}
    errors: dict[bool, list[float]] = {True: [], False: []}
    for query, prior in product(queries, (True, False)):
        began = time.perf_counter()
        error = ask(localiser, query, prior=prior)
        times[prior].append(time.perf_counter() - began)
        errors[prior] += [] if error is None else [error]
    right = {prior: sum(error < _RIGHT_M for error in of) for prior, of in errors.items()}
    gc.collect()
    return {
        "points": points,
        "start_s": start_s,
        "with_prior_ms": 1e3 * median(times[True]),
        "without_ms": 1e3 * median(times[False]),
        "answered_with_prior": right[True] / len(queries),
        "answered_without": right[False] / len(queries),
        "wrong": sum(map(len, errors.values())) - sum(right.values()),
        "resident_bytes": _memory("VmRSS"),
        "anonymous_bytes": _memory("RssAnon"),
        "commit_s": _commit(Database.open(str(path)), localiser, queries[0]),  # memory was read before
    }


def _commit(database: Database, localiser: Localiser, query: Query) -> float:
    """Seconds from a commit of a small map until a query is answered from a database that has it."""
    like = first_map(database)
    few = only_points(like, np.arange(len(like.points)) < _COMMITTED)
    small = replace(few, map_id="committed", name="committed")
    began = time.perf_counter()
    database.commit_map(small)
    opened = Localiser.open(database, previous=localiser)
    ask(opened, query, prior=True)
    return time.perf_counter() - began


def ask(localiser: Localiser, query: Query, *, prior: bool) -> float | None:
    """Metres from the true place; None where it is not answered."""
    request = LocaliseRequest(camera=query.camera, prior=query.prior if prior else None)
    found = localise_features(query.features, request, localiser.areas_of(None), localiser.options)
    pose = found.result.pose
    if pose is None:
        return None
    offset = pose.frame.enu_from_geodetic(query.place) - pose.cam_from_local.center
    return float(np.linalg.norm(offset))


def _memory(kind: str) -> int:
    """Bytes of this process; RssAnon leaves out files that are mapped, which the system may drop."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * next(int(line.split()[1]) for line in text.splitlines() if line.startswith(kind))


if __name__ == "__main__":
    main()
