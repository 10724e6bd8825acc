"""`featuredb ingest photos`: a folder of photos into a database, and a report of what happened."""

import dataclasses
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from featuredb.errors import InvalidValueError
from featuredb.geo.datum import check_datum
from featuredb.index.vocabulary import shipped_vocabulary
from featuredb.plain_json import plain
from featuredb.stage_clock import StageClock
from featuredb.store import Database, Snapshot
from ingest.executor import Progress, no_progress, open_executor
from ingest.fingerprint import digest, options_fingerprint
from ingest.map_builder import MapIdentity
from ingest.own_frame import WAYS_TO_A_PLACE
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, ScanResult, require_usable, scan_folder, scan_table
from ingest.photos.table import is_table, read_table
from ingest.placed_models import HINTS, Component, place_models
from ingest.reconstruction import MapMakingOptions, Reconstructed, Stage, reconstruct_photos
from ingest.register.control.maps import Survey
from ingest.report.outcomes import map_outcome, photo_outcomes, registered_photos
from ingest.report.values import IngestReport, MapOutcome, PhotoOutcome, StageTiming
from ingest.scene_elsewhere import same_scene_elsewhere
from ingest.workspace import Workspace, default_root, remove_leftovers

logger = logging.getLogger(__name__)

# Part of every map id; raised when the same photos and options would give another map.
_MAP_VERSION = "photos-6"
# Some hundred megabytes as rows of the tables; what a folder of a few hundred photos makes is one commit.
_OBSERVATIONS_PER_COMMIT = 1_000_000
_MOST_NOTES = 20
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
        workers: processes; 1 runs everything in this process.
        dask: address of a Dask scheduler, whose workers run the tasks instead.
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
    dask: str | None = None
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
        check_datum(self.making.maps.height_datum)

    @property
    def fingerprint(self) -> str:
        """Digest of what a map depends on besides the photos; not of the number of workers."""
        parts = [_MAP_VERSION, options_fingerprint(self.making), repr(self.gps_sigma_m)]
        return digest(*parts, shipped_vocabulary().digest)[:16]


