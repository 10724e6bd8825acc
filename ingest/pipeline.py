"""`featuredb ingest photos`: a folder of photos into a database, and a report of what happened."""

import dataclasses
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from featuredb.errors import InvalidValueError
from featuredb.geo.datum import HEIGHT_DATUMS
from featuredb.store import Database
from ingest.executor import Executor, InProcessExecutor, PoolExecutor, Progress, no_progress
from ingest.fingerprint import digest, options_fingerprint
from ingest.map_builder import MapIdentity
from ingest.outcomes import map_outcome, photo_outcomes
from ingest.photo import Photo
from ingest.reconstruction import MapMakingOptions, Reconstructed, Stage, make_maps
from ingest.register.control.model import Survey
from ingest.report import IngestReport, MapOutcome
from ingest.scan import ScanOptions, ScanResult, require_usable, scan_folder
from ingest.stage_clock import StageClock
from ingest.workspace import Workspace, default_root, remove_leftovers

logger = logging.getLogger(__name__)

# Part of every map id; raised when the same photos and options would give another map.
_MAP_VERSION = "photos-1"
_LIBRARIES = ("featuredb", "pycolmap", "opencv-contrib-python-headless", "numpy", "faiss-cpu")


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestOptions:
    """What an ingest does.

    Attributes:
        scan: what is taken from the folder, and attribution.
        making: from photos to maps.
        gps_sigma_m: standard deviation of all positions, instead of what EXIF suggests; horizontal and
            vertical.
        name: of the maps, for people; default the folder's name.
        workers: processes of extraction and matching; 1 runs everything in this process.
        work: work folder; default inside the database (see ingest.workspace.default_root).
        stop_after: end after that stage and keep its results for the next run.
        survey: control points, which place the maps instead of the photos' GPS. A map's id does not depend
            on them: it is the photos' and the options', wherever it is placed.
    """

    scan: ScanOptions = field(default_factory=ScanOptions)
    making: MapMakingOptions = field(default_factory=MapMakingOptions)
    gps_sigma_m: tuple[float, float] | None = None
    name: str = ""
    workers: int = field(default_factory=lambda: max(1, os.cpu_count() or 1))
    work: Path | None = None
    stop_after: Stage | None = None
    survey: Survey | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidValueError(f"IngestOptions.workers: expected at least 1, found {self.workers}")
        if self.gps_sigma_m is not None and not all(0 < s < 1e6 for s in self.gps_sigma_m):
            raise InvalidValueError(
                f"IngestOptions.gps_sigma_m: expected metres in (0, 1e6), found {self.gps_sigma_m}"
            )
        if self.making.maps.height_datum not in HEIGHT_DATUMS:
            raise InvalidValueError(
                f"MapOptions.height_datum: expected one of {', '.join(HEIGHT_DATUMS)}, "
                f"found {self.making.maps.height_datum!r}"
            )

    @property
    def fingerprint(self) -> str:
        """Digest of what a map depends on besides the photos; not of the number of workers."""
        return digest(_MAP_VERSION, options_fingerprint(self.making), repr(self.gps_sigma_m))[:16]


def ingest_photos(
    database: Database, folder: Path, options: IngestOptions | None = None, progress: Progress = no_progress
) -> IngestReport:
    """Scan, extract, match, reconstruct, place by GPS, build and commit.

    A killed ingest goes on where it was when it is called again with the same photos and options, and
    gives the same maps under the same ids. Photos that cannot be placed are reported, and nothing of them
    is committed.

    Raises:
        IngestError: the folder cannot be read, has fewer than two usable photos, or a worker died.
        StoreError: the database cannot be written.
    """
    options = options or IngestOptions()
    started, clock = datetime.now(UTC), StageClock()
    root = options.work or default_root(database.url)
    remove_leftovers(root)

    scanned = _scan(folder, options, root, clock, progress)
    photos = _with_sigmas(require_usable(scanned, folder, least=2), options)
    job_id = digest(options.fingerprint, *sorted(photo.sha256 for photo in photos))[:24]
    workspace = Workspace(root=root, job_id=job_id)
    if options.stop_after == "scan":
        result = Reconstructed(stopped_after="scan")
    else:
        with _executor(options) as executor:
            result = make_maps(
                photos,
                workspace,
                options.making,
                executor,
                identity=lambda number: _identity(folder, options, job_id, number),
                progress=progress,
                clock=clock,
                stop_after=options.stop_after,
                survey=options.survey,
            )
    with clock.stage("commit"):
        outcomes = _commit(database, result, options)
    return IngestReport(
        job_id=job_id,
        database=database.url,
        folder=str(folder),
        started=started,
        options=dataclasses.asdict(dataclasses.replace(options, survey=None)),
        versions=library_versions(),
        pairs=result.pairs,
        verified_pairs=result.verified_pairs,
        stages=clock.timings,
        photos=photo_outcomes(scanned.photos, result, options.stop_after),
        maps=outcomes,
        warnings=_warnings(result, outcomes, options),
    )


