"""`featuredb adjust`: bent maps of one strip straighten each other; what must not happen does not."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.cli.main import main
from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap, MapObservations
from featuredb.store import Database
from ingest.growth.graph.joint.adjust import adjust_maps, adjust_together
from ingest.growth.graph.joint.joined import Links, join_maps
from ingest.growth.graph.map_graph import place_of
from ingest.growth.map_places import growth_of
from tests.support.scene_strip import POINTS, east, grown, strip_map

_HALF_A_METRE = np.diag(np.repeat([1e-7, 0.5], [4, 3]) ** 2)


def bent(feature_map: FeatureMap, metres: float) -> FeatureMap:
    """The map with its middle lifted against its ends; its pixels stay, and so does what they know."""
    middle = float(np.median(feature_map.points_local()[:, 0]))

    def lift(places: FloatArray) -> FloatArray:
        moved = places.copy()
        moved[:, 2] += metres * np.exp(-(((places[:, 0] - middle) / 20.0) ** 2))
        return moved

    images = []
    for image in feature_map.images:
        center = lift(image.cam_from_local.center[None])[0]
        pose = image.cam_from_local
        images.append(replace(image, cam_from_local=replace(pose, translation=-pose.rotation @ center)))
    utm = feature_map.frame.utm_from_enu(lift(feature_map.points_local()), feature_map.epsg)
    return replace(feature_map, images=tuple(images), points=replace(feature_map.points, utm=utm))


def with_pixels(feature_map: FeatureMap, pixels: NDArray[np.float32]) -> FeatureMap:
    seen = feature_map.observations
    columns = {name: getattr(seen, name) for name in MapObservations.__slots__}
    return replace(feature_map, observations=MapObservations(**{**columns, "xy": pixels}))


def errors_m(feature_map: FeatureMap) -> FloatArray:
    """Distances of the map's points from the nearest true ones."""
    own = feature_map.points_local()
    return np.array([np.linalg.norm(POINTS - p, axis=1).min() for p in own])


@pytest.fixture(scope="module")
def anchor() -> FeatureMap:
    return bent(strip_map("anchor", 40.0, covariance=_HALF_A_METRE), 0.6)


@pytest.fixture(scope="module")
def child(anchor: FeatureMap) -> FeatureMap:
    return replace(bent(strip_map("child", 60.0, parents=[anchor], seed=1), -0.5), status="active")


def test_bent_maps_straighten_each_other(anchor: FeatureMap, child: FeatureMap) -> None:
    before = [float(np.median(errors_m(m))) for m in (anchor, child)]
    assert min(before) > 0.15
    found = adjust_together([anchor, child])
    assert found.reason is None
    assert [m.map_id for m in found.maps] == ["anchor", "child"]
    assert found.shared_points > 100
    shapes = {r.map_id: r.shape_m for r in found.reports}
    assert min(shapes.values()) > 0.05
    # The anchor keeps its place as a whole, which the bend had shifted; its shape is the true one.
    new = found.maps[0].points_local()
    true = np.array([POINTS[np.linalg.norm(POINTS - p, axis=1).argmin()] for p in new])
    fit = similarity_closed_form(new, true)
    assert fit is not None
    assert np.median(np.linalg.norm(fit.act(new) - true, axis=1)) < 0.01
    apart = np.abs(np.median(errors_m(found.maps[0])) - np.median(errors_m(found.maps[1])))
    assert apart < 0.05


def test_a_held_map_stays_and_the_others_come_to_it(child: FeatureMap) -> None:
    straight = strip_map("anchor", 40.0)
    found = adjust_together([straight, child], held=["anchor"])
    assert found.reason is None
    assert [m.map_id for m in found.maps] == ["child"]
    assert found.reports[0].held
    assert found.reports[0].move_m < 1e-9
    assert found.reports[0].map_id == "anchor"
    assert np.median(errors_m(found.maps[0])) < 0.02
    assert found.maps[0].placement.evidence["joint"]["with"] == ["anchor", "child"]


