"""`featuredb grow`: contributed photos that wait become maps; once, or as a worker beside the server."""

import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from featuredb.atomic import atomic_file
from featuredb.errors import CandidateNotFoundError, FeatureDbError
from featuredb.store import Database, Snapshot
from featuredb.store.candidates.photos import list_candidates, load_images, refuse
from featuredb.store.candidates.states import Candidate
from ingest.executor import Executor, Progress, no_progress, open_executor
from ingest.growth.growth_report import GrowthReport, PhotoFate
from ingest.growth.run import grow
from ingest.growth.values import GrowthOptions, GrowthPhotos
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, scan_folder
from ingest.reconstruction import MapMakingOptions, Reconstructed, reconstruct_photos
from ingest.workspace import Workspace, default_root, remove_leftovers
from reloc.answered_view import geo_prior
from reloc.wire.query import PriorRequest

_LOG = logging.getLogger(__name__)
_MOST_PHOTOS = 2000  # that one run takes, oldest first; more wait for the next

_FOLDER = "candidates"
_HEX = re.compile(r"[0-9a-f]{32}")


def waiting_photos(
    database: Database, work: Path, progress: Progress = no_progress
) -> tuple[list[Photo], dict[str, tuple[str, str]]]:
    """The photos that wait for growth, written into the work folder where they are not there yet.

    Returns:
        Usable ones, oldest first, the stem of each name its candidate's id; reason code and sentence of the
        others, by candidate id: broken files, copies of others or of photos of active maps.

    Raises:
        StoreError: the database cannot be read.
    """
    candidates = list_candidates(database)
    waiting = {f"{c.candidate_id}.img": c for c in candidates if c.state == "waiting"}
    folder = work / _FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for name, candidate in waiting.items():
        _write_file(database, folder / name, candidate.candidate_id)
    kept = {c.candidate_id for c in candidates if c.state != "withdrawn"}
    for file in folder.glob("*.img"):
        if _HEX.fullmatch(file.stem) and file.stem not in kept:
            file.unlink(missing_ok=True)
    if not waiting:
        return [], {}
    scanned = scan_folder(folder, ScanOptions(), progress, work / "scan" / f"{_FOLDER}.json")
    by_name = {photo.name: photo for photo in scanned.photos if photo.name in waiting}
    copies = _copies(database.snapshot(), {photo.sha256 for photo in by_name.values()})
    photos: list[Photo] = []
    unusable: dict[str, tuple[str, str]] = {}
    for name, candidate in waiting.items():
        photo = by_name.get(name)
        if photo is None:  # withdrawn meanwhile
            continue
        if photo.sha256 in copies:
            reason = f"map {copies[photo.sha256]} was made from the same file; growth needs other photos"
            unusable[candidate.candidate_id] = ("DUPLICATE", reason)
        elif photo.status == "ok" or (photo.duplicate_of and photo.duplicate_of not in by_name):
            photos.append(_with_query(photo, candidate))
        else:
            unusable[candidate.candidate_id] = (photo.reason_code.upper(), photo.reason)
    return photos, unusable


def _copies(snapshot: Snapshot, digests: set[str]) -> dict[str, str]:
    """Of photos, by SHA-256, the active map that has the same file and did not grow out of contributions."""
    active = {m.map_id for m in snapshot.maps() if m.status == "active" and m.source != "growth"}
    having = snapshot.maps_of_photos(digests)
    return {digest: map_id for map_id in sorted(active & having.keys()) for digest in having[map_id]}


def _write_file(database: Database, target: Path, candidate_id: str) -> None:
    """A candidate's bytes, where they are not there yet; nothing for one that is withdrawn meanwhile."""
    if target.is_file():
        return
    try:
        data = next(load_images(database, [candidate_id]))[1]
    except CandidateNotFoundError:
        return
    with atomic_file(target) as temporary:
        temporary.write_bytes(data)


