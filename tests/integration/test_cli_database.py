"""The command line: results on stdout, errors in one line on stderr, exit codes."""

import argparse
import csv
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import COMMAND_GROUP, build_parser, main, needed_for
from featuredb.errors import StoreError
from featuredb.lidar.add import add_scan
from featuredb.store import Database
from tests.support.command_line import only_command
from tests.support.las_files import grid_points, write_scan
from tests.support.maps import random_map

DATABASE_COMMANDS = EntryPoint("db", "featuredb.cli.database:register", COMMAND_GROUP)


@pytest.fixture(autouse=True)
def _only_database_commands(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with only_command(monkeypatch, "db", "featuredb.cli.database:register"):
        yield


@pytest.fixture
def db(tmp_path: Path) -> str:
    url = str(tmp_path / "maps.db")
    Database.create(url).commit_maps([random_map(1), random_map(2, parents=("map-1",)), random_map(3)])
    return url


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    code = main(argv)
    out, err = capsys.readouterr()
    return code, out, err


def test_init_is_idempotent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        code, out, _ = run(capsys, "init", str(tmp_path / "new.db"))
        assert code == 0
        assert out.endswith("version 0\n")


def test_maps_and_history(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "maps", db)
    assert code == 0
    lines = out.splitlines()
    assert lines[0].split()[:4] == ["map", "name", "status", "method"]
    assert [line.split()[0] for line in lines[2:-1]] == ["map-1", "map-2", "map-3"]
    bounds = Database.open(db).snapshot().place_bounds()["map-1"]
    column = lines[0].split().index("tilt_95_deg") - len(lines[0].split())
    assert lines[2].split()[column - 1] == str(round(bounds.tilt_deg, 2))  # "committed" has two words
    assert lines[-1].startswith("place_95_m, tilt_95_deg, heading_95_deg: 95 of 100 maps")
    code, out, _ = run(capsys, "maps", db, "--json", "--as-of", "0")
    assert json.loads(out)["maps"] == []
    code, out, _ = run(capsys, "history", db)
    assert [line.split()[3] for line in out.splitlines()[2:]] == ["commit", "init"]


def test_retire_and_rollback(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "retire", db, "map-1", "--reason", "wrong street")
    assert (code, out) == (0, "retired: map-1, map-2\n")
    assert len(run(capsys, "maps", db)[1].splitlines()) == 4
    assert len(run(capsys, "maps", db, "--all")[1].splitlines()) == 6
    assert run(capsys, "rollback", db, "1")[:2] == (0, "version 3\n")
    assert len(run(capsys, "maps", db)[1].splitlines()) == 6


def test_first_letters_of_a_map_or_scan_are_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = str(tmp_path / "maps.db")
    maps = [random_map(i, map_id=name) for i, name in enumerate(("abc", "abd", "b"))]
    database = Database.create(url)
    database.commit_maps([maps[0], replace(maps[1], parents=("abc",)), maps[2]])
    assert [line.split()[0] for line in run(capsys, "lineage", url, "abd")[1].splitlines()] == ["abc", "`-"]
    scan = add_scan(database, [write_scan(tmp_path / "a.las", grid_points(100))]).scan.scan_id
    assert run(capsys, "retire", url, scan[:6], "--reason", "wrong")[1] == f"retired: {scan}\n"
    code, _, err = run(capsys, "retire", url, "ab", "--reason", "wrong")
    assert (code, "ab: 2 maps and scans begin so (abc, abd)" in err) == (2, True)
    assert run(capsys, "retire", url, "abc", "--reason", "wrong")[1] == "retired: abc, abd\n"
    code, _, err = run(capsys, "retire", url, "x", "--reason", "wrong")
    assert (code, "no map or scan x" in err) == (2, True)


def test_sql_formats(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    query = "select map_id, points, created_at, tiles, null as nothing from maps order by map_id"
    rows = json.loads(run(capsys, "sql", db, query, "--format", "json")[1])
    assert [row["points"] for row in rows] == [60, 60, 60]
    assert rows[0]["nothing"] is None
    assert all(tile.startswith("E0") for tile in rows[0]["tiles"])
    text = run(capsys, "sql", db, query, "--format", "csv")[1]
    assert [row["map_id"] for row in csv.DictReader(io.StringIO(text))] == ["map-1", "map-2", "map-3"]
    table = run(capsys, "sql", db, "select 1.5 as x, 'ab' as name union all select 22.25, 'c' order by x")[1]
    assert table == "    x  name\n-----  ----\n 1.50  ab\n22.25  c\n"
    assert json.loads(run(capsys, "sql", db, "select 'nan'::float as x", "--format", "json")[1]) == [
        {"x": None}
    ]
    assert json.loads(run(capsys, "sql", db, "select 1 where false", "--format", "json")[1]) == []


def test_verify_compact_vacuum(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "verify", db)
    assert code == 0
    assert out.endswith("rows: sound\n")
    assert run(capsys, "compact", db)[0] == 0
    code, out, _ = run(capsys, "vacuum", db, "--file-grace-hours", "0", "--dry-run")
    assert out.startswith("would remove")
    code, out, _ = run(capsys, "vacuum", db, "--file-grace-hours", "0")
    assert code == 0
    assert json.loads(run(capsys, "verify", db, "--json")[1])["ok"] is True
    next(Path(db, "points").rglob("*.parquet")).unlink()
    code, out, _ = run(capsys, "verify", db)
    assert code == 1
    assert "PROBLEM points/" in out
    code, out, _ = run(capsys, "verify", db, "--json")
    assert code == 1
    assert json.loads(out)["problems"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["maps", "{tmp}/nowhere"], "featuredb init"),
        (["sql", "{db}", "drop table maps"], "read-only"),
        (["sql", "{db}", "select nonsense from maps"], "nonsense"),
        (["maps", "{db}", "--as-of", "77"], "expected a version from 0"),
        (["maps", "{db}", "--as-of", "1999-01-01"], "expected a version from 0"),
        (["retire", "{db}", "map-77", "--reason", "x"], "map-77"),
        (["maps", "{db}", "--storage-option", "novalue"], "KEY=VALUE"),
    ],
)
def test_errors_are_one_message_and_exit_2(
    db: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], message: str
) -> None:
    code, out, err = run(capsys, *(a.format(db=db, tmp=tmp_path) for a in argv))
    assert code == 2
    assert out == ""
    assert err.startswith("featuredb: ")
    assert message in err
    assert "Traceback" not in err


