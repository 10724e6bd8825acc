"""What a scan found out about each file, kept so that the next scan need not read it again."""

import dataclasses
import json
import logging
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from featuredb.features.exif.read import ExifInfo
from featuredb.geometry.camera_angles import CameraAngles
from ingest.workspace import write_json

_log = logging.getLogger(__name__)
_TIMES = ("capture_time", "gps_time")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExaminedFile:
    """One file after reading it.

    Attributes:
        size, mtime_ns: of the file that was read; another pair means another file.
        sha256: of its bytes, "" where they were not read.
        reason_code, reason: why it is not a usable photo, "" where it is one.
        picture_hash: see ingest.photos.duplicates.
        exif: metadata; None where it is not a usable photo.
    """

    size: int
    mtime_ns: int
    sha256: str = ""
    reason_code: str = ""
    reason: str = ""
    picture_hash: str = ""
    exif: ExifInfo | None = None


def write_cache(path: Path, key: str, examined: dict[str, ExaminedFile]) -> None:
    """Write atomically.

    Args:
        path: of the cache.
        key: of the options that matter to it.
        examined: by name within the folder.
    """
    files = {name: dataclasses.asdict(e) for name, e in examined.items()}
    for record in files.values():
        for field in _TIMES if record["exif"] else ():
            time = record["exif"][field]
            record["exif"][field] = time.isoformat() if time else None
    write_json(path, {"key": key, "files": files})


def read_cache(path: Path, key: str) -> dict[str, ExaminedFile]:
    """What `write_cache` wrote under the same key; empty where there is none or it cannot be used."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["key"] != key:
            return {}
        return {name: _from_json(record) for name, record in content["files"].items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        _log.warning("%s: scan cache not used, every file is read again: %r", path, error)
        return {}


def _from_json(record: dict[str, Any]) -> ExaminedFile:
    exif = record.pop("exif")
    if exif is None:
        return ExaminedFile(**record)
    for field in _TIMES:
        exif[field] = datetime.fromisoformat(exif[field]) if exif[field] else None
    exif["warnings"] = tuple(exif["warnings"])
    exif["angles"] = CameraAngles(**exif["angles"]) if exif["angles"] else None
    return ExaminedFile(**record, exif=ExifInfo(**exif))
