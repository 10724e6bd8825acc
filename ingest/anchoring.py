"""`featuredb anchor` from the database to the database: loads, anchors, writes pictures and report, commits.

The commit is the last step and one atomic change: whatever interrupts the work before it leaves the database
as it was.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import RegistrationError
from featuredb.features.decode import INGEST_LIMITS, decode_rgb
from featuredb.geo.utm import geodetic_from_utm, utm_from_geodetic
from featuredb.geo.words import way_words
from featuredb.lidar.load import chosen_scans, load_cloud
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database, MapSummary, Snapshot, UnplacedSummary
from featuredb.store.scans import list_scans
from ingest.executor import Progress, no_progress
from ingest.growth.unplaced import left_over
from ingest.register.anchor.anchor_map import AnchorResult, on_outlines, place_map
from ingest.register.anchor.files import PhotoFiles, find_photos, load_proposals, save_proposals
from ingest.register.anchor.frames import FRAMES, TriedFrames, try_frames
from ingest.register.anchor.page import write_anchor_report
from ingest.register.anchor.report import AnchorReport
from ingest.register.anchor.start.first_place import (
    MARGIN_M,
    FirstPlace,
    StartFiles,
    check_on_scan,
    first_place,
    plan_box,
    started_images,
)
from ingest.register.anchor.start.priors import image_named
from ingest.register.frame_registration import FramePrior

_CONFIRM = "--confirm"
_NOT_THERE = "they do not lie there"
_BY_OUTLINES = "placed by outlines of a scan; nothing has confirmed it"


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorRequest:
    """What a person asks for.

    Attributes:
        map_id: or its first letters, if no other map begins so.
        photos: folder of the map's photos.
        scan_ids: or their first letters; empty for all scans around the map.
        out: folder of pictures and report, None for ./anchor-MAP.
        frames: how many to register, None for the default.
        auto: place the map without a person.
        confirm: names of proposed frames that a person has confirmed.
        start: where a registration starts.
        storage_options: as the command line had them, for the command that confirms.
    """

    map_id: str
    photos: Path
    scan_ids: tuple[str, ...] = ()
    out: Path | None = None
    frames: int | None = None
    auto: bool = False
    confirm: tuple[str, ...] = ()
    start: StartFiles = field(default_factory=StartFiles)
    storage_options: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anchoring:
    """What was done.

    Attributes:
        report: everything about the registration and placement.
        page: the report, in which frames are flicked through.
        placed: whether the map is in the database at its new place. version: of the database since;
            version_before: the last one that shows the old place.
        flagged: maps that were quarantined, because this one had placed them.
        proposed: names of the registered frames, where nobody has decided yet.
        command: that confirms all of them.
    """

    report: AnchorReport
    page: Path
    placed: bool = False
    version: int = -1
    version_before: int = -1
    flagged: tuple[str, ...] = ()
    proposed: tuple[str, ...] = ()
    command: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """What is loaded for a request."""

    request: AnchorRequest
    snapshot: Snapshot
    summary: MapSummary | UnplacedSummary
    unplaced: UnplacedMap | None
    feature_map: FeatureMap
    first: FirstPlace | None
    files: PhotoFiles
    cloud: PointCloud
    scan_ids: tuple[str, ...]
    out: Path

    def rgb(self, image: MapImage) -> NDArray[np.uint8]:
        return decode_rgb(self.files.path(image), INGEST_LIMITS)


def anchor(database: Database, request: AnchorRequest, progress: Progress = no_progress) -> Anchoring:
    """Do what the request asks for.

    Raises:
        RegistrationError: photos, scan or a person's file are missing or do not fit.
        MapNotFoundError, ScanNotFoundError, ScanError, StoreError
        ConflictError: someone else placed the map anew meanwhile.
    """
    job = _load(database, request)
    wanted = FRAMES if request.frames is None else request.frames
    result: AnchorResult | None
    if request.confirm:
        tried = _confirmed(job)
        notes = [f"confirmed by a person: {', '.join(f.image.name for f in tried.accepted)}"]
    elif job.first is not None and job.first.on_outlines:
        tried, notes = TriedFrames(shift=None, ranking=(), tried=()), list(job.first.notes)
        result = on_outlines(job.feature_map, job.cloud) if request.auto else None
        return _finished(database, job, tried, result, notes)
    else:
        starts, notes = _starts(job)
        tried = try_frames(
            job.feature_map,
            job.cloud,
            job.files.gray,
            wanted,
            starts=starts,
            readable=list(job.files.paths),
            together=job.first is None or not job.first.by_look,
            progress=progress,
        )
    notes += _about_photos(job, tried)
    result = None
    if request.auto or request.confirm:
        supervised = bool(request.confirm or request.start.pose or request.start.picks)
        result = place_map(
            job.feature_map, job.cloud, tried, job.files.gray, wanted,
            confirmed=bool(request.confirm), supervised=supervised, progress=progress,
        )  # fmt: skip
    return _finished(database, job, tried, result, notes)


def _finished(
    database: Database, job: _Job, tried: TriedFrames, result: AnchorResult | None, notes: Sequence[str]
) -> Anchoring:
    """Write everything down, then commit."""
    rest, lines = _rest_of(job)
    notes = [*notes, *lines]
    report = AnchorReport(
        map_id=job.summary.map_id,
        map_name=job.summary.name,
        database=database.url,
        photos=str(job.files.folder),
        scan_ids=job.scan_ids,
        epsg=job.feature_map.epsg,
        datum_before=job.feature_map.height_datum,
        datum_after=job.cloud.height_datum,
        tried=tried,
        result=result,
        notes=tuple(notes),
    )
    on_fronts = job.first is not None and job.first.on_outlines
    command = _confirm_command(database, job, "--auto" if on_fronts else f"{_CONFIRM} {{image}}")
    page = write_anchor_report(job.out, report, job.feature_map, job.cloud, job.rgb, command)
    done = Anchoring(report=report, page=page)
    if result is None:
        saved = {f.image.image_id: f.registration for f in tried.accepted}
        save_proposals(job.out, _state(job), saved)
        if on_fronts:
            return replace(done, proposed=tuple(i.name for i in job.feature_map.images), command=command)
        names = tuple(f.image.name for f in tried.accepted)
        confirmed = f" {_CONFIRM} ".join(shlex.quote(name) for name in names)
        return replace(done, proposed=names, command=command.replace("{image}", confirmed))
    if result.feature_map is None:
        return done
    map_id = job.summary.map_id
    committed, *_ = database.commit_maps(
        [result.feature_map, *rest],
        replaces=(map_id,),
        based_on={map_id: job.summary.write_id},
        reasons={map_id: _BY_OUTLINES} if on_fronts else None,
    )
    return replace(
        done,
        placed=True,
        version=committed.version,
        version_before=job.snapshot.version,
        flagged=committed.flagged,
    )


def _rest_of(job: _Job) -> tuple[list[UnplacedMap], list[str]]:
    """What does not lie where a part of a map without a place was found, where it is a map still; lines."""
    left = 0 if job.unplaced is None else len(job.unplaced.images) - len(job.feature_map.images)
    if job.unplaced is None or not left:
        return [], []
    rest = left_over(job.unplaced, job.feature_map, by="outlines of a scan", code="LEFT_OUT", why=_NOT_THERE)
    if not rest:
        return [], [f"{left} photos do not lie there, too few for a map of their own: they are left out"]
    return rest, [f"the other {left} photos become map {rest[0].map_id}, without a place"]


def _confirm_command(database: Database, job: _Job, decision: str) -> str:
    """What a person runs to confirm a frame, whose name goes in the place of {image}, or the map."""
    words = ["featuredb", "anchor", database.url, job.summary.map_id, "--photos", str(job.files.folder)]
    for option in job.request.storage_options:
        words += ["--storage-option", option]
    if job.first is not None:  # where it was put for the proposals is found again by the same words
        words += job.request.start.words()
    for scan_id in job.request.scan_ids:
        words += ["--scan", scan_id]
    words += ["--out", str(job.out)]
    return f"{shlex.join(words)} {decision}"


def _load(database: Database, request: AnchorRequest) -> _Job:
    snapshot = database.snapshot()
    summary = snapshot.find(request.map_id)
    loaded = snapshot.load_any(summary.map_id)
    if request.scan_ids:
        meant = chosen_scans(database, request.scan_ids)
        request = replace(request, scan_ids=tuple(scan.scan_id for scan in meant))
    files = find_photos(loaded, request.photos)
    first: FirstPlace | None = None
    if isinstance(loaded, UnplacedMap):
        first = first_place(database, loaded, request.start, request.scan_ids, files)
        feature_map, cloud, scan_ids = first.feature_map, first.cloud, first.scan_ids
    else:
        assert isinstance(summary, MapSummary)
        if request.start.near is not None:
            raise RegistrationError(
                f"--near looks for maps without a place; map {summary.map_id} has one. If that is wrong, say "
                "where one photo is: --pose FILE or --picks FILE"
            )
        feature_map = loaded
        scan_ids = request.scan_ids or _scans_around(database, feature_map, summary)
        cloud = load_cloud(database, feature_map.frame, plan_box(feature_map), scan_ids=scan_ids)
    if not len(cloud):
        raise RegistrationError(
            f"scan {', '.join(scan_ids)} has no points within {MARGIN_M:.0f} m of map {summary.map_id}"
            + (_where_scans_lie(database, summary, scan_ids) if isinstance(summary, MapSummary) else "")
            + "; `featuredb lidar list` tells where scans lie"
        )
    return _Job(
        request=request,
        snapshot=snapshot,
        summary=summary,
        unplaced=loaded if isinstance(loaded, UnplacedMap) else None,
        feature_map=feature_map,
        first=first,
        files=files,
        cloud=cloud,
        scan_ids=tuple(scan_ids),
        out=request.out or Path(f"anchor-{summary.map_id}"),
    )


def _scans_around(database: Database, feature_map: FeatureMap, summary: MapSummary) -> tuple[str, ...]:
    """Scans of the map's zone whose box touches the map's with a margin, or of other zones nearby."""
    scans = list_scans(database)
    if not scans:
        raise RegistrationError(f"{database.url} has no scan; add one by `featuredb lidar add`")
    box = summary.box
    if box is None:
        raise RegistrationError(f"map {summary.map_id} has no points; nothing can be placed")
    around = [
        scan.scan_id
        for scan in scans
        if scan.epsg != feature_map.epsg
        or scan.box.touches(
            box.min_easting - MARGIN_M,
            box.min_northing - MARGIN_M,
            box.max_easting + MARGIN_M,
            box.max_northing + MARGIN_M,
        )
    ]
    if not around:
        raise RegistrationError(
            f"no scan of {database.url} lies within {MARGIN_M:.0f} m of map {summary.map_id} "
            f"(easting {box.min_easting:.0f} to {box.max_easting:.0f}, northing {box.min_northing:.0f} to "
            f"{box.max_northing:.0f}, EPSG:{feature_map.epsg})"
            + _where_scans_lie(database, summary, [scan.scan_id for scan in scans])
            + "; otherwise add one that covers it by `featuredb lidar add`"
        )
    return tuple(around)


def _where_scans_lie(database: Database, summary: MapSummary, scan_ids: Sequence[str]) -> str:
    """How far from the map the nearest of the scans is, and what that may mean."""
    box = summary.box
    ways = []
    for scan in list_scans(database):
        if scan.scan_id in scan_ids and box is not None:
            middle = ((box.min_easting + box.max_easting) / 2, (box.min_northing + box.max_northing) / 2, 0.0)
            here = utm_from_geodetic(geodetic_from_utm(middle, summary.epsg), scan.epsg)
            low = np.array([scan.box.min_easting, scan.box.min_northing])
            high = np.array([scan.box.max_easting, scan.box.max_northing])
            ways.append((scan.scan_id, np.clip(here[:2], low, high) - here[:2]))
    if not ways:
        return ""
    name, way = min(ways, key=lambda one: float(np.linalg.norm(one[1])))
    return (
        f". The nearest, {name}, lies {way_words(*way.tolist())}: if it shows the place of the photos, their "
        "positions are all wrong by that; ingest them anew with a table of the right ones"
    )


def _starts(job: _Job) -> tuple[dict[int, FramePrior], list[str]]:
    """Priors by a person, with a line on each."""
    request, feature_map = job.request, job.feature_map
    if job.first is not None:
        starts, notes = dict(job.first.starts), list(job.first.notes)
    else:
        told = request.start.read()
        check_on_scan(told, job.cloud, feature_map.epsg)
        found = started_images(feature_map, told, feature_map.frame, feature_map.epsg)
        starts = {f.image.image_id: f.prior for f in found}
        notes = [f.note for f in found]
    for image_id in starts:
        image = next(i for i in feature_map.images if i.image_id == image_id)
        job.files.path(image)  # raises where the photo is missing
    return starts, notes


def _confirmed(job: _Job) -> TriedFrames:
    """The proposed frames that the person confirms, as if they had just been registered."""
    saved = load_proposals(job.out, _state(job))
    chosen = [image_named(job.feature_map, name) for name in job.request.confirm]
    unknown = [image.name for image in chosen if image.image_id not in saved]
    if unknown:
        names = {i.image_id: i.name for i in job.feature_map.images}
        raise RegistrationError(
            f"{', '.join(unknown)}: not among the proposed frames: "
            f"{', '.join(names[i] for i in saved) or 'none'}"
        )
    return TriedFrames.of_registrations(
        job.feature_map, {image.image_id: saved[image.image_id] for image in chosen}
    )


def _state(job: _Job) -> tuple[str, str, str]:
    """What proposals belong to: a map, its state, a scan, and the frame of their poses."""
    frame = job.cloud.frame
    place = f"{frame.latitude_deg!r},{frame.longitude_deg!r},{frame.height_m!r}"
    return job.summary.map_id, job.summary.write_id, f"{' '.join(job.scan_ids)} from {place}"


def _about_photos(job: _Job, tried: TriedFrames) -> list[str]:
    notes = []
    if job.files.missing:
        names = {i.image_id: i.name for i in job.feature_map.images}
        few = "; ".join(f"{names[i]}: {why}" for i, why in list(job.files.missing.items())[:3])
        notes.append(f"{len(job.files.missing)} of {len(names)} photos are not used: {few}")
    notes += [f"{name} cannot be read: {why}" for name, why in tried.unreadable.items()]
    return notes
