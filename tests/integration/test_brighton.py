"""Real drone photos through the whole line: ingest, server, client, against a map of all photos."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.geo.utm import utm_from_geodetic
from featuredb.store import Database
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.scan import ScanOptions
from tools.real_photos import Ingest, ask, ingest, reference, table

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

_HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")
_MAX_M, _MAX_DEG = 1.0, 0.5


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
    assert (part.usable, part.registered) == (14, 14)
    snapshot = Database.open(part.database).snapshot()
    (summary,) = snapshot.maps()
    feature_map = snapshot.load_map(summary.map_id)
    assert feature_map.epsg == 32615
    assert len(feature_map.points) > 3000
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


@pytest.mark.evaluation
def test_held_out_photos_lie_where_a_map_of_all_photos_has_them(
    part: Ingest, photos: Path, work: Path, tmp_path: Path
) -> None:
    whole = ingest(tmp_path / "whole", photos, (), work)
    assert (whole.usable, whole.registered) == (18, 18)

    database, truth = Database.open(part.database), reference(tmp_path / "whole")
    served = {
        i.name for m in database.snapshot().maps() for i in database.snapshot().load_map(m.map_id).images
    }
    assert served.isdisjoint(_HELD_OUT)
    rows = ask(database, photos, _HELD_OUT, truth)
    shown = table(rows, _MAX_M, _MAX_DEG)
    assert [row.name for row in rows] == list(_HELD_OUT)
    for row in rows:
        assert row.error is not None, shown
        assert row.error.position_m <= _MAX_M, shown
        assert row.error.angle_deg <= _MAX_DEG, shown
        # The map lends its lens to a photo of the same camera, and says how sure it is.
        assert row.camera == "map"
        assert 0.0 < row.horizontal_68_m < 10.0
        assert row.confidence > 0.5