def test_a_photo_of_two_maps_is_one_photo(anchor: FeatureMap) -> None:
    """The same photos in both, with descriptors that nobody recognises: the pixels alone tell."""
    rng = np.random.default_rng(0)
    twin = bent(replace(strip_map("twin", 40.0, covariance=_HALF_A_METRE), images=anchor.images), -0.5)
    seen = twin.observations
    strange = rng.integers(0, 255, seen.descriptors.shape, dtype=np.uint8)
    columns = {name: getattr(seen, name) for name in MapObservations.__slots__}
    twin = replace(twin, observations=MapObservations(**{**columns, "descriptors": strange}))
    found = adjust_together([anchor, twin])
    assert found.reason is None
    poses = [[i.cam_from_local.matrix() for i in m.images] for m in found.maps]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)


def test_a_held_map_holds_the_photos_that_it_shares_whatever_the_order() -> None:
    """A bigger map by GPS, a metre off, with the same photos; what LiDAR placed lends it their poses."""
    held = strip_map("held", 40.0)
    made = strip_map("gps", 40.0, move=east(1.0), covariance=_HALF_A_METRE)
    images = tuple(
        replace(image, sha256=other.sha256) for image, other in zip(made.images, held.images, strict=True)
    )
    gps = replace(made, images=images)
    for maps in ([gps, held], [held, gps]):
        found = adjust_together(maps, held=["held"])
        assert found.reason is None, found.message
        assert [m.map_id for m in found.maps] == ["gps"]
        assert np.median(errors_m(found.maps[0])) < 0.02
        assert {r.map_id: r.move_m for r in found.reports}["gps"] == pytest.approx(1.0, abs=0.05)


def test_the_surer_anchor_keeps_its_place(anchor: FeatureMap) -> None:
    """An RTK survey, and a map by phones that is 2 m off and says that it may be."""
    tight, loose = (np.diag(np.repeat([1e-7, sigma], [4, 3]) ** 2) for sigma in (0.02, 3.0))
    rtk = strip_map("rtk", 40.0, covariance=tight)
    phones = strip_map("phones", 45.0, move=east(2.0), covariance=loose, cameras=16, seed=4)
    found = adjust_together([phones, rtk])
    assert found.reason is None, found.message
    new = {m.map_id: m for m in found.maps}
    assert np.median(errors_m(new["rtk"])) < 0.02
    assert np.median(errors_m(new["phones"])) < 0.05


def test_an_anchor_that_would_move_more_than_it_can_be_wrong_refuses() -> None:
    tight = np.diag(np.repeat([1e-7, 0.02], [4, 3]) ** 2)
    maps = [
        strip_map("one", 40.0, covariance=tight),
        strip_map("two", 45.0, move=east(1.0), covariance=tight, seed=4),
    ]
    found = adjust_together(maps)
    assert (found.reason, found.maps) == ("ANCHOR_MOVED", ())
    assert "its own placement allows 0.06 m" in found.message
    assert adjust_together(maps, free=["one", "two"]).reason is None


def test_maps_without_common_points_are_refused(anchor: FeatureMap) -> None:
    found = adjust_together([anchor, strip_map("away", 180.0)])
    assert (found.reason, found.maps) == ("UNCONNECTED", ())
    assert "0 photos were found" in found.message


def test_maps_whose_positions_are_shifted_are_refused_with_the_distance(anchor: FeatureMap) -> None:
    found = adjust_together([anchor, strip_map("shifted", 45.0, move=east(50_000.0), seed=4)])
    assert found.reason == "UNCONNECTED"
    (metres,) = re.findall(r"([0-9,]+) m from where their own map has them", found.message)
    assert float(metres.replace(",", "")) == pytest.approx(50_000.0, abs=20.0)


def of_another_scene(metres: float) -> FeatureMap:
    """A map of a scene of another shape, which fits its own pixels."""
    other = bent(strip_map("other", 40.0, seed=3), metres)
    seen, points = other.observations, other.points_local()
    pixels = seen.xy.copy()
    for image in other.images:
        mine = seen.image_id == image.image_id
        pixels[mine] = other.cameras[0].project(image.cam_from_local.act(points[seen.point_index[mine]]))
    return with_pixels(other, pixels)


