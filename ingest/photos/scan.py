"""A folder of files to photos: what each one is, what it says of itself, and why it is not used.

Nothing that a file contains is fatal. Every file is read, hashed and decoded once; a cache in the work
folder, keyed by name, size and modification time, spares that the next time.
"""

import hashlib
import os
import stat
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from featuredb.errors import ImageError, IngestError
from featuredb.features.decode import INGEST_LIMITS, DecodeLimits, decode_gray, probe, read_image_bytes
from featuredb.features.exif.gps import DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
from featuredb.features.exif.read import read_exif
from featuredb.features.image_header import check_signature
from featuredb.geo.projections import ecef_from_geodetic
from featuredb.maps.feature_map import GeoPrior, prior_from_exif
from ingest.executor import Progress, no_progress
from ingest.fingerprint import options_fingerprint
from ingest.photos.duplicates import MAX_BITS, exact_duplicates, near_duplicates, picture_hash
from ingest.photos.photo import Photo, without_unset_heights
from ingest.photos.table import PhotoTable, TableRow, is_table, read_table, summary_of
from ingest.photos.walk import ExaminedFile, FoundFile, read_cache, refused, walk, write_cache

# Raised when the same file would be judged differently, so that old caches are not used.
_VERSION = 3
# The cache is written after so many files, or a quarter of those that it has: writing it stays linear.
_SAVE_EVERY = 200

_REASONS = 3  # of skipped files that a refusal tells in full

# Standard deviation of a table's position that does not say its own. Geotags of photo sites are tens of
# metres off, where they are not wrong altogether.
_GEOTAG_SIGMA_M = 30.0
_FAR_M = 1000.0  # no receiver is that far off: table and photo speak of two places


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanOptions:
    """What is taken from a folder.

    Attributes:
        limits: sizes that are refused.
        exclude: shell patterns; a file whose name, with or without its folder, fits one is left out.
        workers: threads; 0 for one per core, at most 8 (decoding is limited by memory bandwidth then).
        owner, licence: attribution of photos that do not name their own.
        trust_geotags: positions of a table place maps as those of a folder do.
        films: the photos are keyframes, those of each film in a folder of its own.
    """

    limits: DecodeLimits = INGEST_LIMITS
    exclude: tuple[str, ...] = ()
    workers: int = 0
    owner: str = ""
    licence: str = ""
    trust_geotags: bool = False
    films: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanResult:
    """Every file of a folder.

    Attributes:
        photos: all files, used or not, sorted by name.
        read: files that were opened; the others were in the cache or refused by their name.
        notes: what is wrong with the table, where there is one, and with heights.
    """

    photos: tuple[Photo, ...]
    read: int = 0
    notes: tuple[str, ...] = ()

    @property
    def usable(self) -> tuple[Photo, ...]:
        """Photos to be ingested."""
        return tuple(photo for photo in self.photos if photo.status == "ok")

    @property
    def skipped(self) -> dict[str, int]:
        """Number of skipped files by reason code."""
        return Counter(photo.reason_code for photo in self.photos if photo.status == "skipped")


def scan_folder(
    folder: Path,
    options: ScanOptions | None = None,
    progress: Progress = no_progress,
    cache_file: Path | None = None,
) -> ScanResult:
    """Look at every file of a folder.

    Args:
        folder: the photos.
        options: default ScanOptions().
        progress: called as progress("scan", files done, all files).
        cache_file: where results are kept for the next run; None: nowhere.

    Raises:
        IngestError: the folder cannot be listed.
    """
    options = options or ScanOptions()
    files = [_excluded(file, options.exclude) for file in walk(folder)]
    return _scan_files(files, options, progress, cache_file, {})


def scan_table(
    table: PhotoTable,
    options: ScanOptions | None = None,
    progress: Progress = no_progress,
    cache_file: Path | None = None,
) -> ScanResult:
    """Look at every photo of a table; what the table says goes before what the file says.

    Args: see `scan_folder`. Files that are not there, and rows that cannot be read, are among the photos
        with their reason.
    """
    options = options or ScanOptions()
    files = [_excluded(_table_file(row), options.exclude) for row in table.rows]
    rows = {row.name: row for row in table.rows}
    result = _scan_files(sorted(files, key=lambda f: f.name), options, progress, cache_file, rows)
    bad = [
        Photo(
            name=f"row {number}",
            path=Path(f"row {number}"),
            status="skipped",
            reason_code="bad_row",
            reason=f"of the table: {reason}",
        )
        for number, reason in table.bad
    ]
    return replace(result, photos=(*result.photos, *bad), notes=(*summary_of(table), *result.notes))


def _table_file(row: TableRow) -> FoundFile:
    try:
        info = row.path.stat()
    except (OSError, ValueError):
        return refused(
            row.name, row.path, "missing", f"row {row.number} of the table: {row.path.name} is not there"
        )
    if not stat.S_ISREG(info.st_mode):
        return refused(row.name, row.path, "unreadable", "not a regular file")
    return FoundFile(name=row.name, path=row.path, size=info.st_size, mtime_ns=info.st_mtime_ns)