def library_versions() -> dict[str, str]:
    """Versions of what makes the numbers; absent libraries are left out."""
    versions = {}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            logger.debug("no installed distribution %s", name)
    return versions


def _scan(
    folder: Path, options: IngestOptions, root: Path, clock: StageClock, progress: Progress
) -> ScanResult:
    cache = root / "scan" / f"{digest(str(folder.absolute()))[:16]}.json"
    with clock.stage("scan") as counts:
        scanned = scan_folder(folder, options.scan, progress, cache)
        counts |= {"reused": len(scanned.photos) - scanned.read, "total": len(scanned.photos)}
    return scanned


def _with_sigmas(photos: Sequence[Photo], options: IngestOptions) -> list[Photo]:
    """Photos whose priors have the sigmas that the caller gave."""
    if options.gps_sigma_m is None:
        return list(photos)
    horizontal, vertical = options.gps_sigma_m
    return [
        photo
        if photo.gps is None
        else replace(photo, gps=replace(photo.gps, sigma_horizontal_m=horizontal, sigma_vertical_m=vertical))
        for photo in photos
    ]


@contextmanager
def _executor(options: IngestOptions) -> Iterator[Executor]:
    if options.workers == 1:
        yield InProcessExecutor()
    else:
        with PoolExecutor(options.workers) as pool:
            yield pool


def _identity(folder: Path, options: IngestOptions, job_id: str, number: int) -> MapIdentity:
    name = options.name or folder.absolute().name
    return MapIdentity(
        map_id=f"{job_id}-{number}",
        name=name if number == 0 else f"{name} ({number + 1})",
        source="photos",
        licence=options.scan.licence,
        provenance={
            "job": job_id,
            "component": number,
            "versions": library_versions(),
            "options": _plain(dataclasses.asdict(options.making)),
        },
    )


def _plain(value: Any) -> Any:
    """Dataclass fields as JSON has them: tuples as lists, everything unknown as text."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value if value is None or isinstance(value, (str, int, float, bool)) else str(value)


def _commit(database: Database, result: Reconstructed, options: IngestOptions) -> tuple[MapOutcome, ...]:
    """Make all placed maps visible in one commit; what became of each component."""
    created: dict[str, bool] = {}
    maps = [c.feature_map for c in result.components if c.feature_map is not None]
    if maps and options.stop_after in (None, "commit"):
        created = {r.map_id: r.created for r in database.commit_maps(maps)}
    elif options.stop_after == "build":
        return ()
    return tuple(map_outcome(c, created, options.making) for c in result.components)


def _warnings(
    result: Reconstructed, outcomes: Sequence[MapOutcome], options: IngestOptions
) -> tuple[str, ...]:
    if options.stop_after is not None:
        return (f"Stopped after {options.stop_after}, as asked; nothing beyond it was done.",)
    if not outcomes:
        return (
            f"No reconstruction: {result.verified_pairs} of {result.pairs} pairs of photos have enough "
            "verified matches. Photos of one place must overlap by more than half.",
        )
    if options.survey is not None and any(o.status == "already_there" for o in outcomes):
        return (
            "A map of these photos is there already and keeps its place; to place it by the control points: "
            "featuredb register DB MAP --gcp FILE",
        )
    return ()
