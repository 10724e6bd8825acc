"""Real drone photos through a whole ingest; held-out photos are a row of the scoreboard."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.geo.utm import utm_from_geodetic
from featuredb.store import Database
from ingest.photos.scan import ScanOptions
from ingest.pipeline import IngestOptions, ingest_photos
from tools.real_photos import Ingest, ingest

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

# Eight photos of two flight lines stay.
_HELD_OUT = tuple(f"DJI_{number:04d}.JPG" for number in (*range(18, 26), 30, 33))


@pytest.fixture(scope="module")
def photos(shared_data: Path) -> Path:
    folder = shared_data / "brighton" / "images"
    if not folder.is_dir():
        pytest.skip(f"not there: {folder}")
    return folder


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work folder of all ingests here: features and matches are made once."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def part(photos: Path, work: Path, tmp_path_factory: pytest.TempPathFactory) -> Ingest:
    """A database without the held-out photos."""
    return ingest(tmp_path_factory.mktemp("part") / "db", photos, _HELD_OUT, work)


def test_cameras_are_where_their_gps_says(part: Ingest) -> None:
    assert (part.usable, part.registered) == (8, 8)
    snapshot = Database.open(part.database).snapshot()
    (summary,) = snapshot.maps()
    feature_map = snapshot.load_map(summary.map_id)
    assert feature_map.epsg == 32615
    assert len(feature_map.points) > 1500
    for image in feature_map.images:
        assert image.gps is not None
        center = feature_map.frame.utm_from_enu(image.cam_from_local.center, feature_map.epsg)
        gps = utm_from_geodetic(
            (image.gps.latitude_deg, image.gps.longitude_deg, image.gps.height_m or 0.0), feature_map.epsg
        )
        assert np.linalg.norm(center - gps) < 1.5
    # A flight looks down on its points.
    assert np.median(feature_map.points_local()[:, 2]) < -20


def test_the_same_ingest_again_changes_nothing(part: Ingest, photos: Path, work: Path) -> None:
    options = IngestOptions(scan=ScanOptions(exclude=_HELD_OUT), work=work, workers=1)
    again = ingest_photos(Database.open(part.database), photos, options)
    assert {p.name for p in again.photos if p.status == "skipped"} == set(_HELD_OUT)
    assert [m.status for m in again.maps] == ["already_there"]
    assert [s.reused == s.total for s in again.stages if s.total] == [True] * 4
