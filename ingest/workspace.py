"""The work folder of an ingest: where stages leave their results, so that a killed job goes on.

Every file is keyed by what it was made of (digests of the photos' bytes, fingerprints of the options),
written under a temporary name, flushed to the disk and then renamed: a file that is there is complete.
All jobs of a database share them: photos that come later reuse what the earlier ones left, up to whole
reconstructions of neighbourhoods in which nothing changed.
"""

import hashlib
import json
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import TEMPORARY, atomic_file, user_cache
from featuredb.errors import IngestError


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Folders below a root that all jobs of a database share."""

    root: Path

    def features(self, fingerprint: str, sha256: str) -> Path:
        """The features of one photo under the given extractor options."""
        return self.root / "features" / fingerprint / f"{sha256}.npz"

    def aggregated(self, vocabulary: str, fingerprint: str, sha256: str) -> Path:
        """The aggregated descriptor of one photo by a vocabulary."""
        return self.root / "aggregated" / vocabulary / fingerprint / sha256[:2] / f"{sha256}.npz"

    def models(self, key: str) -> Path:
        """Reconstructions of a set of photos, by a digest of all that they are made of."""
        return self.root / "models" / key[:2] / key

    def matches(self, fingerprint: str, sha256_a: str, sha256_b: str) -> Path:
        """The verified matches of one pair under the given options."""
        return self.root / "matches" / fingerprint / sha256_a[:2] / f"{sha256_a}_{sha256_b}.npz"


def default_root(database_url: str) -> Path:
    """Where a database's work folder lies unless the caller says otherwise.

    Inside a local database folder; for an object store in the user's cache folder, under a digest of
    the address.
    """
    if "://" in database_url and not database_url.startswith("file://"):
        return user_cache() / "work" / hashlib.sha256(database_url.encode()).hexdigest()[:16]
    return Path(database_url.removeprefix("file://")) / "_work"


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, sort_keys=True), encoding="utf-8")


def write_json_and_page(stem: Path, value: Mapping[str, Any], html: str) -> Path:
    """Write `stem`.json and `stem`.html, each atomically; the path of the page."""
    write_json(stem.with_name(f"{stem.name}.json"), value)
    page = stem.with_name(f"{stem.name}.html")
    with atomic_file(page) as temporary:
        temporary.write_text(html, encoding="utf-8")
    return page


def read_json(path: Path) -> dict[str, Any]:
    """Read what `write_json` wrote."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise IngestError(
            f"{path}: expected a stage's JSON record, {error}; delete it and run again"
        ) from error
    if not isinstance(value, dict):
        raise IngestError(
            f"{path}: expected a JSON object, found {type(value).__name__}; delete it, run again"
        )
    return value


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as an uncompressed npz file, atomically."""
    buffer = BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    with atomic_file(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read what `write_arrays` wrote."""
    with _archive(path) as archive:
        return {name: archive[name] for name in archive.files}


def read_array(path: Path, name: str) -> NDArray[Any]:
    """One array of an npz file that `write_arrays` wrote; the others are not read."""
    with _archive(path) as archive:
        return np.asarray(archive[name])


@contextmanager
def _archive(path: Path) -> Iterator[Any]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            yield archive
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise IngestError(f"{path}: expected a stage's npz file, {error}; delete it and run again") from error


def remove_leftovers(root: Path) -> None:
    """Delete temporary files of killed jobs under `root` that are older than a day."""
    now = time.time()
    for path in root.rglob(f"{TEMPORARY}*"):
        # A day: no stage of one photo or pair takes that long.
        if path.exists() and now - path.stat().st_mtime > 86_400.0:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
