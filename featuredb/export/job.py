"""What every format is given and gives back, the photos it names, and an output that is whole or absent."""

import csv
import hashlib
import json
import shutil
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast
from urllib.parse import quote

from featuredb.errors import ExportError
from featuredb.export.selection import Selection, exported, licence_of, selected_any, selected_maps
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store.database import Database
from featuredb.store.snapshot import MapSummary, Snapshot, UnplacedSummary

ATTRIBUTION = "attribution.csv"  # goes with every export, as licences ask
_LONGEST_NAME, _LONGEST_SUFFIX = 200, 12  # file systems take 255 bytes, and others add to a name
_Kind = TypeVar("_Kind", FeatureMap, AnyMap)
Told = Callable[[int, int], None]
"""Called with the number of maps written and their total."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportJob:
    """An export that is asked for.

    Attributes:
        out: the file or folder to be made, in a folder that exists.
        counts: maps, images, points and observations of the maps that it has given.
    """

    database: Database
    snapshot: Snapshot
    selection: Selection
    out: Path
    told: Told = field(default=lambda done, total: None)
    counts: Counter[str] = field(default_factory=Counter, init=False)

    def summaries(self) -> list[MapSummary]:
        """Of the selected maps, before licences; see `selected_maps`."""
        return selected_maps(self.database, self.snapshot, self.selection)

    def any_summaries(self) -> list[MapSummary | UnplacedSummary]:
        """The same for a format that keeps maps without a place, too; see `selected_any`."""
        return selected_any(self.database, self.snapshot, self.selection)

    def maps(self) -> Iterator[FeatureMap]:
        """One in memory at a time, oldest first, telling progress; see `exported`."""
        return cast("Iterator[FeatureMap]", self._telling(self.summaries()))

    def any_maps(self) -> Iterator[AnyMap]:
        """The same for a format that keeps maps without a place, too."""
        return self._telling(self.any_summaries())

    def _telling(self, summaries: Sequence[MapSummary | UnplacedSummary]) -> Iterator[AnyMap]:
        self.counts.clear()
        for feature_map in exported(self.snapshot, summaries, self.selection.licences):
            self.counts["maps"] += 1
            for name in ("images", "points", "observations"):
                self.counts[name] += len(getattr(feature_map, name))
            yield feature_map
            del feature_map  # or it would stay while the next one is loaded
            self.told(self.counts["maps"], len(summaries))

    def exported(self, path: Path) -> "Exported":
        """What was written to `path` of the maps that it has given."""
        names = ("maps", "images", "points", "observations")
        return Exported(**{name: self.counts[name] for name in names}, bytes=size_of(path))


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What was written: numbers of maps, images, points and observations, and bytes of all files."""

    maps: int
    images: int
    points: int
    observations: int
    bytes: int


@contextmanager
def whole_or_nothing(out: Path) -> Iterator[Path]:
    """A path beside `out` to write a file or a folder to; it becomes `out` when the block ends well.

    After an error, or a kill, nothing is at `out`; what a kill leaves is named `.OUT.part-…`.

    Raises:
        ExportError: there is something at `out`, or its folder is missing.
    """
    out = out.absolute()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ExportError(f"{out}: expected a name that is free, or an empty folder; nothing is overwritten")
    if not out.parent.is_dir():
        raise ExportError(f"{out}: expected a folder {out.parent} to write it to, found none; make it first")
    part = out.with_name(f".{out.name}.part-{uuid.uuid4().hex[:8]}")
    try:
        yield part
        if out.is_dir():
            out.rmdir()
        part.rename(out)
    finally:
        if part.is_dir():
            shutil.rmtree(part)
        else:
            part.unlink(missing_ok=True)


def folder_name(map_id: str) -> str:
    """A map's id as the name of a folder or file: what file systems may not like is percent-encoded.

    What would be too long for them is cut, with a digest of all of it.
    """
    name = quote(map_id, safe=" +@,=")
    if len(name) > _LONGEST_NAME:
        suffix = Path(name).suffix[:_LONGEST_SUFFIX]
        digest = hashlib.sha256(map_id.encode()).hexdigest()[:16]
        name = f"{name[: _LONGEST_NAME - len(suffix) - len(digest) - 1]}~{digest}{suffix}"
    return name.replace(".", "%2E", 1) if name.startswith(".") else name


def folder_for_each(job: ExportJob, maps: Iterable[_Kind], write: Callable[[Path, _Kind], None]) -> Exported:
    """Make `job.out` with a folder for every map, which `write` makes and fills, and its photos' owners.

    Raises:
        ExportError: there is something at `job.out`; and what `write` raises.
    """
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        for feature_map in maps:
            folder = part / folder_name(feature_map.map_id)
            write(folder, feature_map)
            write_attribution(folder, attribution_of(feature_map))
            del feature_map  # or it would stay while the next one is loaded
        return job.exported(part)


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files below a folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a document for people and programs, in a folder that is made: indented, no NaN."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table with a header: UTF-8, commas, quotes where they are needed."""
    with path.open("w", encoding="utf-8", newline="") as out:
        csv.writer(out, lineterminator="\n").writerows([columns, *rows])


class Attribution(NamedTuple):
    """One photo: who made it, under which licence it was given ("" where nobody has said)."""

    map_id: str
    image: str
    sha256: str
    owner: str
    licence: str
    capture_time: str
    source: str


def attribution_of(feature_map: AnyMap) -> list[Attribution]:
    """A row for every photo of the map, in the map's order."""
    return [
        Attribution(
            map_id=feature_map.map_id,
            image=image.name,
            sha256=image.sha256,
            owner=image.owner,
            licence=licence_of(image, feature_map),
            capture_time="" if image.capture_time is None else image.capture_time.isoformat(),
            source=feature_map.source,
        )
        for image in feature_map.images
    ]


def write_attribution(folder: Path, rows: Iterable[Attribution]) -> None:
    """The table of the photos in a folder."""
    write_csv(folder / ATTRIBUTION, Attribution._fields, rows)
