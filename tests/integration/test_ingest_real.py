"""Ingest of real drone photos: all registered, and placed as their GPS says."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.geo.utm import utm_from_geodetic
from featuredb.store import Database
from ingest.executor import InProcessExecutor
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.scan import ScanOptions, require_usable, scan_folder
from ingest.sfm import SfmOptions
from ingest.workspace import Workspace

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

_HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")


def test_brighton_without_four_photos(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "brighton" / "images"
    if not folder.is_dir():
        pytest.skip(f"not there: {folder}")
    database = Database.create(tmp_path / "db")
    options = IngestOptions(scan=ScanOptions(exclude=_HELD_OUT), workers=2)
    report = ingest_photos(database, folder, options)
    assert report.count("registered") == 14
    assert {p.name for p in report.photos if p.status == "skipped"} == set(_HELD_OUT)
    (outcome,) = report.maps
    feature_map = database.snapshot().load_map(outcome.map_id)
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
    # The same command again changes nothing.
    again = ingest_photos(database, folder, options)
    assert [m.status for m in again.maps] == ["already_there"]
    assert [s.reused == s.total for s in again.stages if s.total] == [True] * 4


def test_strangers_photos_without_exif(shared_data: Path, tmp_path: Path) -> None:
    """Seven of ten photos, half of them by long lenses: the usual focal length makes no reconstruction."""
    folder = shared_data / "sacre_coeur" / "mapping"
    if not folder.is_dir():
        pytest.skip(f"not there: {folder}")
    photos = list(require_usable(scan_folder(folder, ScanOptions()), folder, least=2))[:7]
    found = []
    for again in (False, True):
        options = MapMakingOptions(sfm=SfmOptions(focal_from_view_graph=again))
        workspace = Workspace(root=tmp_path, job_id=str(again))
        done = reconstruct_photos(photos, workspace, options, InProcessExecutor())
        found.append(max((len(model.rows) for model in done.reconstruction.models()), default=0))
    assert found[0] < 3
    assert found[1] >= 5
