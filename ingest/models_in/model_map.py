"""A model of another program becomes a map of a database, with its place on Earth or without one."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from featuredb.atomic import file_sha256
from featuredb.errors import IngestError
from featuredb.export.formats.colmap import DATABASE
from featuredb.export.georeference import GEOREFERENCE
from featuredb.features.extractor import ExtractorOptions
from featuredb.geo.datum import check_datum
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.maps.unplaced_map import AnyMap, MapKind, NoPlace
from ingest.colmap.bridge import Model
from ingest.fingerprint import digest
from ingest.map_builder import MapIdentity, MapOptions, build_map, build_unplaced_map
from ingest.models_in.colmap_folder import model_folder, open_keypoints, read_colmap
from ingest.models_in.opensfm_folder import opensfm_folder, read_opensfm
from ingest.models_in.place import (
    Place,
    Stated,
    place_as_stated,
    place_at_reference,
    place_by_photos,
    place_of_georeference,
)
from ingest.models_in.stored import ModelFeatures, ModelFormat, ModelSource
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, scan_folder
from ingest.sfm.extract import PhotoFeatures

Descriptors = Literal["stored", "photos"]

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
    if place is not None:
        if colmap_database is not None:
            raise IngestError(
                f"--database: expected a COLMAP model, found one of OpenSfM in {folder}; leave it out"
            )
        return read_opensfm(place, reconstruction)
    if reconstruction is not None:
        raise IngestError(
            "--reconstruction: expected OpenSfM's reconstruction.json, found none; leave it out"
        )
    stored, place = read_colmap(folder), model_folder(folder)
    path = colmap_database or folder / DATABASE
    return ModelSource(
        format="colmap",
        place=place,
        stored=stored,
        files=(*sorted(place.glob("*.bin")), *sorted(place.glob("*.txt"))),
        feature_files=(path,) if path.is_file() else (),
        open_keypoints=partial(open_keypoints, path, stored),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelOptions:
    """How a model is imported.

    Attributes:
        photos: folder of the photos under the names that the model has; needed where no georeference.json
            names them, and where descriptors are made of them; None: where the format has its photos.
        sigma_m: how well the place is known that the model's own reference gives, horizontally and
            vertically, if a person says so.
        descriptors: those in the files (also where None, if the format has them), or made anew of the photos
            at the same keypoints.
        height_datum: of the heights where no georeference.json says it.
        min_track_length: points seen by at least that many photos carry descriptors.
    """

    photos: Path | None = None
    stated: Stated | None = None
    colmap_database: Path | None = None
    descriptors: Descriptors | None = None
    height_datum: str = "unknown"
    min_track_length: int = 2
    name: str = ""
    owner: str = ""
    licence: str = ""
    # Not in the text that names maps: without them it is as it was before they were there.
    sigma_m: tuple[float, float] | None = field(default=None, repr=False)
    reconstruction: int | None = field(default=None, repr=False)


def map_of_model(folder: Path, options: ModelOptions) -> AnyMap:
    """The map of the model in a folder: of COLMAP, of OpenSfM or of OpenDroneMap.

    Without a place where nobody says it, and the photos' GPS does not.

    Raises:
        IngestError: the model cannot be read or described, or not be where it is said to be; what is missing.
    """
    check_datum(options.height_datum)
    source = open_model(folder, options.colmap_database, options.reconstruction)
    anew = _described_anew(source, options)
    document = read_georeference(folder, source.place)
    photos = photos_of_model(source, document, options, anew=anew)
    place = place_of(source, document, photos, options)
    said = None if isinstance(place, NoPlace) else place.height_datum
    if said is not None and options.height_datum not in ("unknown", said):
        raise IngestError(
            f"--height-datum {options.height_datum}: {GEOREFERENCE} says that heights are {said}"
        )
    fingerprint = ExtractorOptions().fingerprint
    ours = document is not None and document["map"].get("extractor_fingerprint")
    if ours and not anew:
        fingerprint = str(ours)  # of whatever extractor that map was made by
    with source.open_keypoints() as keypoints:
        files = [photo.path for photo in photos] if anew else None
        features = ModelFeatures(source.stored, keypoints, fingerprint, files)
        identity = _identity(folder, source, photos, options, document)
        kept = MapOptions(
            min_track_length=options.min_track_length, height_datum=said or options.height_datum
        )
        made = _built(source.stored.model, place, photos, features, identity, kept)
    if made is None:
        raise IngestError(f"{folder}: no point is placed well enough: the photos' rays are parallel")
    return made


def _built(
    model: Model,
    place: Place | NoPlace,
    photos: Sequence[Photo],
    features: Sequence[PhotoFeatures],
    identity: MapIdentity,
    options: MapOptions,
) -> AnyMap | None:
    """The map where it lies, or in a frame of its own; None if no point is placed well enough."""
    if isinstance(place, NoPlace):
        unplaced = build_unplaced_map(model, place, photos, features, identity, options)
        return None if unplaced is None else _described(unplaced)
    made = build_map(model, place.placement, place.frame, photos, features, identity, options)
    return None if made is None else _finished(_described(made), place)


def _described_anew(source: ModelSource, options: ModelOptions) -> bool:
    if not source.has_descriptors and options.descriptors == "stored":
        raise IngestError(
            f"--descriptors stored: {NAMES[source.format]} keeps none that can be compared with ours; leave "
            "it out"
        )
    anew = options.descriptors == "photos" or not source.has_descriptors
    if anew and options.photos is None and source.photos is None:
        asked = "--descriptors photos" if source.has_descriptors else f"{source.place}: no descriptors"
        raise IngestError(f"{asked}: expected --photos FOLDER to make them of, found none")
    return anew


def georeference_file(folder: Path, place: Path) -> Path | None:
    """The geo-reference's file in a folder, or where its model was found; None where there is none."""
    return next((p for p in (folder / GEOREFERENCE, place / GEOREFERENCE) if p.is_file()), None)