@pytest.mark.parametrize(("metres", "reason"), [(0.8, "RESIDUALS"), (1.5, "OBSERVATIONS_LOST")])
def test_maps_that_contradict_each_other_are_refused(
    metres: float, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No poses and points fit both; the robust loss would rather leave one's observations out."""
    maps = [strip_map("anchor", 40.0), of_another_scene(metres)]
    if reason == "OBSERVATIONS_LOST":
        monkeypatch.setattr("ingest.growth.graph.joint.adjusted_map._MOST_GROWTH", np.inf)
    found = adjust_together(maps)
    assert (found.reason, found.maps) == (reason, ())
    assert "map other" in found.message


def test_a_photo_that_loses_its_points_refuses(anchor: FeatureMap) -> None:
    wrong = strip_map("wrong", 40.0, seed=3)
    seen = wrong.observations
    first = seen.image_id == 0
    pixels = seen.xy.copy()
    pixels[first] = pixels[first][::-1]
    found = adjust_together([anchor, with_pixels(wrong, pixels)])
    assert (found.reason, found.maps) == ("PHOTO_LOST", ())


def test_bad_requests_say_what_is_wrong(anchor: FeatureMap, child: FeatureMap) -> None:
    with pytest.raises(InvalidValueError, match="at least two maps, found 1"):
        adjust_together([anchor])
    with pytest.raises(InvalidValueError, match="one height datum"):
        adjust_together([anchor, replace(child, height_datum="egm96")])
    with pytest.raises(InvalidValueError, match="one extractor"):
        adjust_together([anchor, replace(child, extractor_fingerprint="other")])
    with pytest.raises(InvalidValueError, match="all maps are held"):
        adjust_together([anchor, child], held=["anchor", "child"])


@pytest.fixture
def database(anchor: FeatureMap, child: FeatureMap, tmp_path: Path) -> Database:
    database = Database.create(tmp_path / "db")
    database.commit_maps([anchor, child])
    return database


def test_in_a_database_all_moves_in_one_commit(database: Database) -> None:
    version = database.snapshot().version
    tried = adjust_maps(database, ["anch"], dry_run=True)
    assert (tried.reason, tried.version, database.snapshot().version) == (None, -1, version)
    found = adjust_maps(database, ["anch"])
    assert (found.reason, found.version, found.descendants) == (None, version + 1, ("child",))
    snapshot = database.snapshot()
    assert [m.status for m in snapshot.maps()] == ["active", "active"]
    maps = {m: snapshot.load_map(m) for m in ("anchor", "child")}
    edge = growth_of(maps["child"].placement.evidence)["edges"][0]
    assert edge["place"] == place_of(maps["anchor"])
    np.testing.assert_array_equal(edge["parent_from_new"], Sim3.identity().log())
    assert maps["child"].parents == ("anchor",)
    database.rollback(version)
    assert place_of(database.snapshot().load_map("anchor")) != place_of(maps["anchor"])


def test_a_parent_that_is_not_named_holds_its_children(anchor: FeatureMap, tmp_path: Path) -> None:
    """Two children of one anchor, whose overlaps say that the anchor lies east; afterwards they agree."""
    straight = strip_map("anchor", 40.0)
    children = [
        replace(
            bent(strip_map(name, 60.0, parents=[straight], seed=k, move=east(0.3)), -0.4), status="active"
        )
        for k, name in ((1, "first"), (2, "second"))
    ]
    wrong = []
    for child in children:
        growth = growth_of(child.placement.evidence)
        growth["edges"][0]["parent_from_new"] = east(-0.3).log().tolist()
        evidence = {**child.placement.evidence, "growth": growth}
        wrong.append(replace(child, placement=replace(child.placement, evidence=evidence)))
    database = Database.create(tmp_path / "db")
    database.commit_maps([straight, *wrong])
    found = adjust_maps(database, ["first", "second"])
    assert found.reason is None, found.message
    assert [(r.map_id, r.held) for r in found.reports] == [
        ("anchor", True), ("first", False), ("second", False),
    ]  # fmt: skip
    snapshot = database.snapshot()
    assert snapshot.load_map("anchor").placement.evidence.get("joint") is None
    for name in ("first", "second"):
        new = snapshot.load_map(name)
        assert np.median(errors_m(new)) < 0.05
        edge = growth_of(new.placement.evidence)["edges"][0]
        np.testing.assert_array_equal(edge["parent_from_new"], Sim3.identity().log())
        assert edge["place"] == place_of(straight)


def test_active_maps_behind_quarantined_ones_join(
    anchor: FeatureMap, child: FeatureMap, tmp_path: Path
) -> None:
    between = strip_map("between", 60.0, parents=[anchor], seed=5)
    behind = replace(grown(strip_map("behind", 70.0, seed=6), [between]), status="active")
    database = Database.create(tmp_path / "db")
    database.commit_maps([anchor, child, between, behind])
    found = adjust_maps(database, ["anchor"])
    assert found.reason is None, found.message
    assert found.descendants == ("child", "behind")
    status = {m.map_id: m.status for m in database.snapshot().maps()}
    assert status == {"anchor": "active", "child": "active", "between": "quarantined", "behind": "active"}


def test_measured_anchors_stay_unless_freed(anchor: FeatureMap, child: FeatureMap, tmp_path: Path) -> None:
    database = Database.create(tmp_path / "db")
    surveyed = replace(anchor, placement=replace(anchor.placement, method="lidar"))
    database.commit_maps([surveyed, child])
    held = adjust_maps(database, ["anchor"], dry_run=True)
    assert [r.held for r in held.reports] == [True, False]
    freed = adjust_maps(database, ["anchor"], free=["anchor"], dry_run=True)
    assert [r.held for r in freed.reports] == [False, False]


def test_a_known_query_that_would_be_lost_stops_it(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ingest.growth.trust.canaries import CanaryCheck, CanaryRun

    check = CanaryCheck(name="known", before="right", after="moved", regression="2.00 m off")
    monkeypatch.setattr(
        "ingest.growth.graph.joint.adjust.ask_persons_canaries",
        lambda *_: CanaryRun(checks=(check,), note="1 known queries"),
    )
    version = database.snapshot().version
    found = adjust_maps(database, ["anchor"])
    assert (found.reason, found.version, database.snapshot().version) == ("CANARY", -1, version)
    assert "2.00 m off" in found.message


def test_the_command(database: Database, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*args: str) -> tuple[int, str, str]:
        code = main(["adjust", database.url, *args])
        said = capsys.readouterr()
        return code, said.out, said.err

    code, out, _ = run("anchor", "--dry-run")
    assert code == 0
    assert "nothing is committed" in out
    assert "with what hangs on the named maps: child" in out
    code, out, _ = run("anchor", "--json")
    said: dict[str, Any] = json.loads(out)
    assert (code, said["reason"], said["version"]) == (0, None, database.snapshot().version)
    assert [m["map_id"] for m in said["maps"]] == ["anchor", "child"]
    code, _, err = run("nobody")
    assert code != 0
    assert "has no live map nobody" in err
    database.commit_maps([strip_map("away", 180.0)])
    code, out, _ = run("anchor", "away")
    assert code == 1
    assert "refused, UNCONNECTED: maps away" in out


def test_focal_lengths_that_exif_told_are_known_beforehand(anchor: FeatureMap, child: FeatureMap) -> None:
    none = Links(pairs=np.zeros((0, 4), dtype=np.int64), heard=0, elsewhere=())
    assert join_maps([anchor, child], none).known_focal_px == {}
    films = [replace(m, camera_keys=("film|x|640x480|unknown",)) for m in (anchor, child)]
    assert join_maps(films, none).known_focal_px == {}
    assert len(join_maps(films, none).model.cameras) == 2
    keyed = [replace(m, camera_keys=("maker|drone|640x480|f600|7",)) for m in (anchor, child)]
    joined = join_maps(keyed, none)
    assert len(joined.model.cameras) == 1
    assert joined.known_focal_px == {0: anchor.cameras[0].focal_px}
