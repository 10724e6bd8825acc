"""The formats of models that come in, and what each of them gives."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from featuredb.errors import IngestError
from featuredb.export.formats.colmap import DATABASE
from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.feature_map import GeoPrior
from ingest.models_in.colmap_database import open_features
from ingest.models_in.colmap_folder import model_folder, read_colmap
from ingest.models_in.kapture_folder import KaptureFeatures, is_kapture, read_kapture
from ingest.models_in.opensfm_folder import OpensfmFeatures, opensfm_folder, read_opensfm
from ingest.models_in.stored import StoredFeatures, StoredModel

ModelFormat = Literal["colmap", "opensfm", "kapture"]
NAMES: dict[ModelFormat, str] = {"colmap": "COLMAP", "opensfm": "OpenSfM", "kapture": "kapture"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelSource:
    """A model that has been read.

    Attributes:
        place: the folder that it was found in.
        files: what it was read from. feature_files: what its features will be.
        open_features: given the fingerprint of their extractor.
        has_descriptors: whether the format keeps descriptors that can be compared with ours.
        photos: where the format has its photos, None where that is anywhere.
        reference: the frame of the model's coordinates, without its accuracy; None: the files do not say.
        gps: for each image, what the files say of its own position; empty: nothing.
        choice: which of several models it is, "" where there is one.
    """

    format: ModelFormat
    place: Path
    stored: StoredModel
    files: tuple[Path, ...]
    open_features: Callable[[str], AbstractContextManager[StoredFeatures]]
    feature_files: tuple[Path, ...] = ()
    has_descriptors: bool = True
    photos: Path | None = None
    reference: LocalFrame | None = None
    gps: tuple[GeoPrior | None, ...] = ()
    choice: str = ""


def open_model(folder: Path, colmap_database: Path | None, reconstruction: int | None) -> ModelSource:
    """The model in a folder, of whatever format.

    Args:
        colmap_database: of a COLMAP model; None: in its folder.
        reconstruction: which of OpenSfM's.

    Raises:
        IngestError: there is none, or it cannot be read, or an option belongs to another format.
    """
    place = opensfm_folder(folder)
    if place is None and reconstruction is not None:
        raise IngestError(
            "--reconstruction: expected OpenSfM's reconstruction.json, found none; leave it out"
        )
    kapture = place is None and is_kapture(folder)
    if colmap_database is not None and (place is not None or kapture):
        found = "kapture" if kapture else "OpenSfM"
        raise IngestError(
            f"--database: expected a COLMAP model, found one of {found} in {folder}; leave it out"
        )
    if place is not None:
        return _opensfm(folder, place, reconstruction)
    return _kapture(folder) if kapture else _colmap(folder, colmap_database)


def _colmap(folder: Path, database: Path | None) -> ModelSource:
    stored, place = read_colmap(folder), model_folder(folder)
    path = database or folder / DATABASE
    return ModelSource(
        format="colmap",
        place=place,
        stored=stored,
        files=(*sorted(place.glob("*.bin")), *sorted(place.glob("*.txt"))),
        feature_files=(path,) if path.is_file() else (),
        open_features=lambda fingerprint: open_features(path, stored, fingerprint),
    )


def _opensfm(folder: Path, place: Path, reconstruction: int | None) -> ModelSource:
    opensfm = read_opensfm(place, reconstruction)
    folders = (place / "images", folder / "images", place.absolute().parent / "images")
    return ModelSource(
        format="opensfm",
        place=place,
        stored=opensfm.stored,
        files=opensfm.files,
        open_features=lambda fingerprint: nullcontext(OpensfmFeatures(opensfm, fingerprint)),
        has_descriptors=False,
        photos=next((path for path in folders if path.is_dir()), None),
        reference=opensfm.reference,
        gps=opensfm.gps,
        choice="" if reconstruction is None else f"reconstruction {reconstruction}",
    )


def _kapture(folder: Path) -> ModelSource:
    kapture = read_kapture(folder)
    photos = folder / "sensors" / "records_data"
    return ModelSource(
        format="kapture",
        place=folder,
        stored=kapture.stored,
        files=kapture.files,
        feature_files=kapture.feature_files,
        open_features=lambda fingerprint: nullcontext(KaptureFeatures(kapture, fingerprint)),
        has_descriptors=kapture.descriptors is not None,
        photos=photos if photos.is_dir() else None,
        gps=kapture.gps,
    )
