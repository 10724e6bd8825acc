"""Whose photos an export is made of: a table that goes with every export, as licences ask."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import quote

from featuredb.export.selection import licence_of
from featuredb.maps.unplaced_map import AnyMap

ATTRIBUTION = "attribution.csv"
_COLUMNS = ("map_id", "image", "sha256", "owner", "licence", "capture_time", "source")


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribution:
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


def attribution_csv(rows: list[Attribution]) -> str:
    """The rows as CSV with a header: UTF-8, commas, quotes where they are needed."""
    out = io.StringIO()
    _writer(out).writerows(_values(row) for row in rows)
    return out.getvalue()


class AttributionFile:
    """The same, written map by map; use it in a `with` block."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = _writer(self._file)

    def add(self, feature_map: AnyMap) -> None:
        """The photos of a map."""
        self._writer.writerows(_values(row) for row in attribution_of(feature_map))

    def __enter__(self) -> "AttributionFile":
        return self

    def __exit__(self, *failed: object) -> None:
        self._file.close()


def _writer(out: TextIO) -> Any:
    """A CSV writer after the header."""
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    return writer


def _values(row: Attribution) -> list[str]:
    return [getattr(row, name) for name in _COLUMNS]


def folder_name(map_id: str) -> str:
    """A map's id as the name of a folder or file: what file systems may not like is percent-encoded."""
    name = quote(map_id, safe=" +@,=")
    return name.replace(".", "%2E", 1) if name.startswith(".") else name
