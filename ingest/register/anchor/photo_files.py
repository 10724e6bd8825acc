"""The photos of one map on disk, as registration needs them: all that there are, or the reason for none."""

from dataclasses import dataclass
from pathlib import Path

from featuredb.errors import RegistrationError
from featuredb.maps.feature_map import MapImage
from featuredb.maps.photo_files import PhotoFolder
from featuredb.maps.unplaced_map import AnyMap


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
    paths: dict[int, Path] = {}
    missing: dict[int, str] = {}
    for image in feature_map.images:
        path, reason = search.by_name(image)
        if path is None:
            missing[image.image_id] = reason
        else:
            paths[image.image_id] = path
    for image in feature_map.images:
        if image.image_id in missing and (path := search.by_content(image)) is not None:
            paths[image.image_id] = path
            del missing[image.image_id]
    if not paths:
        reasons = sorted(set(missing.values()))
        raise RegistrationError(
            f"none of the {len(feature_map.images)} photos of map {feature_map.map_id} "
            f"(such as {feature_map.images[0].name if feature_map.images else 'none'}) is in {folder}: "
            f"{'; '.join(reasons) or 'the map has no photos'}; name the folder that the map was made of"
        )
    return PhotoFiles(folder=folder, paths=paths, missing=missing)