def read_georeference(folder: Path, place: Path) -> dict[str, Any] | None:
    """The geo-reference in a folder, or where its model was found; None where there is none.

    Raises:
        IngestError: it cannot be read.
    """
    path = georeference_file(folder, place)
    if path is None:
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise IngestError(
            f"{path}: expected JSON, found something else ({error}); export it again"
        ) from error
    if not isinstance(document, dict) or not isinstance(document.get("map"), dict):
        raise IngestError(f"{path}: expected a geo-reference as `featuredb export` writes it")
    images = document.get("images", [])
    if not isinstance(images, list) or not all(_names_photo(entry) for entry in images):
        raise IngestError(
            f"{path}: expected images with name, original_name and sha256; export the model again"
        )
    return document


def _names_photo(entry: Any) -> bool:
    names = ("name", "original_name", "sha256")
    return isinstance(entry, dict) and all(isinstance(entry.get(name), str) for name in names)


def place_of(
    source: ModelSource, document: dict[str, Any] | None, photos: Sequence[Photo], options: ModelOptions
) -> Place | NoPlace:
    """What a person states counts before the file, the file before the photos' GPS.

    Raises:
        IngestError: an accuracy of a place that nothing gives; and what the ways to place a model raise.
    """
    model = source.stored.model
    if options.stated is not None:
        return place_as_stated(model, options.stated)
    if options.sigma_m is not None:
        if source.reference is None:
            raise IngestError(
                "expected --epsg, --origin and --sigma together, found no --epsg and no --origin, and no "
                "reference in the model's files"
            )
        return place_at_reference(model, source.reference, options.sigma_m)
    if document is not None:
        return place_of_georeference(document)
    return place_by_photos(model, photos)


