"""Photos that no map shows, and in which maps they were looked for: nothing is looked for twice.

Contributions wait for weeks, and a photo that is found nowhere costs more than one that is. It is looked for
in maps that have come since; only where it is found there, in all of them together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.place.localised import QUERY
from ingest.growth.values import FeaturesOf
from ingest.photos.photo import Photo
from ingest.workspace import read_json, write_json

# Raised when localisation finds what it did not find before.
_VERSION = "1"


@dataclass(frozen=True, slots=True, kw_only=True)
class NotFound:
    """Write ids of the maps where a photo was looked for in vain (one that was moved is another), and why."""

    maps: frozenset[str]
    reason: str


class NotFoundRows:
    """Photos of a run by row, as `known`; what is noted here, the next run knows."""

    def __init__(self, photos: Sequence[Photo], features_of: FeaturesOf, work: Path) -> None:
        self._photos, self._folder = photos, work / "not_found"
        self._asked = options_fingerprint(QUERY)
        # All photos of a run have one extractor.
        self._extractor = features_of(0).features.fingerprint if photos else ""
        self.known: dict[int, NotFound] = {}
        for row in range(len(photos)):
            file = self._file(row)
            if file.is_file():
                value = read_json(file)
                self.known[row] = NotFound(maps=frozenset(value["maps"]), reason=value["reason"])

    def note(self, row: int, found: NotFound) -> None:
        """Keep it for this run and the next."""
        if self.known.get(row) != found:
            self.known[row] = found
            write_json(self._file(row), {"maps": sorted(found.maps), "reason": found.reason})

    def _file(self, row: int) -> Path:
        photo = self._photos[row]
        told = repr((photo.gps, photo.focal_px, photo.camera_key))
        key = digest(_VERSION, photo.sha256, told, self._extractor, self._asked)
        return self._folder / f"{key[:24]}.json"
