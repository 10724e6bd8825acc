"""Real drone photos through a whole ingest; held-out photos are a row of the scoreboard."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from featuredb.features.decode import decode_gray, probe
from featuredb.features.extractor import ExtractorOptions
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_from_geodetic
from featuredb.store import Database
from ingest.api.ingesting import summary as summary_text
from ingest.growth.trust.promotion import promote_by_hand
from ingest.photos.scan import ScanOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions
from ingest.report.values import IngestReport
from reloc.localise.localise import localise
from reloc.service.handler import localise_request
from reloc.wire.query import LocaliseWireRequest, RequestOptions
from tests.support.scenes import indexed

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
def options(tmp_path_factory: pytest.TempPathFactory) -> IngestOptions:
    """Of all ingests here: features and matches are made once, in this process, and few of them."""
    return IngestOptions(
        scan=ScanOptions(exclude=_HELD_OUT),
        work=tmp_path_factory.mktemp("work"),
        workers=1,
        making=MapMakingOptions(extractor=ExtractorOptions(max_features=8000)),
    )


@pytest.fixture(scope="module")
def part(
    photos: Path, options: IngestOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Database, IngestReport]:
    """A database without the held-out photos."""
    database = Database.create(tmp_path_factory.mktemp("part") / "db")
    return database, ingest_photos(database, photos, options)


def test_cameras_are_where_their_gps_says(part: tuple[Database, IngestReport]) -> None:
    database, report = part
    assert report.count("registered") == 8
    snapshot = database.snapshot()
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


def test_the_same_ingest_again_changes_nothing(
    part: tuple[Database, IngestReport], photos: Path, options: IngestOptions
) -> None:
    again = ingest_photos(part[0], photos, options)
    assert {p.name for p in again.photos if p.status == "skipped"} == set(_HELD_OUT)
    assert [m.status for m in again.maps] == ["already_there"]
    assert [s.reused == s.total for s in again.stages if s.total] == [True] * 4


def test_what_was_retired_stays_so_when_its_photos_are_ingested_again(
    part: tuple[Database, IngestReport], photos: Path, options: IngestOptions
) -> None:
    database = part[0]
    (summary,) = database.snapshot().maps()
    database.retire(summary.map_id, "a wrong lens")
    try:
        again = ingest_photos(database, photos, options)
        assert [(m.status, m.reason) for m in again.maps] == [("retired", "a wrong lens")]
        assert "was retired (a wrong lens) and stays so; `featuredb promote`" in summary_text(again)
        assert database.snapshot().maps() == []
    finally:
        assert promote_by_hand(database, summary.map_id, "the lens is right", force=True).promoted
    assert [m.map_id for m in database.snapshot().maps()] == [summary.map_id]


def test_a_photos_own_position_settles_which_of_two_places_it_shows(
    part: tuple[Database, IngestReport], photos: Path
) -> None:
    """The same park once more, three kilometres to the east; a photo of the map, and one held out."""
    snapshot = part[0].snapshot()
    park = snapshot.load_map(snapshot.maps()[0].map_id)
    easting, northing, height = park.frame.utm_from_enu(np.zeros(3), park.epsg)
    frame = LocalFrame.from_utm(easting + 3000.0, northing, height, park.epsg)
    utm = frame.utm_from_enu(park.points_local(), park.epsg)
    twin = replace(park, map_id="twin", frame=frame, points=replace(park.points, utm=utm))
    areas = [indexed(twin), indexed(park)]
    for name in ("DJI_0027.JPG", "DJI_0025.JPG"):
        data = (photos / name).read_bytes()
        gray = decode_gray(data)
        told = localise_request(
            LocaliseWireRequest(options=RequestOptions(exif_prior=True)), data, probe(data)
        )
        assert told.own_position is not None
        assert localise(gray, replace(told, own_position=None), areas).reason == "AMBIGUOUS"
        found = localise(gray, told, areas)
        assert found.pose is not None
        assert found.pose.map_ids == (park.map_id,)
        assert found.own_position is not None
        assert found.own_position.role == "decided"
        assert found.own_position.distance_m == pytest.approx(0.0, abs=3.0)
        # The position of another town is believed neither where two places fit, nor where one does.
        town = replace(told, own_position=replace(told.own_position, latitude_deg=48.0, longitude_deg=11.0))
        assert localise(gray, town, areas).reason == "AMBIGUOUS"
        alone = localise(gray, town, areas[1:])
        assert alone.pose is not None
        assert np.linalg.norm(alone.pose.utm - found.pose.utm) < 0.5
        assert alone.own_position is not None
        assert alone.own_position.role == "contradicted"


def test_a_zoomed_photo_is_not_believed_to_have_its_cameras_lens(
    part: tuple[Database, IngestReport], photos: Path
) -> None:
    """Its middle, enlarged, with the EXIF of the whole: over a flat park it looks like a photo from below."""
    snapshot = part[0].snapshot()
    area = indexed(snapshot.load_map(snapshot.maps()[0].map_id))
    for name in ("DJI_0027.JPG", "DJI_0031.JPG"):
        data = (photos / name).read_bytes()
        gray, told = decode_gray(data), localise_request(LocaliseWireRequest(), data, probe(data))
        height, width = gray.shape
        middle = gray[height // 6 : -(height // 6), width // 6 : -(width // 6)]
        zoomed = cv2.resize(middle, (width, height), interpolation=cv2.INTER_CUBIC)
        whole, found = (localise(picture, told, [area]) for picture in (gray, zoomed))
        assert whole.pose is not None
        assert whole.pose.camera_source == "map"
        assert found.pose is not None
        assert found.pose.camera_source == "estimated"
        off = np.abs(found.pose.utm - whole.pose.utm)
        assert (off <= 2.5 * np.sqrt(np.diag(found.pose.covariance)[3:])).all()