def _scan_files(
    files: Sequence[FoundFile],
    options: ScanOptions,
    progress: Progress,
    cache_file: Path | None,
    rows: Mapping[str, TableRow],
) -> ScanResult:
    key = f"{_VERSION}:{options_fingerprint(options.limits)}"
    known = read_cache(cache_file, key) if cache_file else {}
    examined, read = _examine_all(files, known, options, progress, cache_file, key)
    photos = [_as_photo(file, examined.get(file.name), options) for file in files]
    notes = _far_from_exif(photos, rows)
    photos = [_with_row(p, rows[p.name], options) if p.name in rows else p for p in photos]
    photos, unset = without_unset_heights(photos)
    photos = _without_copies(photos, {name: e.picture_hash for name, e in examined.items()})
    return ScanResult(photos=tuple(photos), read=read, notes=(*notes, *unset))


def _far_from_exif(photos: Sequence[Photo], rows: Mapping[str, TableRow]) -> tuple[str, ...]:
    """A line on a table that puts photos far from where they say themselves: it may be of other photos."""
    apart_m: dict[str, float] = {}
    for photo in photos:
        row, own = rows.get(photo.name), photo.gps
        if own is None or row is None or row.latitude_deg is None or row.longitude_deg is None:
            continue
        two = [(own.latitude_deg, own.longitude_deg, 0.0), (row.latitude_deg, row.longitude_deg, 0.0)]
        apart_m[photo.name] = float(np.linalg.norm(np.diff(ecef_from_geodetic(np.array(two)), axis=0)))
    far = [name for name, metres in apart_m.items() if metres > _FAR_M]
    if not far:
        return ()
    return (
        f"table: {len(far)} of {len(apart_m)} photos lie more than {_FAR_M / 1e3:.0f} km from the positions "
        f"in their EXIF, {far[0]} by {apart_m[far[0]] / 1e3:.1f} km; the table's are used: check that it is "
        "of these photos",
    )


def _excluded(file: FoundFile, patterns: Sequence[str]) -> FoundFile:
    """The file, refused if a pattern fits it."""
    for pattern in patterns:
        if fnmatchcase(file.name, pattern) or fnmatchcase(file.name.rsplit("/", 1)[-1], pattern):
            return replace(file, reason_code="excluded", reason=f"left out by the pattern {pattern!r}")
    return file


