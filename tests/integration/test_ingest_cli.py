"""`featuredb ingest photos` as typed: arguments, what is printed, exit codes, the report."""

import argparse
import json
from pathlib import Path

import jsonschema
import pytest

from featuredb.cli.main import main, run_command
from featuredb.store import Database
from ingest.cli.ingest import register
from tests.conftest import REPOSITORY
from tests.support.hill_photos import write_hill_photos


def _run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers(required=True))
    parsed = parser.parse_args(["ingest", "photos", *map(str, arguments), "--workers", "1"])
    return run_command(parsed.run, parsed)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_hill_photos(folder, columns=2, rows=2)
    (folder / "notes.txt").write_text("no photo")
    return folder


def test_a_map_is_made_and_told_of(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    database, report = tmp_path / "db", tmp_path / "report"
    arguments = (
        "--exclude", "*_03.jpg", "--gps-sigma", "0.1,0.2", "--max-features", "800", "--height-datum",
        "ellipsoidal", "--owner", "Ada", "--licence", "CC-BY-4.0", "--name", "hills", "--cameras",
        "per-image", "--min-track-length", "2",
    )  # fmt: skip
    code = _run(database, photos, *arguments, "--report", report)
    assert code == 0
    out = capsys.readouterr().out
    assert "3 of 5 files registered, 0 in maps without a place, 0 not, 2 skipped" in out
    assert "photo_03.jpg: excluded" in out
    snapshot = Database.open(database).snapshot()
    (summary,) = snapshot.maps()
    feature_map = snapshot.load_map(summary.map_id)
    assert (feature_map.name, feature_map.height_datum, feature_map.licence) == (
        "hills",
        "ellipsoidal",
        "CC-BY-4.0",
    )
    assert {(i.owner, i.licence) for i in feature_map.images} == {("Ada", "CC-BY-4.0")}
    assert {i.gps.sigma_vertical_m for i in feature_map.images if i.gps} == {0.2}
    assert len(feature_map.cameras) == 3
    assert feature_map.observations.has_descriptor.all()
    document = json.loads((report / "report.json").read_text())
    schema = json.loads((REPOSITORY / "schemas" / "ingest" / "report.json").read_text())
    jsonschema.validate(document, schema)
    assert document["files"] == {
        "all": 5,
        "registered": 3,
        "unplaced": 0,
        "not_registered": 0,
        "skipped": 2,
    }
    assert (report / "report.html").stat().st_size > 1000
    # Once more: nothing new, and still a success.
    assert _run(database, photos, *arguments) == 0
    assert "already there" in capsys.readouterr().out
    assert len(Database.open(database).snapshot().maps()) == 1


def test_photos_that_cannot_be_placed_are_kept_and_it_says_how_to_place_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hill_photos(tmp_path / "photos", columns=2, rows=2, with_gps=False)
    assert _run(tmp_path / "db", tmp_path / "photos", "--max-features", "800") == 0
    out = capsys.readouterr().out
    assert "without a place, 4 photos" in out
    assert "TOO_FEW" in out
    assert main(["maps", str(tmp_path / "db")]) == 0
    assert "--page" in capsys.readouterr().out


def test_a_folder_without_photos_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    assert _run(tmp_path / "db", tmp_path / "photos") == 2
    assert "expected photos" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["--gps-sigma", "-1"],
        ["--gps-sigma", "1,2,3"],
        ["--gps-sigma", "near"],
        ["--cameras", "some"],
        ["--stop-after", "lunch"],
    ],
)
def test_wrong_arguments_are_usage_errors(arguments: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        _run(tmp_path / "db", tmp_path, *arguments)
    assert stopped.value.code == 2


def test_an_unknown_datum_is_refused_before_anything_is_done(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(tmp_path / "db", photos, "--height-datum", "sea") == 2
    assert "egm96" in capsys.readouterr().err
    assert not (tmp_path / "db").exists()
