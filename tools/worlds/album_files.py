"""Files of an album: the table that a photo site gives, and the facts that only the simulation knows."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from featuredb.errors import InvalidValueError

FACTS_FILE = "facts.jsonl"
TABLE_FILE = "table.jsonl"

GeotagState = Literal["near", "far", "none"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Geotag:
    """A position as claimed.

    Attributes:
        latitude_deg, longitude_deg: WGS84. height_m: above the ellipsoid, or None.
        accuracy_m: what the site or the phone says of it, or None.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    accuracy_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AlbumFact:
    """What a photo really is; nobody but the evaluation reads it.

    Attributes:
        name: path within the album. photo_id: the site's number.
        kind: survey, street, drone, other_town, copy, indoor, portrait, ...; the worlds' modules list theirs.
        owner, licence, title: as in the table.
        time: of capture as claimed, timezone-aware.
        home: it shows the town whose frame the truth is in, so that it has a true pose.
        copy_of: the original, "" where this is one.
        geotag: near (within the error of the world), far (wrong on purpose or by mistake), or none.
        visit: photos of one visit by one person share it; -1 for those of none.
        batch: when it arrives, for worlds that arrive in steps.
        place: name of the sight or place, for people.
    """

    name: str
    photo_id: str
    kind: str
    owner: str
    licence: str
    title: str
    time: datetime
    home: bool = True
    copy_of: str = ""
    geotag: GeotagState = "near"
    visit: int = -1
    batch: int = 0
    place: str = ""


def write_facts(folder: Path, facts: Sequence[AlbumFact]) -> None:
    """Write folder/facts.jsonl, a line per photo, sorted by name."""
    lines = [
        json.dumps({**asdict(fact), "time": fact.time.isoformat()})
        for fact in sorted(facts, key=lambda f: f.name)
    ]
    (folder / FACTS_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_facts(folder: Path) -> dict[str, AlbumFact]:
    """Facts by name.

    Raises:
        InvalidValueError: no such file, or not one of an album.
    """
    path = Path(folder) / FACTS_FILE
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        facts = [AlbumFact(**{**row, "time": datetime.fromisoformat(row["time"])}) for row in rows]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InvalidValueError(
            f"{path}: expected the facts of a simulated album, found {error!r}"
        ) from error
    return {fact.name: fact for fact in facts}


def write_table(folder: Path, rows: Sequence[tuple[AlbumFact, Geotag | None]]) -> None:
    """Write table.jsonl, sorted by path; photos of a survey are not part of a photo site."""
    table = [
        _table_row(fact, tag) for fact, tag in sorted(rows, key=lambda r: r[0].name) if fact.kind != "survey"
    ]
    lines = "".join(json.dumps(row) + "\n" for row in table)
    (folder / TABLE_FILE).write_text(lines, encoding="utf-8")


def _table_row(fact: AlbumFact, tag: Geotag | None) -> dict[str, Any]:
    return {
        "path": fact.name,
        "id": fact.photo_id,
        "lat": None if tag is None else round(tag.latitude_deg, 7),
        "lon": None if tag is None else round(tag.longitude_deg, 7),
        "accuracy": None if tag is None else tag.accuracy_m,
        "time": fact.time.isoformat(),
        "owner": fact.owner,
        "licence": fact.licence,
        "title": fact.title,
    }
