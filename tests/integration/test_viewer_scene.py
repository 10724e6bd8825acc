"""Databases of every kind become scenes and files; the command says what is wrong with what it is told."""

import json
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import COMMAND_GROUP, main
from featuredb.export.selection import Selection
from featuredb.lidar.add import add_scan
from featuredb.store import Database
from reloc.listening import listen
from reloc.tracking.trajectory.files import read_trajectory_csv, write_trajectory
from reloc.viewer.page import write_static_page
from reloc.viewer.photos import Pictures
from reloc.viewer.scene import ViewerScene, ViewerSceneOptions, build_scene
from reloc.viewer.server import HOST
from tests.support.datasets import varied_database, varied_maps
from tests.support.las_files import grid_points, write_scan
from tests.support.maps import random_map
from tests.support.planar_map import planar_map
from tests.support.viewer import track_over

COMMAND = EntryPoint("view", "reloc.cli.view:register", COMMAND_GROUP)
BESIDE = np.array([400.0, 0.0, 0.0])


@pytest.fixture(autouse=True)
def _only_this_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("featuredb.cli.main.entry_points", lambda group: [COMMAND])


@pytest.fixture(scope="module")
def varied(tmp_path_factory: pytest.TempPathFactory) -> Database:
    return varied_database(tmp_path_factory.mktemp("varied") / "maps.db")


def scene_of(database: Database, **options: object) -> ViewerScene:
    return build_scene(database, database.snapshot(), options=ViewerSceneOptions(**options))  # type: ignore[arg-type]


def maps_of(scene: ViewerScene) -> dict[str, dict[str, object]]:
    return {m["id"]: m for place in scene.document["places"] for m in place["maps"]}


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    code = main(argv)
    out, err = capsys.readouterr()
    return code, out, err


def test_maps_of_the_whole_earth_are_in_places_of_their_own(varied: Database) -> None:
    scene = scene_of(varied)
    json.dumps(scene.document, allow_nan=False)  # what the page is sent
    found = [sorted(m["id"] for m in place["maps"]) for place in scene.document["places"]]
    assert sorted(map(len, found)) == [1, 1, 1, 7]
    assert ["fiji"] in found
    every = {m.map_id: m for m in varied_maps()}
    for place, frame in zip(scene.document["places"], scene.frames, strict=True):
        for told in place["maps"]:
            if told["id"] not in every:
                continue
            made = every[told["id"]]
            assert told["points"] == told["buffer"]["count"] == len(made.points)
            for photo, image in zip(told["photos"], made.images, strict=True):
                # The frame of a place is as good as the map's own.
                wanted = frame.enu_from(made.frame).act(image.cam_from_local.center)
                np.testing.assert_allclose(photo["center"], wanted, atol=1e-3)
                assert np.linalg.norm(photo["center"]) < 20_000


def test_status_generation_and_lineage_are_those_of_the_store(varied: Database) -> None:
    told = maps_of(scene_of(varied))
    assert told["old"]["status"] == "retired"
    assert told["old"]["status_reason"] == "a better one is there"
    assert told["poses-only"]["status"] == "quarantined"
    assert told["child"]["under"] == "karlsruhe"
    assert told["grandchild"]["parents"] == ["child", "karlsruhe"]
    assert told["karlsruhe"]["under"] is None
    assert (told["karlsruhe"]["generation"], told["child"]["generation"]) == (0, 1)


def test_the_limit_of_points_holds_in_each_place(varied: Database) -> None:
    for limit in (0, 1, 50):
        scene = scene_of(varied, points=limit)
        for place, data in zip(scene.document["places"], scene.points, strict=True):
            counts = [layer["buffer"]["count"] for layer in place["maps"] + place["scans"]]
            assert sum(counts) <= limit
            assert sum(counts) > limit - len(counts) or limit == 0
            assert len(data) >= 15 * sum(counts)
    first, again = (scene_of(varied, points=70).points for _ in range(2))
    assert first == again


