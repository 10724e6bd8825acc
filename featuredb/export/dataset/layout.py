"""Names in a dataset's folder, and the document that says what it is."""

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from featuredb.errors import ExportError

FORMAT, FORMAT_VERSION = "featuredb-dataset", 1

DESCRIPTION = "dataset.json"
MAPS = "maps.parquet"
CAMERAS = "cameras.parquet"
POINTS, IMAGES, OBSERVATIONS = "points", "images", "observations"
DATASHEET = "README.md"
STAC = "stac"
LIDAR = "lidar"

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_LONGEST_NAME = 80


@dataclass(frozen=True, slots=True, order=True)
class Partition:
    """What one file's coordinates have in common, since a GeoParquet column has one CRS."""

    epsg: int
    height_datum: str

    def file(self, table: str, number: int) -> str:
        """Path in the folder of the n-th file, from 0, of a table's rows in this partition."""
        return f"{table}/{self.epsg}-{self.height_datum}-{number:04d}.parquet"


def file_name(name: str) -> str:
    """A file name, without ending, for the id of a map or scan: itself where it can be one.

    Other ids, and those with capitals, get a piece of their hash, so that two never share a name, on no file
    system, and none leads out of its folder.
    """
    safe = _UNSAFE.sub("_", name)[:_LONGEST_NAME]
    return (
        safe if name and safe.lower() == name else f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    )


def read_description(folder: Path) -> dict[str, Any]:
    """The folder's `dataset.json`.

    Raises:
        ExportError: it is none of ours, or of a version that this program does not know.
    """
    path = folder / DESCRIPTION
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ExportError(
            f"{path}: expected the description of a dataset, cannot read one ({error})"
        ) from error
    found = document.get("format") if isinstance(document, dict) else None
    if found != FORMAT:
        raise ExportError(f"{path}: expected the format {FORMAT!r}, found {found!r}")
    if document.get("format_version") != FORMAT_VERSION:
        raise ExportError(
            f"{path}: expected version {FORMAT_VERSION} of the format, found "
            f"{document.get('format_version')!r}; use the featuredb that wrote it, or a newer one"
        )
    return dict(document)
