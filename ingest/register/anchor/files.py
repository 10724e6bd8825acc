"""Files of an anchoring: the photos of a map, and what was proposed for a person to confirm."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError, RegistrationError
from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import MapImage
from featuredb.maps.photo_files import PhotoFolder
from featuredb.maps.unplaced_map import AnyMap
from featuredb.plain_json import plain
from ingest.register.frame_registration import FrameRegistration
from ingest.workspace import read_json, write_json

PROPOSALS = "proposals.json"
_VERSION = 2

State = tuple[str, str, str]
"""Ids of a map, of its state (another one has other poses), and of the scan with where its frame begins."""


def save_proposals(folder: Path, state: State, registrations: Mapping[int, FrameRegistration]) -> None:
    """Write folder/proposals.json, atomically: accepted registrations by image id."""
    names = dict(zip(("map_id", "write_id", "scan_id"), state, strict=True))
    frames = {i: asdict(r) for i, r in registrations.items() if r.accepted}
    write_json(folder / PROPOSALS, plain({"version": _VERSION, **names, "frames": frames}))


def load_proposals(folder: Path, state: State) -> Mapping[int, FrameRegistration]:
    """Read them back for the same map, in the same state, and the same scan.

    Raises:
        RegistrationError: there are none, or they belong to something else.
    """
    path = folder / PROPOSALS
    if not path.is_file():
        raise RegistrationError(
            f"{path}: nothing has been proposed there; run the command without --confirm first, with "
            "the same --out"
        )
    try:
        document = read_json(path)
        if document["version"] != _VERSION:
            raise RegistrationError(
                f"{path}: expected version {_VERSION}, found {document['version']}; propose anew"
            )
        found = (document["map_id"], document["write_id"], document["scan_id"])
        frames = {int(i): _registration(entry) for i, entry in document["frames"].items()}
    except (IngestError, KeyError, TypeError, ValueError) as error:
        raise RegistrationError(f"{path}: cannot be read as proposals ({error!r}); propose anew") from error
    if found != state:
        raise RegistrationError(
            f"{path}: proposed for map {found[0]}, state {found[1]}, scan {found[2]}; the map is now in "
            f"state {state[1]} with scan {state[2]}; run the command without --confirm again, or confirm by "
            "the very words that were printed"
        )
    return frames


def _registration(entry: dict[str, Any]) -> FrameRegistration:
    camera = entry["camera"]
    parts = {
        "cam_from_local": Rigid3(**entry["cam_from_local"]),
        "camera": camera and Camera(**camera | {"params": tuple(camera["params"])}),
        "points_local": np.array(entry["points_local"]).reshape(-1, 3),
        "pixels": np.array(entry["pixels"]).reshape(-1, 2),
    }
    return FrameRegistration(**entry | parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFiles:
    """Files of the photos of a map that were found in a folder, by image id, and why others are missing."""

    folder: Path
    paths: dict[int, Path]
    missing: dict[int, str]

    def path(self, image: MapImage) -> Path:
        """The file of one image.

        Raises:
            RegistrationError: it was not found.
        """
        if image.image_id not in self.paths:
            raise RegistrationError(
                f"photo {image.name}: {self.missing.get(image.image_id, 'not searched for')}; "
                f"--photos must name the folder that the map was made of, searched: {self.folder}"
            )
        return self.paths[image.image_id]

    def gray(self, image: MapImage) -> NDArray[np.uint8]:
        """Grey pixels (h, w) of one image.

        Raises:
            RegistrationError: it was not found.
            ImageError: it cannot be read.
        """
        return decode_gray(self.path(image), INGEST_LIMITS)


def find_photos(feature_map: AnyMap, folder: Path) -> PhotoFiles:
    """Find the photos of a map by name, and where that fails by content, anywhere under the folder.

    A file counts only if its SHA-256 is the map's: another photo of the same name would be registered to the
    scan in place of the one that the map knows.

    Raises:
        RegistrationError: no such folder, or none of the photos is there.
    """
    if not folder.is_dir():
        raise RegistrationError(
            f"--photos: expected the folder of the map's photos, found no folder {folder}"
        )
    search = PhotoFolder(folder)
    found = {image.image_id: search.find(image) for image in feature_map.images}
    paths = {image_id: path for image_id, (path, _) in found.items() if path is not None}
    missing = {image_id: reason for image_id, (path, reason) in found.items() if path is None}
    if not paths:
        reasons = sorted(set(missing.values()))
        raise RegistrationError(
            f"none of the {len(feature_map.images)} photos of map {feature_map.map_id} "
            f"(such as {feature_map.images[0].name if feature_map.images else 'none'}) is in {folder}: "
            f"{'; '.join(reasons) or 'the map has no photos'}; name the folder that the map was made of"
        )
    return PhotoFiles(folder=folder, paths=paths, missing=missing)
