"""The photos of a map on disk. A map keeps their names and SHA-256, not their pixels."""

from dataclasses import dataclass
from pathlib import Path

from featuredb.errors import RegistrationError
from featuredb.file_digest import file_sha256
from featuredb.maps.feature_map import FeatureMap, MapImage

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFiles:
    """Where the photos of a map lie.

    Attributes:
        folder: that was searched.
        paths: file of each image that was found, by image id.
        missing: image id and why, in words, of the others.
    """

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


def find_photos(feature_map: FeatureMap, folder: Path) -> PhotoFiles:
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
    paths: dict[int, Path] = {}
    missing: dict[int, str] = {}
    for image in feature_map.images:
        path = folder / image.name
        if not path.is_file():
            missing[image.image_id] = "there is no such file"
        elif sha256_of(path) != image.sha256:
            missing[image.image_id] = "the file of that name has other bytes (SHA-256) than the map's photo"
        else:
            paths[image.image_id] = path
    if missing:
        _find_by_content(feature_map, folder, paths, missing)
    if not paths:
        reasons = sorted(set(missing.values()))
        raise RegistrationError(
            f"none of the {len(feature_map.images)} photos of map {feature_map.map_id} "
            f"(such as {feature_map.images[0].name if feature_map.images else 'none'}) is in {folder}: "
            f"{'; '.join(reasons) or 'the map has no photos'}; name the folder that the map was made of"
        )
    return PhotoFiles(folder=folder, paths=paths, missing=missing)


def _find_by_content(
    feature_map: FeatureMap, folder: Path, paths: dict[int, Path], missing: dict[int, str]
) -> None:
    """Look for renamed or moved photos; what is found goes from `missing` to `paths`."""
    taken = set(paths.values())
    candidates = [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in _SUFFIXES and path.is_file() and path not in taken
    ]
    by_digest = {sha256_of(path): path for path in candidates}
    for image in feature_map.images:
        if image.image_id in missing and image.sha256 in by_digest:
            paths[image.image_id] = by_digest[image.sha256]
            del missing[image.image_id]


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes.

    Raises:
        RegistrationError: it cannot be read.
    """
    try:
        return file_sha256(path)
    except OSError as error:
        raise RegistrationError(f"photo {path} cannot be read: {error.strerror or error}") from error