def _examine_all(
    files: Sequence[FoundFile],
    known: dict[str, ExaminedFile],
    options: ScanOptions,
    progress: Progress,
    cache_file: Path | None,
    key: str,
) -> tuple[dict[str, ExaminedFile], int]:
    """The examined regular files by name, and how many were not in the cache."""
    results: dict[str, ExaminedFile] = {}
    todo: list[FoundFile] = []
    for file in files:
        if file.reason_code:
            continue
        old = known.get(file.name)
        same = old is not None and (old.size, old.mtime_ns) == (file.size, file.mtime_ns)
        # What was not supported may be now, by another version or a package that is installed since.
        if old is not None and same and old.reason_code != "unsupported":
            results[file.name] = old
        else:
            todo.append(file)
    done = len(files) - len(todo)
    progress("scan", done, len(files))
    next_save = _SAVE_EVERY
    workers = options.workers or min(8, os.cpu_count() or 1)
    with ThreadPoolExecutor(workers, thread_name_prefix="scan") as pool:
        futures = {pool.submit(examine, file, options.limits): file for file in todo}
        for count, future in enumerate(as_completed(futures), start=1):
            results[futures[future].name] = future.result()
            progress("scan", done + count, len(files))
            if cache_file and count >= next_save:
                write_cache(cache_file, key, results)
                next_save = count + max(_SAVE_EVERY, len(results) // 4)
    if cache_file and (todo or results.keys() != known.keys()):
        write_cache(cache_file, key, results)
    return results, len(todo)


def examine(file: FoundFile, limits: DecodeLimits) -> ExaminedFile:
    """Read one file once: its digest, its picture and its metadata, or why it is none."""
    sha256 = ""
    try:
        _check_head(file.path)
        data = read_image_bytes(file.path, limits)
        sha256 = hashlib.sha256(data).hexdigest()
        header = probe(data, limits)
        gray = decode_gray(data, limits, header=header)
    except ImageError as error:
        return ExaminedFile(file.size, file.mtime_ns, sha256, reason_code=error.code, reason=str(error))
    return ExaminedFile(
        file.size, file.mtime_ns, sha256, picture_hash=picture_hash(gray), exif=read_exif(data, header)
    )


def _check_head(path: Path) -> None:
    """Refuse films and documents by their first bytes, before gigabytes are read."""
    try:
        with path.open("rb") as file:
            head = file.read(32)
    except OSError as error:
        raise ImageError(f"{path.name} cannot be read: {error.strerror or error}", "unreadable") from error
    check_signature(head)


def _as_photo(file: FoundFile, examined: ExaminedFile | None, options: ScanOptions) -> Photo:
    if examined is None or examined.exif is None:
        source = examined or file
        return Photo(
            name=file.name,
            path=file.path,
            sha256=examined.sha256 if examined else "",
            status="skipped",
            reason_code=source.reason_code,
            reason=source.reason,
        )
    exif = examined.exif
    return Photo(
        name=file.name,
        path=file.path,
        sha256=examined.sha256,
        width=exif.width,
        height=exif.height,
        orientation=exif.orientation,
        make=exif.make,
        model=exif.model,
        camera_key=exif.camera_key,
        focal_px=exif.focal_px,
        capture_time=exif.capture_time,
        angles=exif.angles,
        warnings=exif.warnings,
        gps=prior_from_exif(exif),
        owner=exif.artist or options.owner,
        licence=exif.copyright or options.licence,
        film=file.name.rpartition("/")[0] if options.films else "",
    )


def _with_row(photo: Photo, row: TableRow, options: ScanOptions) -> Photo:
    """The photo with what the table says of it; all else stays as EXIF has it."""
    gps = photo.gps
    if row.latitude_deg is not None and row.longitude_deg is not None:
        gps = GeoPrior(
            latitude_deg=row.latitude_deg,
            longitude_deg=row.longitude_deg,
            height_m=row.height_m if row.height_m is not None or gps is None else gps.height_m,
            sigma_horizontal_m=row.accuracy_m or _GEOTAG_SIGMA_M,
            sigma_vertical_m=_sigma_of_height(row, photo),
        )
    elif gps is not None:
        gps = replace(
            gps,
            height_m=gps.height_m if row.height_m is None else row.height_m,
            sigma_horizontal_m=row.accuracy_m or gps.sigma_horizontal_m,
            sigma_vertical_m=row.accuracy_height_m or gps.sigma_vertical_m,
        )
    return replace(
        photo,
        gps=gps,
        gps_is_hint=gps is not None and not options.trust_geotags,
        angles=row.angles or photo.angles,
        capture_time=row.time or photo.capture_time,
        owner=row.owner or photo.owner,
        licence=row.licence or photo.licence,
        title=row.title,
        warnings=(*photo.warnings, *row.warnings),
    )


def _sigma_of_height(row: TableRow, photo: Photo) -> float:
    """As the table says; a height of its own is worse than its position by as much as a plain receiver's."""
    if row.accuracy_height_m is not None:
        return row.accuracy_height_m
    if row.height_m is not None:
        ratio = DEFAULT_SIGMA_VERTICAL_M / DEFAULT_SIGMA_HORIZONTAL_M
        return ratio * (row.accuracy_m or _GEOTAG_SIGMA_M)
    return _GEOTAG_SIGMA_M if photo.gps is None else photo.gps.sigma_vertical_m


def _without_copies(photos: list[Photo], hashes: Mapping[str, str]) -> list[Photo]:
    """The photos, those that are copies of others skipped."""
    exact = exact_duplicates(photos)
    usable = [photo for photo in photos if photo.status == "ok" and photo.name not in exact]
    near = near_duplicates(usable, [hashes[photo.name] for photo in usable])
    copies = {name: ("duplicate", f"the same bytes as {kept}", kept) for name, kept in exact.items()}
    for name, (kept, bits) in near.items():
        reason = f"the same picture as {kept} ({bits} of 256 bits differ, the limit is {MAX_BITS})"
        copies[name] = ("near_duplicate", reason, kept)
    return [_skipped(photo, *copies[photo.name]) if photo.name in copies else photo for photo in photos]


def _skipped(photo: Photo, code: str, reason: str, duplicate_of: str) -> Photo:
    return replace(photo, status="skipped", reason_code=code, reason=reason, duplicate_of=duplicate_of)


def require_photos(folder: Path) -> None:
    """Before a database is made for them: does anything begin as a photo? Of a table, is it one?

    Raises:
        IngestError: no folder, nothing in it does, or the table cannot be read.
    """
    if is_table(folder):
        read_table(folder)
        return
    found = [file for file in walk(folder) if not file.reason_code]
    if not any(_begins_as_photo(file.path) for file in found):
        raise IngestError(
            f"{folder}: expected photos (JPEG, HEIC, AVIF, PNG, WebP, TIFF, BMP) in it or in folders in it, "
            f"found none among {len(found)} files; check the path"
        )


def _begins_as_photo(path: Path) -> bool:
    try:
        _check_head(path)
    except ImageError:
        return False
    return True


def require_usable(result: ScanResult, folder: Path, least: int = 1) -> tuple[Photo, ...]:
    """The usable photos.

    Raises:
        IngestError: fewer than `least`; the message counts the reasons.
    """
    usable = result.usable
    if len(usable) < least:
        reasons = ", ".join(f"{count} {code}" for code, count in sorted(result.skipped.items())) or "no files"
        first = {p.reason_code: f"; {p.name}: {p.reason}" for p in reversed(result.photos) if p.reason_code}
        told = "".join(first[code] for code in sorted(first)[:_REASONS])
        raise IngestError(
            f"{folder}: expected at least {least} usable photos, found {len(usable)} of "
            f"{len(result.photos)} files (skipped: {reasons}{told})"
        )
    return usable
