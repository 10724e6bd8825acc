"""`featuredb anchor` on photos and a scan of textured hills: what is placed, proposed, refused, kept."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import ConflictError, RegistrationError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.lidar.add import add_scan
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.scans import list_scans
from ingest.anchoring import AnchorRequest, anchor
from ingest.api.anchor_words import anchoring_text
from ingest.register.anchor import frames
from schemas import load_schema
from tests.support.hill_map import hill_map
from tests.support.hill_photos import CAMERA, FRAME, hill_height, hill_photos
from tests.support.hill_scan import EPSG, write_hill_scan
from tests.support.maps import random_map
from tests.support.remembered import remembered

# Where the scan lies from where the photos' GPS has the hills: a drone's usual error, heights most of all.
OFFSET = np.array([1.5, -1.0, 8.0])


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Folder of photos, a database with their map and the scan, and one with another field's scan."""
    made, root = hill_map(tmp_path_factory), tmp_path_factory.mktemp("anchor")
    shutil.copytree(made / "db", root / "plain", ignore=shutil.ignore_patterns("_work"))
    for name, seed in (("right", 1), ("wrong", 7)):
        shutil.copytree(root / "plain", root / name)
        scan = write_hill_scan(root / f"{name}.laz", offset_m=tuple(OFFSET), texture_seed=seed)
        add_scan(Database.open(root / name), [scan])
    return made / "photos", root / "right", root / "wrong"


@pytest.fixture(scope="module", autouse=True)
def _frames_registered_once() -> Iterator[None]:
    """Several tests begin with the same frame of the same map on the same scan."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "register_frame", remembered(frames.register_frame))
        yield


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Path], Path]:
    def copy(database: Path) -> Path:
        return Path(shutil.copytree(database, tmp_path / "db"))

    return copy


def only_map(database: Path, as_of: int | None = None) -> FeatureMap:
    snapshot = Database.open(database).snapshot(as_of)
    (summary,) = [m for m in snapshot.maps() if m.method in ("gps", "lidar")]
    return snapshot.load_map(summary.map_id)


def errors(feature_map: FeatureMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances of cameras (m), angles (deg), and heights of points (m) from the truth on the scan."""
    truth = {p.name: p.cam_from_local for p in hill_photos()}
    frame_from_map = FRAME.enu_from(feature_map.frame)
    metres, degrees = [], []
    for image in feature_map.images:
        pose = image.cam_from_local @ frame_from_map.inverse()
        metres.append(np.linalg.norm(pose.center - truth[image.name].center - OFFSET))
        degrees.append(pose.angle_to_deg(truth[image.name]))
    points = FRAME.enu_from_utm(feature_map.points.utm, feature_map.epsg) - OFFSET
    return np.array(metres), np.array(degrees), points[:, 2] - hill_height(points[:, 0], points[:, 1])


