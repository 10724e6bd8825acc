"""The photos of maps on disk. A map keeps their names and SHA-256, not their pixels."""

import threading
from pathlib import Path, PurePosixPath

from featuredb.atomic import file_sha256
from featuredb.maps.feature_map import MapImage

_SUFFIXES = (".jpg", ".jpeg", ".heic", ".heif", ".avif", ".png", ".tif", ".tiff")


class PhotoFolder:
    """A folder in which photos are looked for; threads may share it.

    A file counts only if its SHA-256 is the map's: another photo of the same name would be taken for the one
    that the map knows. What is not found by name is found by content, anywhere below the folder; all pictures
    in it are read for that, once.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._by_digest: dict[str, Path] | None = None
        self._digests: dict[tuple[Path, int, int], str] = {}

    def find(self, image: MapImage) -> tuple[Path | None, str]:
        """The file of a photo, or None and why, in words."""
        path, reason = self.by_name(image)
        if path is None:
            path = self.by_content(image)
        return path, "" if path is not None else reason

    def by_name(self, image: MapImage) -> tuple[Path | None, str]:
        """The file of the photo's name, if it has the photo's bytes; else None and why."""
        name = PurePosixPath(image.name)
        if name.is_absolute() or ".." in name.parts:
            return None, "its name leads out of the folder"
        path = self.folder / name
        if not path.is_file():
            return None, "there is no such file"
        try:
            if self._digest(path) != image.sha256:
                return None, "the file of that name has other bytes (SHA-256) than the map's photo"
        except OSError as error:
            return None, f"the file cannot be read: {error.strerror or error}"
        return path, ""

    def by_content(self, image: MapImage) -> Path | None:
        """A file with the photo's bytes, whatever its name; files that cannot be read are left out."""
        with self._lock:
            if self._by_digest is None:
                self._by_digest = {}
                for path in sorted(self.folder.rglob("*")):
                    if path.suffix.lower() in _SUFFIXES and path.is_file():
                        try:
                            self._by_digest.setdefault(self._digest(path), path)
                        except OSError:
                            continue
            return self._by_digest.get(image.sha256)

    def _digest(self, path: Path) -> str:
        """As `file_sha256`; a file that has not changed is read once."""
        info = path.stat()
        key = path, info.st_mtime_ns, info.st_size
        if key not in self._digests:
            self._digests[key] = file_sha256(path)
        return self._digests[key]
