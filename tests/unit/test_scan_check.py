"""A map is where the scan has the ground, or it is not; the gate of growth that asks."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from featuredb.errors import MissingExtraError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.render.cloud import PointCloud
from ingest.growth.gates import Gate
from ingest.growth.map_places import growth_of
from ingest.growth.place.component import GrownMap
from ingest.growth.place.map_images import model_of
from ingest.growth.trust import scan_check
from ingest.growth.trust.scan_check import checked_by_scan, cloud_gate
from ingest.growth.values import Refused
from tests.support.growth_box import grown_map
from tests.support.scanned_map import ground_points, plain_cloud, scan, scanned_map


def _claim(sigma_m: float) -> FloatArray:
    return np.diag([1e-8] + [1e-8] * 3 + [sigma_m**2] * 3)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return scan(np.random.default_rng(0))


def _ground(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FloatArray:
    points = ground_points(np.random.default_rng(2), 1500, 40.0)
    points += np.random.default_rng(3).normal(0.0, 0.03, points.shape)
    points[:150, 2] += np.random.default_rng(4).uniform(0.5, 6.0, 150)  # trees, cars, walls
    return points + np.array(shift)


def _asked(cloud: PointCloud, points: FloatArray, sigma_m: float = 0.05) -> Gate:
    gate = cloud_gate(cloud, points, _claim(sigma_m))
    assert gate is not None
    return gate


def test_a_map_on_the_scan_passes(cloud: PointCloud) -> None:
    gate = _asked(cloud, _ground())
    assert gate.passes
    assert gate.figure < 0.5 * gate.limit


@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
def test_a_map_a_metre_off_is_refused(cloud: PointCloud, shift: tuple[float, float, float]) -> None:
    gate = _asked(cloud, _ground(shift))
    assert not gate.passes
    assert gate.reason == "CONTRADICTS_SCAN"
    assert "1.0" in gate.message or "0.9" in gate.message  # metres that it would have to move


def test_a_turned_map_is_refused(cloud: PointCloud) -> None:
    turned = _ground() @ so3_exp(np.array([0.0, np.radians(2.0), 0.0])).T
    assert not _asked(cloud, turned).passes


def test_what_a_map_does_not_claim_is_not_held_against_it(cloud: PointCloud) -> None:
    assert _asked(cloud, _ground((0.0, 0.0, 1.0)), sigma_m=0.6).passes


def test_a_map_that_floats_is_refused_unless_its_height_is_anybodys_guess(cloud: PointCloud) -> None:
    floating = _ground((0.0, 0.0, 30.0))
    gate = _asked(cloud, floating)
    assert not gate.passes
    assert gate.as_json()["figure"] is None
    assert cloud_gate(cloud, floating, _claim(20.0)) is None


def test_flat_ground_holds_heights_alone() -> None:
    rng = np.random.default_rng(5)
    flat = np.column_stack([*rng.uniform(-55, 55, (2, 40_000)), rng.normal(0, 0.01, 40_000)])
    cloud = plain_cloud(flat)
    points = np.column_stack([*rng.uniform(-40, 40, (2, 1500)), rng.normal(0, 0.03, 1500)])
    assert _asked(cloud, points + np.array([3.0, -2.0, 0.0])).passes
    assert not _asked(cloud, points + np.array([0.0, 0.0, 1.0])).passes


def test_where_there_is_no_scan_nothing_is_said(cloud: PointCloud) -> None:
    assert cloud_gate(cloud, _ground((500.0, 0.0, 0.0)), _claim(0.05)) is None
    assert cloud_gate(cloud, _ground()[:50], _claim(0.05)) is None


def test_without_the_extra_a_map_with_a_scan_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    world = scanned_map(placed_by=Sim3.identity())
    known = replace(world.feature_map, height_datum=world.cloud.height_datum)
    grown = grown_map(known, model_of(known, known.images, described=False))
    database: Any = SimpleNamespace(has=lambda _: True)
    monkeypatch.setattr(scan_check, "load_cloud", lambda *_: world.cloud)
    checked, why = checked_by_scan(database, grown)
    assert isinstance(checked, GrownMap)
    assert growth_of(checked.feature_map.placement.evidence)["gates"]["scan"]["passes"]

    def missing(*_: object) -> PointCloud:
        raise MissingExtraError("reading a scan needs laspy: pip install 'featuredb[lidar]'")

    monkeypatch.setattr(scan_check, "load_cloud", missing)
    refused, why = checked_by_scan(database, grown)
    assert isinstance(refused, Refused)
    assert (refused.reason, why) == ("SCAN_NOT_ASKED", "")
    assert "featuredb[lidar]" in refused.message
    assert [gate.passes for gate in refused.gates] == [False]
    monkeypatch.setattr(scan_check, "load_cloud", lambda *_: SimpleNamespace(xyz=()))
    assert checked_by_scan(database, grown) == (grown, "")