def photos_of_model(
    source: ModelSource, document: Mapping[str, Any] | None, options: ModelOptions, *, anew: bool
) -> list[Photo]:
    """What is known of each of the model's photos, in its order.

    Args:
        anew: their files are needed.

    Raises:
        IngestError: a photo of which nothing is known: it is neither in georeference.json nor in the folder;
            or one whose file is needed and is not there.
    """
    told = {entry["name"]: entry for entry in (document or {}).get("images", [])}
    keys = (document or {}).get("map", {}).get("camera_keys", [])
    folder = options.photos or source.photos
    found: dict[str, Photo] = {}
    if folder is not None:
        if not folder.is_dir():
            raise IngestError(f"--photos {folder}: expected the folder of the photos, found none")
        scan = ScanOptions(owner=options.owner, licence=options.licence)
        found = {photo.name: photo for photo in scan_folder(folder, scan).photos if photo.sha256}
    by_hash = {photo.sha256: photo for photo in found.values()}
    photos = []
    stored = source.stored
    for row, (name, camera) in enumerate(zip(stored.names, stored.model.camera_of, strict=True)):
        if name in told and not (anew and told[name]["sha256"] not in by_hash):
            entry = told[name]
            photo = _told(entry, options, by_hash.get(entry["sha256"]))
            key = stored.camera_ids[int(camera)] - 1
            photos.append(replace(photo, camera_key=keys[key] if 0 <= key < len(keys) else ""))
        elif name in told:
            raise IngestError(
                f"{name}: expected this photo to make descriptors of, with the hash "
                f"{told[name]['sha256'][:16]}... that {GEOREFERENCE} has, found none in {folder}; give "
                "--photos FOLDER with the originals"
            )
        elif name in found:
            photo = found[name]
            if photo.gps is None and source.gps:
                photo = replace(photo, gps=source.gps[row])
            photos.append(photo)
        else:
            raise IngestError(
                f"{name}: expected this photo of the model in --photos FOLDER under that name, found "
                f"{'no such folder given' if folder is None else 'none'}; a map names its photos by "
                "their bytes, and their licence"
            )
    return photos


def _told(entry: Mapping[str, Any], options: ModelOptions, file: Photo | None) -> Photo:
    try:
        time, gps = entry.get("capture_time"), entry.get("gps")
        capture_time = None if time is None else datetime.fromisoformat(time)
        prior = None if gps is None else GeoPrior(**gps)
    except (TypeError, ValueError) as error:
        raise IngestError(f"{GEOREFERENCE}: {entry['name']}: broken time or position: {error}") from error
    return Photo(
        name=entry["original_name"],
        path=Path() if file is None else file.path,
        sha256=entry["sha256"],
        capture_time=capture_time,
        gps=prior,
        owner=entry.get("owner") or options.owner,
        licence=entry.get("licence") or options.licence,
    )


def _identity(
    folder: Path,
    source: ModelSource,
    photos: Sequence[Photo],
    options: ModelOptions,
    document: Mapping[str, Any] | None,
) -> MapIdentity:
    """The same files and options are the same map."""
    document_file = georeference_file(folder, source.place)
    files = [*source.files, *([] if document_file is None else [document_file]), *source.feature_files]
    texts = [f"{path.name} {file_sha256(path)}" for path in files]
    texts.append(repr(replace(options, photos=None, colmap_database=None)))  # not where its photos lie
    if not source.has_descriptors:  # they are the photos'
        texts += [photo.sha256 for photo in photos]
    if options.sigma_m is not None:
        texts.append(f"sigma {options.sigma_m}")
    texts += [source.choice] if source.choice else []
    was = (document or {}).get("map", {})
    descriptors = options.descriptors or ("stored" if source.has_descriptors else "photos")
    imported = {"format": source.format, "descriptors": descriptors}
    if was:
        imported |= {"map_id": was["id"], "source": was.get("source", "")}
    return MapIdentity(
        map_id=f"{digest(*texts)[:24]}-m",
        name=options.name or was.get("name") or folder.absolute().name,
        source=f"{NAMES[source.format]} model",
        licence=options.licence or was.get("licence", ""),
        provenance={"imported": imported},
    )


def _described(made: MapKind) -> MapKind:
    """Zeros are no descriptors."""
    seen = made.observations
    described = seen.has_descriptor & seen.descriptors.any(axis=1)
    if not described.any():
        raise IngestError("none of the model's keypoints has a descriptor: the map could not answer anything")
    observations = replace(
        seen,
        has_descriptor=described,
        descriptors=np.where(described[:, None], seen.descriptors, np.uint8(0)),
    )
    return replace(made, observations=observations)


def _finished(made: FeatureMap, place: Place) -> FeatureMap:
    """The zone and the status are those of the place."""
    points = made.points
    if made.epsg != place.epsg:
        points = replace(points, utm=made.frame.utm_from_enu(made.points_local(), place.epsg))
    return replace(made, epsg=place.epsg, status=place.status, points=points)
