"""The commands `lineage` and `candidates` on a database with a family of maps and an inbox."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.cli.main import main
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, list_candidates, mark_used, refuse
from tests.support.command_line import only_command
from tests.support.contributions import contribution
from tests.support.maps import random_map


@pytest.fixture(autouse=True)
def _only_database_commands(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with only_command(monkeypatch, "db", "featuredb.cli.database:register"):
        yield


def grown(seed: int, map_id: str, parents: tuple[str, ...], drift_m: float | None = None) -> FeatureMap:
    made = random_map(seed, map_id=map_id, parents=parents)
    if drift_m is None:
        return made
    evidence = {**made.placement.evidence, "growth": {"drift_m": drift_m, "budget_m": 0.5}}
    return replace(made, placement=replace(made.placement, evidence=evidence))


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Correspondences a and z; b on a, c on b, d on c and z; q in quarantine, r retired."""
    folder = tmp_path_factory.mktemp("family") / "town.db"
    database = Database.create(folder)
    database.commit_maps([random_map(1, map_id="a"), random_map(2, map_id="z")])
    database.commit_map(grown(3, "b", ("a",), 0.1))
    database.commit_map(grown(4, "c", ("b",), 0.312))
    database.commit_map(grown(5, "d", ("c", "z")))
    database.commit_maps([grown(6, "q", ("b",)), grown(7, "r", ("b",))])
    database.set_status(["q"], "quarantined", "one owner only")
    database.retire("r", "look-alike block")
    return folder


@pytest.fixture
def db(family: Path, tmp_path: Path) -> str:
    """A copy of the family."""
    return str(shutil.copytree(family, tmp_path / "town.db"))


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    code = main(list(argv))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_tree(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "lineage", db)
    assert code == 0
    assert out.splitlines() == [
        "a  random map 1; gps, generation 0; anchor",
        "`- b  random map 3; map, generation 1; 1 step from anchor a, 0.10 of 0.50 m",
        "   |- c  random map 4; map, generation 1; 2 steps from anchor a, 0.31 of 0.50 m",
        "   `- q  random map 6; map, generation 1; 2 steps from anchor a; quarantined: one owner only",
        "z  random map 2; gps, generation 0; anchor",
        "`- d  random map 5; map, generation 1; 1 step from anchor z; also from c",
    ]
    assert "look-alike" not in out
    assert "`- r  " in run(capsys, "lineage", db, "--all")[1]


def test_the_tree_of_one_map(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(capsys, "lineage", db, "r")[1].splitlines()
    assert [line.strip("`-| ").split()[0] for line in lines] == ["a", "b", "*"]
    assert lines[-1].endswith("retired: look-alike block")
    code, _, err = run(capsys, "lineage", db, "nothing")
    assert code == 2
    assert "no map nothing" in err


def test_lineage_as_json_and_as_of(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads(run(capsys, "lineage", db, "c", "--json")[1])
    assert [m["map_id"] for m in told["maps"]] == ["a", "b", "c", "d"]
    c = next(m for m in told["maps"] if m["map_id"] == "c")
    assert (c["steps"], c["anchors"], c["chain"]) == (2, ["a"], ["c", "b", "a"])
    assert (c["drift_m"], c["budget_m"], c["parents"]) == (0.312, 0.5, ["b"])
    assert len(json.loads(run(capsys, "lineage", db, "--json", "--as-of", "1")[1])["maps"]) == 2


def test_maps_show_their_drift(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    header, _, *rows = run(capsys, "maps", db)[1].splitlines()
    assert "drift_m" in header
    assert next(row for row in rows if row.startswith("c ")).split()[6:8] == ["1", "0.312"]


@pytest.fixture
def inbox(db: str) -> list[str]:
    database = Database.open(db)
    ids = contribute(
        database,
        [
            contribution(1),
            contribution(2, "Bob", minute=1),
            contribution(3, minute=2),
            contribution(1, "Bob", credit="Bob"),
        ],
    )[:3]
    mark_used(database, [ids[1]], "b")
    refuse(database, {ids[2]: ("BLUR", "too blurred to match")})
    return ids


def test_the_inbox(db: str, inbox: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "candidates", db)
    assert code == 0
    first, _, _, _, *rows = out.splitlines()
    assert first == "1 waiting, 1 used, 1 refused, 0 withdrawn"
    assert [row.split()[:2] for row in rows] == [
        [inbox[0][:12], "waiting"],
        [inbox[1][:12], "used"],
        [inbox[2][:12], "refused"],
    ]
    assert "also given by Bob" in rows[0]
    assert "used by b" in rows[1]
    assert "BLUR: too blurred to match" in rows[2]
    told = json.loads(run(capsys, "candidates", db, "--json", "--state", "used")[1])["candidates"]
    assert [c["candidate_id"] for c in told] == [inbox[1]]
    assert told[0]["contributors"][0]["owner"] == "Bob"
    assert told[0]["request"]["prior"]["sigma_m"] == 20.0
    assert told[0]["contributors"][0]["credit"] == "A. Person"
    for who in ("--owner", "--credit"):
        theirs = json.loads(run(capsys, "candidates", db, "--json", who, "Bob")[1])["candidates"]
        assert [c["candidate_id"] for c in theirs] == (inbox[:2] if who == "--owner" else inbox[:1])


def test_an_empty_inbox(db: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "candidates", db)[:2] == (0, "0 waiting, 0 used, 0 refused, 0 withdrawn\n")
    assert run(capsys, "candidates", db, "--json")[1] == '{\n  "candidates": []\n}\n'


def test_withdrawal(db: str, inbox: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "candidates", db, "--withdraw-owner", "Bob", "--reason", "asked by mail")
    assert code == 0
    assert out.startswith("withdrawn: 2 photos, 1 files deleted\nmaps b were built with them")
    states = {c.candidate_id: c.state for c in list_candidates(Database.open(db))}
    assert states == {inbox[0]: "withdrawn", inbox[1]: "withdrawn", inbox[2]: "refused"}
    assert run(capsys, "candidates", db, "--withdraw", inbox[2][:10], "--reason", "again")[0] == 0
    assert not list(Path(db, "candidate_images").glob("*.parquet"))
    assert run(capsys, "verify", db)[0] == 0


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--withdraw", "0123456789", "--reason", "x"], "0 photos begin with"),
        (["--withdraw", "0", "--reason", "x"], "at least 8 digits"),
        (["--withdraw-owner", "Nobody", "--reason", "x"], "no photo of owner 'Nobody'"),
        (["--withdraw-credit", "Nobody", "--reason", "x"], "no photo of credit 'Nobody'"),
        (["--withdraw-owner", "Bob", "--withdraw-credit", "B.", "--reason", "x"], "'Bob' and credit 'B.'"),
        (["--withdraw-owner", "Bob"], "expected --reason"),
    ],
)
def test_withdrawals_that_are_refused(
    db: str, inbox: list[str], capsys: pytest.CaptureFixture[str], argv: list[str], message: str
) -> None:
    code, _, err = run(capsys, "candidates", db, *argv)
    assert code == 2
    assert message in err
    assert "withdrawn" not in {c.state for c in list_candidates(Database.open(db))}