def test_debug_logs_the_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    assert run(capsys, "maps", str(tmp_path / "nowhere"), "--debug")[0] == 2
    assert "Traceback" in caplog.text


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["no-such-command"],
        ["maps"],
        ["maps", "db", "--as-of", "yesterday"],
        ["vacuum", "db", "--keep-history-hours=-1"],
    ],
)
def test_wrong_usage_is_exit_2(capsys: pytest.CaptureFixture[str], argv: list[str]) -> None:
    code, _, err = run(capsys, *argv)
    assert code == 2
    assert "usage: featuredb" in err


def test_help_is_exit_0(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert all(name in out for name in ("init", "maps", "sql", "verify", "vacuum"))


def test_a_defect_is_exit_70(
    db: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(Database, "history", lambda self: 1 // 0)
    assert run(capsys, "history", db)[0] == 70
    assert "ZeroDivisionError" in caplog.text


def test_a_broken_plugin_does_not_take_the_others_down(caplog: pytest.LogCaptureFixture) -> None:
    plugins = [
        EntryPoint("absent", "no_such_module_here:register", COMMAND_GROUP),
        EntryPoint("broken", f"{__name__}:broken_register", COMMAND_GROUP),
        DATABASE_COMMANDS,
    ]
    parser = build_parser(plugins)
    assert parser.parse_args(["maps", "db"]).db == "db"
    assert [record.args[0] for record in caplog.records if isinstance(record.args, tuple)] == [
        "absent",
        "broken",
    ]


def test_every_command_has_an_entry_point_of_its_name() -> None:
    installed = list(entry_points(group=COMMAND_GROUP))
    parser = build_parser(installed)
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    assert sorted(commands.choices) == sorted(entry.name for entry in installed)


def test_what_a_command_does_not_need_is_not_loaded() -> None:
    other = EntryPoint("view", "no_such_module_here:register", COMMAND_GROUP)
    one = EntryPoint("maps", "featuredb.cli.database:register", COMMAND_GROUP)
    assert needed_for(["maps", "my.db"], [other, one]) == [one]
    for argv in ([], ["--help"], ["gone", "maps"], ["-h", "maps"]):
        assert needed_for(argv, [other, one]) == [other, one]
    code = (
        "import sys; from featuredb.cli.main import main; main(['query', '--help']); "
        "sys.exit('featuredb.store' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0


def broken_register(subparsers: object) -> None:
    raise StoreError("no good")


def test_a_few_far_points_do_not_widen_the_radius_of_a_place(tmp_path: Path) -> None:
    """It is asked where the cameras are: of two maps that differ in one point 5 km away it is the same."""
    near = random_map(0, map_id="near")
    tilted = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 0.01, 0.01, 0.01])  # a turn about the vertical
    near = replace(near, placement=replace(near.placement, covariance=tilted))
    utm = near.points.utm.copy()
    utm[0] += [5000.0, 0.0, 0.0]
    far = replace(near, map_id="far", points=replace(near.points, utm=utm))
    database = Database.create(tmp_path / "db")
    database.commit_maps([near, far])
    snapshot = database.snapshot()
    bounds = snapshot.place_bounds()
    assert bounds["far"].horizontal_m == pytest.approx(bounds["near"].horizontal_m)
    centers = np.array([image.cam_from_local.center for image in near.images])
    middle = np.median(near.frame.utm_from_enu(centers, near.epsg), axis=0)
    expected = near.frame.enu_from_utm(middle, near.epsg)
    np.testing.assert_allclose(snapshot.camera_middles()["far"], expected, atol=1e-6)
    images = snapshot.images_of(["far", "near"])
    assert [image.name for image in images["far"]] == [image.name for image in far.images]