def test_a_part_of_the_maps_can_be_shown_and_an_earlier_version(varied: Database) -> None:
    assert set(maps_of(scene_of(varied, selection=Selection(maps=("fiji",))))) == {"fiji"}
    only = scene_of(varied, selection=Selection(statuses=("retired",)))
    assert set(maps_of(only)) == {"old"}
    early = build_scene(varied, varied.snapshot(3))
    assert set(maps_of(early)) == {m.map_id for m in varied_maps()[:3]}
    assert early.document["snapshot"] == 3


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Database:
    """Two scans beside each other, one grey and one with colours; no maps."""
    folder = tmp_path_factory.mktemp("scanned")
    database = Database.create(folder / "maps.db")
    xyz = grid_points(3000)
    grey = write_scan(folder / "grey.las", xyz, intensity=np.arange(3000, dtype=np.uint16))
    add_scan(database, [grey], name="grey", licence="CC0-1.0")
    values = {"red": 200, "green": 60, "blue": 40}
    colours = {name: np.full(2000, v * 257, np.uint16) for name, v in values.items()}
    coloured = write_scan(folder / "coloured.las", grid_points(2000, seed=1) + BESIDE, **colours)
    add_scan(database, [coloured], name="coloured", licence="secret")
    return database


def points_of(scene: ViewerScene, buffer: dict[str, object]) -> tuple[np.ndarray, np.ndarray]:
    n, start = int(buffer["count"]), int(buffer["offset"])  # type: ignore[call-overload]
    data = scene.points[0]
    xyz = np.frombuffer(data, "<f4", 3 * n, start).reshape(n, 3).astype(np.float64) + buffer["origin"]
    return xyz, np.frombuffer(data, np.uint8, 3 * n, start + 12 * n).reshape(n, 3)


def test_scans_are_shown_with_their_colours(scanned: Database) -> None:
    scene = scene_of(scanned)
    (place,) = scene.document["places"]
    told = {scan["name"]: scan for scan in place["scans"]}
    xyz, rgb = points_of(scene, told["coloured"]["buffer"])
    assert len(xyz) == told["coloured"]["points_here"] == told["coloured"]["points"]
    assert (np.abs(rgb.astype(int) - [200, 60, 40]) <= 1).all()
    wanted = scene.frames[0].enu_from_utm(grid_points(2000, seed=1) + BESIDE, 32632)
    np.testing.assert_allclose(
        np.sort(xyz, axis=0), np.sort(wanted, axis=0), atol=0.002
    )  # LAS has millimetres
    grey = points_of(scene, told["grey"]["buffer"])[1]
    assert (grey[:, 0] == grey[:, 1]).all()
    assert np.ptp(grey[:, 0]) > 200  # the intensities, stretched


def test_a_limited_scan_is_even(scanned: Database) -> None:
    scene = scene_of(scanned, points=600)
    (place,) = scene.document["places"]
    counts = {scan["name"]: scan["buffer"]["count"] for scan in place["scans"]}
    assert 590 <= sum(counts.values()) <= 600
    grey = next(s for s in place["scans"] if s["name"] == "grey")
    xyz, _ = points_of(scene, grey["buffer"])
    cells, per_cell = np.unique(np.floor(xyz[:, :2] / 9.0), axis=0, return_counts=True)
    assert len(cells) >= 9
    assert np.median(per_cell) > 5


def test_a_licence_leaves_other_photos_and_scans_out_of_the_file(tmp_path: Path, scanned: Database) -> None:
    free = scene_of(scanned, selection=Selection(licences=("cc0",)))
    assert [scan["name"] for place in free.document["places"] for scan in place["scans"]] == ["grey"]
    made = random_map(1)
    images = tuple(
        replace(i, owner="Mallory", licence="secret", name=f"hidden-{i.image_id}.jpg") if i.image_id else i
        for i in made.images
    )
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(replace(made, images=images))
    hidden = random_map(2, map_id="all-hidden")
    owned = tuple(replace(image, owner="Mallory", licence="secret") for image in hidden.images)
    database.commit_map(replace(hidden, images=owned))
    scene = scene_of(database, selection=Selection(licences=("cc-by",)))
    write_static_page(tmp_path / "sent.html", scene, Pictures(None))
    text = (tmp_path / "sent.html").read_text(encoding="utf-8")
    assert images[0].name in text
    for secret in ("Mallory", "hidden-", "all-hidden"):
        assert secret not in text
    assert set(maps_of(scene)) == {made.map_id}


