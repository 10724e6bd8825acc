"""Names in a dataset's folder, the document that says what it is, and the checksums of its files."""

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from featuredb.atomic import file_sha256
from featuredb.errors import ExportError

FORMAT, FORMAT_VERSION = "featuredb-dataset", 1

DESCRIPTION = "dataset.json"
MAPS = "maps.parquet"
CAMERAS = "cameras.parquet"
POINTS, IMAGES, OBSERVATIONS = "points", "images", "observations"
DATASHEET = "README.md"
SUMS = "SHA256SUMS"  # as `sha256sum -c SHA256SUMS` reads it
STAC = "stac"
LIDAR = "lidar"
OWN_FRAME = "own_frame"  # maps without a place: neither GeoParquet nor the catalogue has room for them

_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")
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


def own_path(table: str) -> str:
    """Where the rows of maps without a place are, as the store has them, in the dataset's folder."""
    return f"{OWN_FRAME}/{table}.parquet"


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


def write_sums(folder: Path) -> None:
    """List every file below the folder, by path, with its SHA-256."""
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    text = "".join(f"{file_sha256(folder / name)}  {name}\n" for name in files)
    (folder / SUMS).write_text(text, encoding="utf-8")


def check_sums(folder: Path) -> frozenset[str]:
    """The files that are listed, after every one has been compared. Files that are not listed do not matter.

    Raises:
        ExportError: not a folder with SHA256SUMS; a file that is missing or differs, by name.
    """
    try:
        text = (folder / SUMS).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ExportError(
            f"{folder}: expected a dataset's folder with {SUMS}, cannot read that ({error})"
        ) from error
    listed: set[str] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line)
        if match is None or not _inside(match[2]):
            raise ExportError(
                f"{folder / SUMS}, line {number}: expected a SHA-256 and a path, found {line!r:.120}"
            )
        digest, name = match.groups()
        path = folder / name
        if not path.is_file():
            raise ExportError(
                f"{path}: {SUMS} lists this file, and it is missing; copy the dataset once more"
            )
        if file_sha256(path) != digest:
            raise ExportError(
                f"{path}: the content is not what {SUMS} says; it was damaged or changed, copy it once more"
            )
        listed.add(name)
    return frozenset(listed)


def _inside(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts
