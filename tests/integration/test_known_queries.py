"""Known queries as photos with true poses: what they are worth, and that they stop a wrong anchor."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from featuredb.features.extractor import ExtractorOptions
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import move_map
from featuredb.store import Database
from featuredb.store.canaries import KnownPose, add_canary
from ingest.growth.graph.replacing import replace_descendants
from ingest.growth.trust.canaries import answer_now, check_known
from reloc.localiser import Localiser
from tests.support.planar_map import EASTING, EPSG, HEIGHT, NORTHING, field_texture, planar_map, render, view
from tests.support.scene_strip import east, grown

_FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
_LOOSE = np.diag(np.repeat([1e-4, 3.0], [4, 3]) ** 2)
# Photos that look straight down cannot tell focal length from height.
_ASKED = {"camera": {"model": "PINHOLE", "width": 640, "height": 480, "params": [600.0, 600.0, 320.0, 240.0]}}
_POSE = view(3.0, -4.0, 44.0, 8.0, 25.0)


@lru_cache(maxsize=1)
def _field() -> FeatureMap:
    return planar_map(1, map_id="A", fingerprint=ExtractorOptions().fingerprint)


def _photo(pose: Rigid3 = _POSE, texture: int = 1) -> bytes:
    return bytes(cv2.imencode(".png", render(field_texture(texture), pose, seed=99))[1])


def _known(pose: Rigid3, tolerance_m: float = 0.5) -> KnownPose:
    return KnownPose(
        epsg=EPSG,
        utm=_FRAME.utm_from_enu(pose.center, EPSG),
        height_datum="ellipsoidal",
        cam_from_utm_xyzw=quaternion_from_matrix(pose.rotation @ _FRAME.grid_from_enu(pose.center, EPSG).T),
        tolerance_m=tolerance_m,
        tolerance_deg=1.0,
    )


@pytest.fixture
def database(tmp_path: Path) -> Database:
    """A survey with GPS of metres, and a map that it has placed."""
    first = replace(_field(), placement=replace(_field().placement, covariance=_LOOSE))
    database = Database.create(tmp_path / "db")
    database.commit_map(first)
    database.commit_map(grown(replace(first, map_id="m", status="active"), [first]))
    return database


def test_what_known_queries_are_worth(database: Database) -> None:
    right = add_canary(database, "right", _photo(), _known(_POSE), origin="person", request=_ASKED)
    off = add_canary(
        database, "off", _photo(), _known(view(6.0, -4.0, 44.0, 8.0, 25.0)), origin="person", request=_ASKED
    )
    nowhere = add_canary(database, "nowhere", _photo(texture=7), None, origin="person", request=_ASKED)
    localiser = Localiser.open(database)
    checks = {c.name: check_known(database, c, localiser, localiser) for c in (right, off, nowhere)}
    assert checks["right"].after == "right"
    assert checks["right"].error_m < 0.2
    assert checks["off"].after == "moved"
    assert checks["off"].error_m == pytest.approx(3.0, abs=0.2)
    assert checks["off"].regression == ""  # it was wrong before: nobody's fault now
    assert checks["nowhere"].after == "not_found"
    known, snapshot = answer_now(database, _photo())
    assert known is not None
    assert snapshot == database.poll_version()
    assert right.pose is not None
    np.testing.assert_allclose(known.utm[:2], right.pose.utm[:2], atol=1.0)  # its lens is estimated
    assert answer_now(database, _photo(texture=7))[0] is None


def test_a_known_query_stops_a_wrong_anchor(database: Database, tmp_path: Path) -> None:
    """An anchor that claims centimetres and lies three metres off pulls all along, but for the canary."""
    wrong = move_map(_field(), east(3.0), covariance=_field().placement.covariance)
    database.commit_map(replace(wrong, map_id="B"))
    add_canary(database, "known", _photo(), _known(_POSE), origin="person", request=_ASKED)
    version = database.poll_version()
    done = replace_descendants(database, tmp_path / "work", budget_m=0.5)
    assert done is not None
    assert done.reason == "CANARY"
    assert "known" in done.message
    assert database.poll_version() == version


def test_without_one_the_surer_anchor_is_believed(database: Database, tmp_path: Path) -> None:
    """The same, and nobody knows better: the survey of metres moves to the one of centimetres."""
    wrong = move_map(_field(), east(3.0), covariance=_field().placement.covariance)
    database.commit_map(replace(wrong, map_id="B"))
    done = replace_descendants(database, tmp_path / "work", budget_m=0.5)
    assert done is not None
    assert done.reason is None
    snapshot = database.snapshot()
    for map_id in ("A", "m"):
        moved = snapshot.load_map(map_id).points_local(_FRAME) - _field().points_local(_FRAME)
        np.testing.assert_allclose(np.median(moved, axis=0), [3.0, 0.0, 0.0], atol=0.1)
    assert done.reason is None
    assert {m.map_id for m in done.moved} == {"A", "m"}