def test_auto_places_the_map_on_the_scan(
    hills: tuple[Path, Path, Path],
    copied: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photos, right, _ = hills
    database = copied(right)
    old = only_map(database)
    metres_before, _, heights_before = errors(old)
    assert np.median(metres_before) > 5.0
    assert abs(np.median(heights_before)) > 5.0
    # A map that the old one placed must not go on answering from there.
    child = random_map(3, parents=(old.map_id,))
    version = Database.open(database).commit_map(child).version

    out = tmp_path / "out"
    words = ["anchor", str(database), old.map_id[:10], "--photos", str(photos), "--out", str(out)]
    assert main([*words, "--auto", "--quiet"]) == 0
    said = capsys.readouterr().out
    new = only_map(database)
    metres, degrees, heights = errors(new)
    assert np.median(metres) < 0.15
    assert np.median(degrees) < 0.15
    assert np.abs(np.median(heights)) < 0.05
    assert np.percentile(np.abs(heights), 80) < 0.3

    assert new.placement.method == "lidar"
    assert (new.generation, new.parents, new.status) == (0, (), "active")
    assert new.map_id == old.map_id
    np.testing.assert_array_equal(new.observations.descriptors, old.observations.descriptors)
    evidence = new.placement.evidence["anchor"]
    assert evidence["before"]["median_m"] > 5.0 > 0.15 > evidence["after"]["median_m"]
    assert len(evidence["frames"]) >= 2
    sigmas = np.sqrt(np.diag(new.placement.covariance))
    assert 0 < sigmas[4:].max() < 0.5
    summary = Database.open(database).snapshot().get(child.map_id)
    assert summary.status == "quarantined"
    assert old.map_id in summary.status_reason
    assert child.map_id in said

    # The old placement is still there, and comes back with what hung on it.
    np.testing.assert_array_equal(only_map(database, version).points.utm, old.points.utm)
    assert f"featuredb rollback {database} {version}" in said
    assert main(["rollback", str(database), str(version)]) == 0
    assert only_map(database).placement.method == "gps"
    assert Database.open(database).snapshot().get(child.map_id).status == "active"

    document = json.loads((out / "anchor.json").read_text())
    jsonschema.validate(document, load_schema("ingest/anchor"))
    assert document["placement"]["reason"] is None
    assert any(name.startswith("(B)") for name in document["times_s"])
    assert any(name.startswith("(C)") for name in document["times_s"])
    assert "(B)" in said
    assert "(C)" in said
    page = (out / "anchor.html").read_text()
    for words_ in ("Map points over the scan", "Distances of map points", "(B)", "(C)"):
        assert words_ in page
    assert "http" not in page.replace("http-equiv", ""), "the page needs no network"
    assert page.count('<div class="frame">') == len(document["frames"])


def test_frames_are_proposed_and_one_is_confirmed(
    hills: tuple[Path, Path, Path],
    copied: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photos, right, _ = hills
    database, out = copied(right), tmp_path / "out folder"
    old = only_map(database)
    version = Database.open(database).poll_version()
    words = ["anchor", str(database), old.map_id, "--photos", str(photos), "--out", str(out), "--quiet"]
    assert main([*words, "--confirm", "photo_04.jpg"]) == 2
    assert "nothing has been proposed" in capsys.readouterr().err
    scan_id = list_scans(Database.open(database))[0].scan_id
    assert main([*words, "--frames", "1", "--scan", scan_id[:8]]) == 0
    said = capsys.readouterr().out
    assert Database.open(database).poll_version() == version, "a proposal changes nothing"
    assert f"--scan {scan_id} " in said
    words += ["--scan", scan_id]
    page = (out / "anchor.html").read_text()
    assert "http" not in page
    (proposed,) = json.loads((out / "proposals.json").read_text())["frames"]
    name = old.images[int(proposed)].name
    command = f"--out '{out}' --confirm {name}"
    assert command in said
    assert command.replace("'", "&#x27;") in page

    assert main([*words, "--confirm", "photo_99.jpg"]) == 2
    assert "no image is called" in capsys.readouterr().err
    assert main([*words, "--confirm", name]) == 0
    metres, _, heights = errors(only_map(database))
    assert np.median(metres) < 0.3
    assert abs(np.median(heights)) < 0.1
    # What was proposed belongs to the old state of the map.
    assert main([*words, "--confirm", name]) == 2
    assert "run the command without --confirm again" in capsys.readouterr().err


def test_a_scan_of_another_place_moves_nothing(
    hills: tuple[Path, Path, Path],
    copied: Callable[[Path], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    photos, _, wrong = hills
    path, out = copied(wrong), tmp_path / "out"
    database = Database.open(path)
    version = database.poll_version()
    request = AnchorRequest(map_id=only_map(path).map_id, photos=photos, out=out, auto=True)
    # Each frame that is refused has gone through every source and every search: one is enough here.
    monkeypatch.setattr("ingest.register.anchor.frames._LEAST_TRIES", 1)
    monkeypatch.setattr("ingest.register.anchor.frames._SPARE_TRIES", -2)
    done = anchor(database, request)
    assert not done.placed
    result = done.report.result
    assert result is not None
    assert result.reason == "NO_FRAME"
    assert done.report.tried.tried[0].registration.reason is not None
    assert database.poll_version() == version
    assert only_map(path).placement.method == "gps"
    document = json.loads((out / "anchor.json").read_text())
    jsonschema.validate(document, load_schema("ingest/anchor"))
    assert document["placement"]["reason"] == "NO_FRAME"
    assert "not placed: NO_FRAME: none of 1 frames was registered" in anchoring_text(done, str(path))


def test_an_interrupted_run_leaves_the_database_as_it_was(
    hills: tuple[Path, Path, Path], copied: Callable[[Path], Path], tmp_path: Path
) -> None:
    photos, right, _ = hills
    database = Database.open(copied(right))
    before = database.snapshot()
    map_id = before.maps()[0].map_id

    def interrupt(stage: str, done: int, total: int) -> None:
        if stage == "place":
            raise KeyboardInterrupt

    request = AnchorRequest(map_id=map_id, photos=photos, out=tmp_path / "out", auto=True, frames=1)
    with pytest.raises(KeyboardInterrupt):
        anchor(database, request, interrupt)
    after = database.snapshot()
    assert after.version == before.version
    assert after.rows() == before.rows()
    assert main(["verify", database.url]) == 0


def test_a_map_that_someone_else_placed_meanwhile_is_not_overwritten(
    hills: tuple[Path, Path, Path], copied: Callable[[Path], Path], tmp_path: Path
) -> None:
    photos, right, _ = hills
    database = Database.open(copied(right))
    map_id = database.snapshot().maps()[0].map_id

    def other_writer(stage: str, done: int, total: int) -> None:
        if stage == "place":
            other = replace(database.snapshot().load_map(map_id), name=f"changed {done}")
            database.commit_map(other, replaces=map_id)

    request = AnchorRequest(map_id=map_id, photos=photos, out=tmp_path / "out", auto=True, frames=1)
    with pytest.raises(ConflictError, match="placed anew by someone else"):
        anchor(database, request, other_writer)
    assert database.snapshot().load_map(map_id).placement.method == "gps"


def lost(feature_map: FeatureMap, by_m: FloatArray) -> FeatureMap:
    """The map placed wrong by a shift in its local frame."""
    back = Rigid3(rotation=np.eye(3), translation=-by_m)
    images = tuple(replace(i, cam_from_local=i.cam_from_local @ back) for i in feature_map.images)
    utm = feature_map.frame.utm_from_enu(feature_map.points_local() + by_m, feature_map.epsg)
    return replace(feature_map, images=images, points=replace(feature_map.points, utm=utm))


def test_a_scan_that_lies_elsewhere_is_told_with_the_distance(
    hills: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    photos, right, _ = hills
    database = Database.open(shutil.copytree(right.parent / "plain", tmp_path / "db"))
    add_scan(database, [write_hill_scan(tmp_path / "far.laz", offset_m=(-50_000.0, 0.0, 0.0))])
    map_id = only_map(tmp_path / "db").map_id
    scan_id = list_scans(database)[0].scan_id
    for scans in ((), (scan_id,)):
        request = AnchorRequest(map_id=map_id, photos=photos, scan_ids=scans, out=tmp_path / "out", auto=True)
        with pytest.raises(
            RegistrationError, match=r"lies (49\.9|50\.0) km to the west.*positions are all wrong"
        ):
            anchor(database, request)


def test_picks_with_an_outlier_start_a_map_that_lies_elsewhere(
    hills: tuple[Path, Path, Path],
    copied: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photos, right, _ = hills
    path, out = copied(right), tmp_path / "out"
    database = Database.open(path)
    old = only_map(path)
    database.commit_map(lost(old, np.array([45.0, 30.0, -20.0])), replaces=old.map_id)
    words = ["anchor", str(path), old.map_id, "--photos", str(photos), "--out", str(out), "--quiet"]
    image = old.images[4]
    truth = {p.name: p.cam_from_local for p in hill_photos()}[image.name]
    rng = np.random.default_rng(0)
    plan = truth.center[:2] + rng.uniform(-14, 14, (9, 2))
    points = np.column_stack([plan, hill_height(plan[:, 0], plan[:, 1])])
    pixels = CAMERA.project(truth.act(points)) + rng.normal(0, 1.0, (9, 2))
    pixels[5] += (-80.0, 60.0)
    utm = FRAME.utm_from_enu(points + OFFSET, EPSG)
    lines = [",".join(f"{v:.3f}" for v in (*px, *en)) for px, en in zip(pixels, utm, strict=True)]
    picks = tmp_path / "picks.csv"
    picks.write_text("x,y,easting,northing,height\n" + "\n".join(lines) + "\n")
    helped = [*words, "--picks", str(picks), "--image", image.name, "--frames", "1", "--auto"]
    assert main(helped) == 0
    assert "contradict the others: line 6" in capsys.readouterr().out
    metres, _, heights = errors(only_map(path))
    assert np.median(metres) < 0.3
    assert abs(np.median(heights)) < 0.1


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--photos", "missing"], "found no folder"),
        (["--photos", "."], "none of the 9 photos"),
        (["--scan", "nowhere"], "no scan nowhere"),
        (["--scan", ""], "expected a scan's id"),
        (["--auto", "--confirm", "photo_04.jpg"], "--auto or --confirm"),
        (["--frames", "0"], "--frames"),
        (["--image", "photo_04.jpg"], "give one of them"),
        (["--picks", "none.csv", "--image", "photo_04.jpg"], "cannot be read"),
    ],
)
def test_wrong_usage_is_told(
    hills: tuple[Path, Path, Path],
    extra: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photos, right, _ = hills
    monkeypatch.chdir(tmp_path)
    map_id = only_map(right).map_id
    assert main(["anchor", str(right), map_id, "--photos", str(photos), *extra]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_other_bytes_under_a_photos_name_are_not_used(
    hills: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos, right, _ = hills
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in photos.iterdir():
        (folder / path.name).write_bytes(path.read_bytes() + b"\0")
    map_id = only_map(right).map_id
    assert main(["anchor", str(right), map_id, "--photos", str(folder)]) == 2
    assert "SHA-256" in capsys.readouterr().err


def test_a_database_without_a_scan_says_how_to_add_one(
    hills: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    photos, right, _ = hills
    plain = right.parent / "plain"
    assert main(["anchor", str(plain), only_map(plain).map_id, "--photos", str(photos)]) == 2
    assert "featuredb lidar add" in capsys.readouterr().err