def ingest_photos(
    database: Database, folder: Path, options: IngestOptions | None = None, progress: Progress = no_progress
) -> IngestReport:
    """Scan, extract, match, reconstruct, place by GPS, build and commit.

    Args:
        folder: of photos, searched through, or a table of them (see ingest.photos.table).

    A killed ingest goes on where it was when it is called again with the same photos and options, and
    gives the same maps under the same ids. What was reconstructed and cannot be placed is committed as a map
    without a place; photos that are in no reconstruction are reported.

    Raises:
        IngestError: the folder cannot be read, has fewer usable photos than a map needs, or a worker died.
        StoreError: the database cannot be written, or is of an older format.
    """
    database.require_newest_format("keep maps without a place, which an ingest may make")
    options = options or IngestOptions()
    started, clock = datetime.now(UTC), StageClock()
    root = options.work or default_root(database.url)
    remove_leftovers(root)

    scanned = _scan(folder, options, root, clock, progress)
    photos = _with_sigmas(require_usable(scanned, folder, options.making.sfm.min_model_photos), options)
    job_id = digest(options.fingerprint, *sorted(photo.sha256 for photo in photos))[:24]
    workspace = Workspace(root=root)
    if options.stop_after == "scan":
        result = Reconstructed()
    else:
        shared = (root, folder.parent if is_table(folder) else folder)
        with open_executor(options.workers, options.dask, shared) as executor:
            result = reconstruct_photos(
                photos,
                workspace,
                options.making,
                executor,
                progress=progress,
                clock=clock,
                stop_after=options.stop_after,
            )
    with clock.stage("build"):
        outcomes, registered, quarantined = _place_and_commit(
            database,
            result,
            options,
            lambda number: _identity(folder, options, job_id, number),
            root,
            progress,
        )
    return IngestReport(
        job_id=job_id,
        database=database.url,
        folder=str(folder),
        started=started,
        options=dataclasses.asdict(dataclasses.replace(options, survey=None)),
        versions=library_versions(),
        pairs=len(result.matched.files),
        verified_pairs=len(result.matched.inliers),
        stages=tuple(StageTiming(name=n, seconds=s, **clock.counts[n]) for n, s in clock.seconds.items()),
        photos=photo_outcomes(scanned.photos, result, registered, options.stop_after),
        maps=outcomes,
        warnings=(
            *scanned.notes,
            *_warnings(result, outcomes, options),
            *_quarantine_note(quarantined),
            *_twice(database, outcomes, {photo.sha256 for photo in photos}),
            *(f"Matching of {o.task} is lost: {o.reason}" for o in result.matched.lost[:_MOST_NOTES]),
        ),
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
        if is_table(folder):
            scanned = scan_table(read_table(folder), options.scan, progress, cache)
        else:
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


def _identity(folder: Path, options: IngestOptions, job_id: str, number: int) -> MapIdentity:
    name = options.name or (folder.stem if is_table(folder) else folder.absolute().name)
    return MapIdentity(
        map_id=f"{job_id}-{number}",
        name=name if number == 0 else f"{name} ({number + 1})",
        source="photos",
        licence=options.scan.licence,
        provenance={
            "job": job_id,
            "component": number,
            "versions": library_versions(),
            "vocabulary": shipped_vocabulary().digest,
            "options": plain(dataclasses.asdict(options.making)),
        },
    )


def _place_and_commit(
    database: Database,
    result: Reconstructed,
    options: IngestOptions,
    identity: Callable[[int], MapIdentity],
    work: Path,
    progress: Progress,
) -> tuple[tuple[MapOutcome, ...], dict[str, PhotoOutcome], dict[str, str]]:
    """Place the models and make the maps visible.

    Args:
        work: work folder.

    Returns:
        What became of each component and of its photos, and why maps are in quarantine, by id.

    Maps are committed together until they are large: then the next ones go into another commit, so that
    memory does not grow with the photos.
    """
    outcomes: list[MapOutcome] = []
    registered: dict[str, PhotoOutcome] = {}
    quarantined: dict[str, str] = {}
    if options.stop_after not in (None, "build", "commit"):
        return (), {}, {}
    batch: list[Component] = []
    there = database.snapshot()
    known = {m.map_id: m for m in there.maps()}
    for placed in place_models(result, options.making, identity=identity, survey=options.survey):
        made = placed.feature_map
        kept = None if made is None else known.get(made.map_id)
        component = placed if kept is not None else _beside_others(placed, there, work, options)
        batch.append(component)
        now = kept or component.feature_map
        if now is not None and now.status == "quarantined":
            quarantined[now.map_id] = (kept.status_reason if kept is not None else "") or component.reason
        if sum(len(c.model.point_of) for c in batch) > _OBSERVATIONS_PER_COMMIT:
            outcomes += _commit(database, batch, options)
            registered |= _registered_all(batch, result)
            batch = []
    outcomes += _commit(database, batch, options)
    registered |= _registered_all(batch, result)
    progress("build", len(outcomes), len(outcomes))
    return tuple(outcomes), registered, quarantined


def _beside_others(component: Component, there: Snapshot, work: Path, options: IngestOptions) -> Component:
    """The component; in quarantine where positions placed it and an active map has its scene elsewhere."""
    feature_map = component.feature_map
    if feature_map is None or feature_map.placement.method != "gps":
        return component
    found = same_scene_elsewhere(feature_map, there, work, shipped_vocabulary())
    if found is None:
        return component
    reason = "; ".join(filter(None, (component.reason, found.message)))
    return replace(component, feature_map=replace(feature_map, status="quarantined"), reason=reason)


def _registered_all(batch: Sequence[Component], result: Reconstructed) -> dict[str, PhotoOutcome]:
    return {name: o for component in batch for name, o in registered_photos(component, result).items()}


def _commit(database: Database, batch: Sequence[Component], options: IngestOptions) -> list[MapOutcome]:
    """Make the placed maps visible in one commit; what became of each component."""
    created: dict[str, bool] = {}
    maps = [m for c in batch if (m := c.feature_map or c.unplaced) is not None]
    if options.stop_after == "build":
        return []
    retired = database.snapshot().retired_alike(maps)
    if kept := [m for m in maps if m.map_id not in retired]:
        reasons = {c.feature_map.map_id: c.reason for c in batch if c.feature_map is not None}
        created = {r.map_id: r.created for r in database.commit_maps(kept, reasons=reasons)}
    outcomes = [map_outcome(c, created, options.making) for c in batch]
    return [
        replace(one, status="retired", reason=retired[one.map_id]) if one.map_id in retired else one
        for one in outcomes
    ]


def _quarantine_note(quarantined: Mapping[str, str]) -> tuple[str, ...]:
    """Why maps have a place and do not answer, and what can be done."""
    notes = []
    for reason in dict.fromkeys(quarantined.values()):
        ids = [map_id for map_id, of in quarantined.items() if of == reason]
        way = "--trust-geotags believes the geotags" if reason == HINTS else "; ".join(WAYS_TO_A_PLACE)
        notes.append(
            f"Maps in quarantine ({len(ids)}: {', '.join(ids[:3])}{', ...' if len(ids) > 3 else ''}): "
            f"{reason}. They answer only queries that name them, until something better confirms them: {way}."
        )
    return tuple(notes[:_MOST_NOTES])


def _twice(database: Database, outcomes: Sequence[MapOutcome], photos: set[str]) -> tuple[str, ...]:
    """Which other active maps have the same photos as active maps that were made now."""
    made = {o.map_id for o in outcomes if o.status == "committed"}
    if not made:
        return ()
    there = database.snapshot()
    having = there.maps_of_photos(photos)
    active = {m.map_id for m in there.maps() if m.status == "active"} & having.keys()
    notes = []
    for old in sorted(active - made):
        for new in sorted(active & made):
            if both := having[old] & having[new]:
                notes.append(
                    f"{len(both)} of the {len(having[new])} photos of map {new} are in active map {old}, "
                    f"too, and both answer. To keep one: featuredb retire {database.url} {old} --reason TEXT"
                )
    return tuple(notes[:_MOST_NOTES])


def _warnings(
    result: Reconstructed, outcomes: Sequence[MapOutcome], options: IngestOptions
) -> tuple[str, ...]:
    if options.stop_after is not None:
        return (f"Stopped after {options.stop_after}, as asked; nothing beyond it was done.",)
    if not outcomes:
        verified, tried = len(result.matched.inliers), len(result.matched.files)
        return (
            f"No reconstruction: {verified} of {tried} pairs of photos have enough verified matches. Photos "
            "of one place must overlap by more than half.",
        )
    if options.survey is not None and any(o.status == "already_there" for o in outcomes):
        return (
            "A map of these photos is there already and keeps its place; to place it by the control points: "
            "featuredb register DB MAP --gcp FILE",
        )
    return ()
