"""The map of the nine hill photos by their GPS, made once in a run of the tests."""

import shutil
from pathlib import Path

import pytest

from featuredb.features.extractor import ExtractorOptions
from featuredb.store import Database
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions
from tests.support.hill_photos import write_hill_photos
from tests.support.made_once import made_once

MAKING = MapMakingOptions(extractor=ExtractorOptions(max_features=1000))


def hill_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with `photos` and the database `db`; nobody may write to it."""
    return made_once("hill-map", _make, tmp_path_factory)


def hill_work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A work folder of its own with all that was done for this map."""
    folder = tmp_path_factory.mktemp("hills") / "work"
    return Path(shutil.copytree(hill_map(tmp_path_factory) / "db" / "_work", folder))


def _make(folder: Path) -> None:
    write_hill_photos(folder / "photos")
    report = ingest_photos(
        Database.create(folder / "db"), folder / "photos", IngestOptions(workers=1, making=MAKING)
    )
    assert [m.status for m in report.maps] == ["committed"]
