"""The formats of models that come in, and what each of them gives."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from featuredb.errors import IngestError
from featuredb.export.formats.colmap import DATABASE
from ingest.models_in.colmap_folder import model_folder, open_keypoints, read_colmap
from ingest.models_in.opensfm_folder import opensfm_folder, read_opensfm
from ingest.models_in.stored import ModelFormat, ModelSource

NAMES: dict[ModelFormat, str] = {"colmap": "COLMAP", "opensfm": "OpenSfM"}


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
    if place is None:
        return _colmap(folder, colmap_database)
    if colmap_database is not None:
        raise IngestError(
            f"--database: expected a COLMAP model, found one of OpenSfM in {folder}; leave it out"
        )
    return _opensfm(folder, place, reconstruction)


def _colmap(folder: Path, database: Path | None) -> ModelSource:
    stored, place = read_colmap(folder), model_folder(folder)
    path = database or folder / DATABASE
    return ModelSource(
        format="colmap",
        place=place,
        stored=stored,
        files=(*sorted(place.glob("*.bin")), *sorted(place.glob("*.txt"))),
        feature_files=(path,) if path.is_file() else (),
        open_keypoints=partial(open_keypoints, path, stored),
    )


def _opensfm(folder: Path, place: Path, reconstruction: int | None) -> ModelSource:
    folders = (place / "images", folder / "images", place.absolute().parent / "images")
    return replace(
        read_opensfm(place, reconstruction),
        photos=next((path for path in folders if path.is_dir()), None),
        choice="" if reconstruction is None else f"reconstruction {reconstruction}",
    )