def _with_query(photo: Photo, candidate: Candidate) -> Photo:
    """The photo with what its query said: position, whom to name, licence; and who gave it."""
    try:
        prior = geo_prior(PriorRequest.model_validate(candidate.request.get("prior")))
    except ValueError:  # it has none, or a broken one
        prior = None
    return replace(
        photo,
        status="ok",
        reason_code="",
        reason="",
        gps=prior or photo.gps,
        owner=candidate.credit,
        licence=candidate.licence,
        contributor=candidate.owner,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowingOptions:
    """A run of `featuredb grow`.

    Attributes:
        growth: from reconstructions to promoted maps.
        making: from photos to reconstructions.
        workers: processes of extraction, matching and reconstruction, threads of localisation; 1 runs
            everything in one thread of this process.
        work: work folder; default inside the database.
        give_up_days: photos that have waited so long without any use are refused: each run tries all that
            wait. Their owner, or `featuredb candidates`, can open them again.
    """

    growth: GrowthOptions = field(default_factory=GrowthOptions)
    making: MapMakingOptions = field(default_factory=MapMakingOptions)
    workers: int = 1
    work: Path | None = None
    give_up_days: float = 90.0


def grow_candidates(
    database: Database,
    options: GrowingOptions | None = None,
    progress: Progress = no_progress,
    *,
    now: datetime | None = None,
) -> GrowthReport:
    """Take the contributed photos that wait, and let the database grow by them.

    Raises:
        StoreError, ConflictError: the database cannot be read or written; what is committed stands.
        IngestError: a worker process died; what it left is used again.
    """
    options = options or GrowingOptions()
    now = now or datetime.now(UTC)
    work = options.work or default_root(database.url)
    remove_leftovers(work)
    waiting, unusable = waiting_photos(database, work, progress)
    photos = waiting[:_MOST_PHOTOS]
    with open_executor(options.workers) as executor:
        new, unreadable = _prepared(photos, work, options, executor, progress)
    report = grow(database, new, work, replace(options.growth, threads=options.workers))
    refused = _refuse(database, {**unusable, **unreadable}, report, now, options)
    left = len(waiting) - len(photos)
    notes = (*report.notes, *((f"{left} photos wait for the next run",) if left else ()))
    kept = tuple(p for p in report.photos if p.name not in refused)
    return replace(report, photos=(*kept, *refused.values()), notes=notes)


def reconstructed_photos(done: Reconstructed, candidate_ids: Mapping[int, str] | None = None) -> GrowthPhotos:
    """Photos that `reconstruct_photos` has gone through, for `ingest.growth.run.grow`: of any origin.

    Args:
        candidate_ids: of contributed photos, by row of the usable ones.
    """
    return GrowthPhotos(
        photos=done.usable,
        features_of=done.features.__getitem__,
        models=done.reconstruction.models,
        candidate_ids=candidate_ids or {},
        overlaps=done.matched.inliers.keys(),
        geometry_of=done.matched.geometry,
    )


def _prepared(
    photos: Sequence[Photo], work: Path, options: GrowingOptions, executor: Executor, progress: Progress
) -> tuple[GrowthPhotos, dict[str, tuple[str, str]]]:
    """Features, matches and reconstructions of the waiting photos; and those that cannot be read."""
    if not photos:
        return GrowthPhotos(), {}
    done = reconstruct_photos(photos, Workspace(root=work), options.making, executor, progress=progress)
    rows = {row: Path(photo.name).stem for row, photo in enumerate(done.usable)}
    unreadable = {Path(name).stem: ("UNREADABLE", reason) for name, reason in done.unreadable.items()}
    return reconstructed_photos(done, rows), unreadable


def _refuse(
    database: Database,
    unusable: dict[str, tuple[str, str]],
    report: GrowthReport,
    now: datetime,
    options: GrowingOptions,
) -> dict[str, PhotoFate]:
    """Refuse for good what can never be used: broken files, copies, photos of retired maps, the forgotten."""
    retired = {p.name: (p.reason_code, p.reason) for p in report.photos if p.reason_code == "RETIRED_MAP"}
    reasons = unusable | retired
    candidates = {c.candidate_id: c for c in list_candidates(database, state="waiting")}
    for photo in report.photos:
        candidate = candidates.get(photo.name)
        if photo.outcome != "waiting" or candidate is None:
            continue
        if (now - candidate.received_at).total_seconds() > options.give_up_days * 86_400.0:
            text = f"waited {options.give_up_days:.0f} days: {photo.reason_code}: {photo.reason}"
            reasons.setdefault(photo.name, ("GAVE_UP", text))
    reasons = {c: why for c, why in reasons.items() if c in candidates}
    if reasons:
        refuse(database, reasons)
    return {
        c: PhotoFate(name=c, owner=candidates[c].owner, outcome="refused", reason_code=code, reason=reason)
        for c, (code, reason) in reasons.items()
    }


def watch_and_grow(
    database: Database,
    options: GrowingOptions,
    stop: threading.Event,
    on_report: Callable[[GrowthReport], None],
    *,
    poll_s: float = 30.0,
) -> None:
    """Grow whenever photos have arrived or the maps have changed, until `stop` is set.

    An error of one run is logged and tried again at the next poll: a worker that gives up is of no use.
    """
    seen: tuple[int, int] | None = None
    while not stop.is_set():
        try:
            state = _state(database)
            if state != seen:
                on_report(grow_candidates(database, options))
                seen = _state(database)
                if seen[1] > state[1]:  # photos arrived meanwhile
                    seen = state
        except FeatureDbError:
            _LOG.exception("growth failed; the next try is in %.0f s", poll_s)
        stop.wait(poll_s)


def _state(database: Database) -> tuple[int, int]:
    """What a run depends on: version of the maps, number of waiting photos."""
    return database.poll_version(), len(list_candidates(database, state="waiting"))
