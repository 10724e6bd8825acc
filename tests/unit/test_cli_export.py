"""`featuredb export`: what it takes, what it says, how it ends."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from featuredb.cli.main import main
from featuredb.store import Database
from tests.support.command_line import only_command
from tests.support.maps import random_map


@pytest.fixture(autouse=True)
def _only_this_command(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with only_command(monkeypatch, "export", "featuredb.cli.export:register"):
        yield


@pytest.fixture
def db(tmp_path: Path) -> str:
    database = Database.create(tmp_path / "maps.db")
    database.commit_maps([random_map(1), random_map(2)])
    database.set_status(["map-2"], "quarantined", "test")
    return str(tmp_path / "maps.db")


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    code = main(argv)
    out, err = capsys.readouterr()
    return code, out, err


def test_active_maps_go_out_and_a_line_says_so(
    db: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code, said, err = run(capsys, "export", db, str(out), "--format", "colmap")
    assert (code, err) == (0, "")
    assert said.startswith(f"{out}: colmap, 1 maps, 4 images, 60 points, 200 observations, ")
    assert [p.name for p in out.iterdir()] == ["map-1"]


def test_selection_and_json(db: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = ("--status", "active,quarantined")
    for number, (argv, maps) in enumerate(
        [
            (both, ["map-1", "map-2"]),
            (("--maps", "map-2"), ["map-2"]),
            ((*both, "--where", "map_id = 'map-2'"), ["map-2"]),
            ((*both, "--bbox", "8,48,9,50"), ["map-1", "map-2"]),
            (("--as-of", "1"), ["map-1", "map-2"]),
        ]
    ):
        out = tmp_path / f"out{number}"
        code, said, err = run(capsys, "export", db, str(out), "--format", "colmap", "--json", *argv)
        assert (code, err) == (0, "")
        assert json.loads(said)["maps"] == len(maps)
        assert json.loads(said)["bytes"] == sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
        assert sorted(p.name for p in out.iterdir()) == maps


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--bbox", "-122.5,37,-122"), "expected four numbers of degrees"),
        (("--bbox", "-122.5,37,-122,38"), "expected maps in -122.5,37,-122,38"),
        (("--bbox", "1,9,2,8"), "south < north"),
        (("--status", "gone"), "expected names of quarantined, active, retired, unplaced, found 'gone'"),
        (("--maps", "map-9"), "map-9"),
        (("--maps", "map-1", "--status", "active"), "leave out --status"),
        (("--licence", "cc0,"), "licences: expected names"),
        (("--licence", "gpl"), "found none in the selected maps"),
        (("--where", "bogus > 1"), "bogus"),
        (("--format", "obj"), "invalid choice: 'obj'"),
    ],
)
def test_what_cannot_be_is_said_and_nothing_is_written(
    db: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "here" / "out"
    out.parent.mkdir()
    code, said, err = run(capsys, "export", db, str(out), "--format", "colmap", *argv)
    assert (code, said) == (2, "")
    assert message in err
    assert list(out.parent.iterdir()) == []


def test_nothing_is_overwritten(db: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("mine")
    code, _, err = run(capsys, "export", db, str(tmp_path / "out"), "--format", "colmap")
    assert code == 2
    assert "nothing is overwritten" in err
    assert (tmp_path / "out").read_text() == "mine"
