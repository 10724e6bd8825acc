"""A COLMAP model with its place on Earth becomes a map of a database."""

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from featuredb.errors import IngestError
from featuredb.export.colmap import DATABASE
from featuredb.export.georeference import GEOREFERENCE
from featuredb.features.extractor import ExtractorOptions
from featuredb.file_digest import file_sha256
from featuredb.geo.datum import check_datum
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from ingest.extract import PhotoFeatures
from ingest.fingerprint import digest
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.models_in.anew import DescribedAnew
from ingest.models_in.colmap_database import open_features
from ingest.models_in.colmap_folder import ColmapModel, model_folder, read_colmap
from ingest.models_in.place import Place, Stated, place_as_stated, place_by_photos, place_of_georeference
from ingest.photo import Photo
from ingest.scan import ScanOptions, scan_folder

Descriptors = Literal["stored", "photos"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelOptions:
    """How a model is imported.

    Attributes:
        photos: folder of the photos under the names that the model has; needed where no georeference.json
            names them.
        stated: where the model lies, if a person says so.
        colmap_database: None: database.db in the model's folder.
        descriptors: from COLMAP's database (also where None), or made anew of the photos at the same
            keypoints.
        height_datum: of the heights where no georeference.json says it.
        min_track_length: points seen by at least that many photos carry descriptors.
        name, owner, licence: of the map and of photos that do not name their own.
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


def map_of_model(folder: Path, options: ModelOptions) -> FeatureMap:
    """The map of the COLMAP model in a folder.

    Raises:
        IngestError: the model cannot be read, placed or described; what is missing.
    """
    check_datum(options.height_datum)
    if options.descriptors == "photos" and options.photos is None:
        raise IngestError("--descriptors photos: expected --photos FOLDER to make them of, found none")
    colmap = read_colmap(folder)
    document = read_georeference(folder)
    photos = photos_of_model(colmap, document, options)
    place = place_of(colmap, document, photos, options)
    if place.height_datum is not None and options.height_datum not in ("unknown", place.height_datum):
        raise IngestError(
            f"--height-datum {options.height_datum}: {GEOREFERENCE} says that heights are "
            f"{place.height_datum}"
        )
    database = options.colmap_database or folder / DATABASE
    fingerprint = ExtractorOptions().fingerprint
    ours = document is not None and document["map"].get("extractor_fingerprint")
    if ours and options.descriptors != "photos":
        fingerprint = str(ours)  # of whatever extractor that map was made by
    with ExitStack() as stack:
        stored = stack.enter_context(open_features(database, colmap, fingerprint))
        features: Sequence[PhotoFeatures] = stored
        if options.descriptors == "photos":
            features = DescribedAnew(stored, [photo.path for photo in photos])
        made = build_map(
            colmap.model,
            place.placement,
            place.frame,
            photos,
            features,
            _identity(folder, database, options, document),
            MapOptions(
                min_track_length=options.min_track_length,
                height_datum=place.height_datum or options.height_datum,
            ),
        )
    if made is None:
        raise IngestError(f"{folder}: no point is placed well enough: the photos' rays are parallel")
    return _finished(made, place)


def read_georeference(folder: Path) -> dict[str, Any] | None:
    """The geo-reference beside the model, or None where there is none.

    Raises:
        IngestError: it cannot be read.
    """
    path = next(
        (p for p in (folder / GEOREFERENCE, model_folder(folder) / GEOREFERENCE) if p.is_file()), None
    )
    if path is None:
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise IngestError(f"{path}: expected JSON, found something else ({error})") from error
    if not isinstance(document, dict) or not isinstance(document.get("map"), dict):
        raise IngestError(f"{path}: expected a geo-reference as `featuredb export` writes it")
    return document


def place_of(
    colmap: ColmapModel, document: dict[str, Any] | None, photos: Sequence[Photo], options: ModelOptions
) -> Place:
    """What a person states counts before the file, the file before the photos' GPS."""
    if options.stated is not None:
        return place_as_stated(colmap.model, options.stated)
    if document is not None:
        return place_of_georeference(document)
    return place_by_photos(colmap.model, photos)


def photos_of_model(
    colmap: ColmapModel, document: Mapping[str, Any] | None, options: ModelOptions
) -> list[Photo]:
    """What is known of each of the model's photos, in its order.

    Raises:
        IngestError: a photo of which nothing is known: it is neither in georeference.json nor in the folder.
    """
    told = {entry["name"]: entry for entry in (document or {}).get("images", [])}
    keys = (document or {}).get("map", {}).get("camera_keys", [])
    found: dict[str, Photo] = {}
    if options.photos is not None:
        if not options.photos.is_dir():
            raise IngestError(f"--photos {options.photos}: expected the folder of the photos, found none")
        scan = ScanOptions(owner=options.owner, licence=options.licence)
        found = {photo.name: photo for photo in scan_folder(options.photos, scan).photos if photo.sha256}
    by_hash = {photo.sha256: photo for photo in found.values()}
    photos = []
    for name, camera in zip(colmap.names, colmap.model.camera_of, strict=True):
        if name in told:
            entry = told[name]
            photo = _told(entry, options, by_hash.get(entry["sha256"]))
            key = colmap.camera_ids[int(camera)] - 1
            photos.append(replace(photo, camera_key=keys[key] if 0 <= key < len(keys) else ""))
        elif name in found:
            photos.append(found[name])
        else:
            raise IngestError(
                f"{name}: expected this photo of the model in --photos FOLDER under that name, found "
                f"{'no such folder given' if options.photos is None else 'none'}; a map names its photos by "
                "their bytes, and their licence"
            )
    return photos


def _told(entry: Mapping[str, Any], options: ModelOptions, file: Photo | None) -> Photo:
    time, gps = entry.get("capture_time"), entry.get("gps")
    return Photo(
        name=entry["original_name"],
        path=Path() if file is None else file.path,
        sha256=entry["sha256"],
        capture_time=None if time is None else datetime.fromisoformat(time),
        gps=None if gps is None else GeoPrior(**gps),
        owner=entry.get("owner") or options.owner,
        licence=entry.get("licence") or options.licence,
    )


def _identity(
    folder: Path, database: Path, options: ModelOptions, document: Mapping[str, Any] | None
) -> MapIdentity:
    """The same files and options are the same map."""
    files = sorted(model_folder(folder).glob("*.bin")) + sorted(model_folder(folder).glob("*.txt"))
    files += [path for path in (folder / GEOREFERENCE, database) if path.is_file()]
    key = digest(*(f"{path.name} {file_sha256(path)}" for path in files), _plain(options))
    was = (document or {}).get("map", {})
    imported = {"format": "colmap", "descriptors": options.descriptors or "stored"}
    if was:
        imported |= {"map_id": was["id"], "source": was.get("source", "")}
    return MapIdentity(
        map_id=f"{key[:24]}-m",
        name=options.name or was.get("name") or folder.absolute().name,
        source="COLMAP model",
        licence=options.licence or was.get("licence", ""),
        provenance={"imported": imported},
    )


def _finished(made: FeatureMap, place: Place) -> FeatureMap:
    """Zeros are no descriptors; the zone and the status are those of the place."""
    seen = made.observations
    described = seen.has_descriptor & seen.descriptors.any(axis=1)
    if not described.any():
        raise IngestError("none of the model's keypoints has a descriptor: the map could not answer anything")
    points = made.points
    if made.epsg != place.epsg:
        points = replace(points, utm=made.frame.utm_from_enu(made.points_local(), place.epsg))
    return replace(
        made,
        epsg=place.epsg,
        status=place.status,
        points=points,
        observations=replace(
            seen,
            has_descriptor=described,
            descriptors=np.where(described[:, None], seen.descriptors, np.uint8(0)),
        ),
    )


def _plain(options: ModelOptions) -> str:
    """The options that the map depends on; not where its photos lie."""
    return repr(replace(options, photos=None, colmap_database=None))
