"""Contributed photos as photos of an ingest: files in the work folder, metadata of file and query."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from featuredb.errors import CandidateNotFoundError
from featuredb.maps.feature_map import GeoPrior
from featuredb.store import Database
from featuredb.store.candidates.photos import list_candidates, load_images
from featuredb.store.candidates.states import Candidate
from ingest.executor import Progress, no_progress
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, scan_folder
from ingest.workspace import atomic_file
from reloc.answered_view import geo_prior
from reloc.wire.query import PriorRequest

_FOLDER = "candidates"
_HEX = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidatePhotos:
    """What waits.

    Attributes:
        photos: usable ones, oldest first; `Photo.name` is the candidate's id with an ending.
        candidate_ids: of them, in the same order.
        unusable: reason code and sentence of the others, by candidate id: broken files, copies of others.
    """

    photos: tuple[Photo, ...]
    candidate_ids: tuple[str, ...]
    unusable: dict[str, tuple[str, str]]


def waiting_photos(database: Database, work: Path, progress: Progress = no_progress) -> CandidatePhotos:
    """The photos that wait for growth, written into the work folder where they are not there yet.

    Raises:
        StoreError: the database cannot be read.
    """
    candidates = list_candidates(database)
    wanted = [c for c in candidates if c.state == "waiting"]
    folder = work / _FOLDER
    files = _write_files(database, folder, wanted)
    _remove_withdrawn(folder, candidates)
    if not files:
        return CandidatePhotos(photos=(), candidate_ids=(), unusable={})
    scanned = scan_folder(folder, ScanOptions(), progress, work / "scan" / f"{_FOLDER}.json")
    by_name = {photo.name: photo for photo in scanned.photos}
    live = {files[c.candidate_id] for c in wanted if c.candidate_id in files}
    photos, ids = [], []
    unusable: dict[str, tuple[str, str]] = {}
    for candidate in wanted:
        name = files.get(candidate.candidate_id)
        photo = None if name is None else by_name.get(name)
        if photo is None:
            continue
        if photo.status == "ok" or (photo.duplicate_of and photo.duplicate_of not in live):
            photos.append(_with_query(photo, candidate))
            ids.append(candidate.candidate_id)
        else:
            unusable[candidate.candidate_id] = (photo.reason_code.upper(), photo.reason)
    return CandidatePhotos(photos=tuple(photos), candidate_ids=tuple(ids), unusable=unusable)


def _write_files(database: Database, folder: Path, wanted: Sequence[Candidate]) -> dict[str, str]:
    """Names of the files of candidates, by id; those that are withdrawn meanwhile have none."""
    names = {c.candidate_id: f"{c.candidate_id}.img" for c in wanted}
    folder.mkdir(parents=True, exist_ok=True)
    for candidate_id, name in list(names.items()):
        target = folder / name
        if target.is_file():
            continue
        try:
            data = next(load_images(database, [candidate_id]))[1]
        except CandidateNotFoundError:
            del names[candidate_id]
            continue
        with atomic_file(target) as temporary:
            temporary.write_bytes(data)
    return names


def _remove_withdrawn(folder: Path, candidates: Sequence[Candidate]) -> None:
    """Withdrawn photos leave the work folder, too."""
    kept = {c.candidate_id for c in candidates if c.state != "withdrawn"}
    for file in folder.glob("*.img"):
        if _HEX.fullmatch(file.stem) and file.stem not in kept:
            file.unlink(missing_ok=True)


def _with_query(photo: Photo, candidate: Candidate) -> Photo:
    """The photo with what its query said: position, whom to name, licence; and who gave it."""
    prior = _prior(candidate.request.get("prior"))
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


def _prior(asked: Any) -> GeoPrior | None:
    """The position of a wire request, as it was stored; None where it has none or a broken one."""
    try:
        return geo_prior(PriorRequest.model_validate(asked))
    except ValueError:
        return None