def test_a_file_is_whole_or_not_there(
    tmp_path: Path, varied: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(varied)
    out = tmp_path / "sent.html"
    with monkeypatch.context() as patched:
        patched.setattr("reloc.viewer.page.page_in_one", lambda values: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write_static_page(out, scene, Pictures(None))
    assert list(tmp_path.iterdir()) == []
    assert write_static_page(out, scene, Pictures(None)) == out.stat().st_size


def test_the_command_writes_a_file_without_the_extra(
    tmp_path: Path, varied: Database, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("fastapi", "uvicorn"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "reloc.viewer.server", raising=False)
    out = tmp_path / "sent.html"
    code, told, _ = run(capsys, "view", varied.url, "--static", str(out))
    assert code == 0
    assert f"{out}: " in told
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")
    code, _, err = run(capsys, "view", varied.url, "--static", str(out))
    assert (code, "nothing is overwritten" in err) == (2, True)
    code, _, err = run(capsys, "view", varied.url, "--no-browser")
    assert (code, "pip install 'featuredb[http]'" in err) == (2, True)


def test_a_taken_port_is_told_before_the_scene_is_built(
    varied: Database, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reloc.viewer.scene.build_scene", lambda *given: 1 / 0)
    with listen(HOST, 0) as bound:
        port = bound.getsockname()[1]
        code, _, err = run(capsys, "view", varied.url, "--no-browser", "--port", str(port))
    assert (code, f"cannot listen on {HOST}:{port}: " in err) == (2, True), err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["NONE"], "no featuredb table"),
        (["DB", "--maps", "nowhere"], "no map nowhere"),
        (["DB", "--maps", "fiji", "--status", "active"], "leave out --status"),
        (["DB", "--points", "-1"], "from 0 on"),
        (["DB", "--port", "70000"], "--port"),
        (["DB", "--as-of", "99"], "99"),
        (["DB", "--photos", "NONE"], "--photos"),
        (["DB", "--trajectory", "NONE"], "cannot be read"),
        (["DB", "--static", "NONE/out.html"], "make it first"),
    ],
)
def test_what_cannot_be_is_said(
    tmp_path: Path, varied: Database, capsys: pytest.CaptureFixture[str], argv: list[str], said: str
) -> None:
    asked = [a.replace("DB", varied.url).replace("NONE", str(tmp_path / "none")) for a in argv]
    code, _, err = run(capsys, "view", *asked, "--no-browser")
    assert code == 2
    assert said in err


def test_a_port_in_use_is_said(varied: Database, capsys: pytest.CaptureFixture[str]) -> None:
    with listen(HOST, 0) as bound:
        port = str(bound.getsockname()[1])
        code, _, err = run(capsys, "view", varied.url, "--maps", "fiji", "--port", port, "--no-browser")
    assert code == 2
    assert f"127.0.0.1:{port}" in err


def test_a_track_is_a_place_where_no_map_is(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "empty.db")
    track = track_over(planar_map(1))
    write_trajectory(tmp_path / "t.csv", track)
    scene = build_scene(database, database.snapshot(), [read_trajectory_csv(tmp_path / "t.csv")])
    (place,) = scene.document["places"]
    assert (place["maps"], place["scans"], place["epsg"]) == ([], [], 32632)
    frames = place["trajectories"][0]["frames"]
    steps = [f["pose"]["center"][0] for f in frames if f["pose"]]
    assert steps[-1] - steps[0] == pytest.approx(40.0, abs=0.01)
    tilt = np.radians(15.0)
    np.testing.assert_allclose(frames[0]["pose"]["forward"], [np.sin(tilt), 0, -np.cos(tilt)], atol=1e-4)
    assert frames[0]["pose"]["ellipse"]["azimuth_deg"] == pytest.approx(
        0.0, abs=0.1
    )  # 0.2 m north, 0.1 m east
    assert frames[0]["pose"]["ellipse"]["major_m"] == pytest.approx(0.2 * 2.4477, rel=1e-3)
    lost = replace(track, points=tuple(replace(p, pose=None, state="lost") for p in track.points))
    write_trajectory(tmp_path / "lost.csv", lost)
    assert main(["view", database.url, "--trajectory", str(tmp_path / "lost.csv"), "--no-browser"]) == 2
