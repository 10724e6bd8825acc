"""The scoreboard: rows, limits, results by commit, and that the documentation says what was measured."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.errors import InvalidValueError
from tools.scoreboard.catalogue import ROWS
from tools.scoreboard.report import MOST_IN_README, PAGE, README, page, readme_table, with_table
from tools.scoreboard.results import Result, newest, read_results, write_results
from tools.scoreboard.row import Limit, Row
from tools.scoreboard.run import Folders, run

_TOOL = "import json, pathlib, sys; pathlib.Path(sys.argv[1]).write_text(json.dumps({'a': {'m': 0.25}}))"
_ARGV = "['', '{work}/figures.json', '{data}/set']"
# Rows that are no longer run; what was measured of them stays.
_GONE = {"bridge-latency", "film-map"}


def row(text: str = "{m:.2f} m in {seconds:.0f} s", limit: float = 0.3, code: str = _TOOL) -> Row:
    return Row(
        name="tiny",
        group="real",
        form="quick",
        claim="a claim",
        commands=shlex.join(("timeit", "-n1", "-r1", f"import sys; sys.argv = {_ARGV}; {code}")),
        figures="m=a_m",
        text=text,
        limits=f"m <= {limit}",
    )


def result(commit: str, m: float, failure: str = "") -> Result:
    figures = {} if failure else {"m": m, "seconds": 1.0}
    return Result(
        *(), row="tiny", commit=commit, date="2026-01-02", figures=figures, seconds=60.0, cores=2,
        python="3.11.9", failure=failure,
    )  # fmt: skip


def test_a_row_is_run_and_its_figures_read(tmp_path: Path) -> None:
    places = Folders(data=tmp_path, work=tmp_path / "work")
    assert places.missing(row()) == [tmp_path / "set"]
    places.work.mkdir()
    code = _TOOL.replace("{", "{{").replace("}", "}}")
    found = run(row(code=code), places, "abc")
    assert (found.failure, found.figures["m"], found.commit) == ("", 0.25, "abc")
    assert row().holds(found.figures)
    assert not row(limit=0.2).holds(found.figures)
    failed = run(row(code="import os; os._exit(3)"), places, "abc")
    assert failed.failure.startswith("exit code 3")
    assert not row().holds(failed.figures)
    assert run(row(code="pass"), places, "abc").failure.startswith("no figures were written")


def test_a_stopped_row_goes_on_where_it_was_at_the_same_commit_alone(tmp_path: Path) -> None:
    places = Folders(data=tmp_path, work=tmp_path)
    code = "import os; print(os.listdir(os.path.dirname(sys.argv[1]))); os._exit(3)"
    for resumes, commit, kept in ((True, "abc", True), (True, "abc+", False), (False, "abc", False)):
        folder = tmp_path / "tiny" / commit
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "half-done").touch()
        failed = run(replace(row(code=code), resumes=resumes), places, commit).failure
        assert ("half-done" in failed) == kept


def test_results_are_kept_by_row_and_commit(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    write_results([result("a", 1.0), result("b", 2.0), result("c+", 3.0), result("d+", 4.0)], file)
    write_results([*read_results(file), result("a", 5.0)], file)
    kept = read_results(file)
    assert [(r.commit, r.figures["m"]) for r in kept] == [("b", 2.0), ("d+", 4.0), ("a", 5.0)]
    assert newest(kept)["tiny"].figures["m"] == 5.0
    assert read_results(tmp_path / "none.jsonl") == []


def test_the_page_tells_what_holds_what_failed_and_what_was_not_run() -> None:
    assert "| 0.25 m in 1 s | m <= 0.3 | yes | quick | a, 2026-01-02 | 1.0 |" in page(
        [row()], {"tiny": result("a", 0.25)}
    )
    assert "| 0.35 m in 1 s | m <= 0.3 | **no**: m <= 0.3 (it is 0.35) |" in page(
        [row()], {"tiny": result("a", 0.35)}
    )
    assert "FAILED: exit code 3: a/b" in page([row()], {"tiny": result("a", 0.0, "exit code 3: a|b")})
    assert "| not run | m <= 0.3 | - |" in page([row()], {})
    with pytest.raises(SystemExit, match="found no such pair"):
        with_table("no markers", "table")


def test_a_row_that_cannot_be_judged_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="expected a command and a limit"):
        replace(row(), limits="")
    assert row(text="{gone} m").words({}) == "- m"
    for text in ("m", "m < 3", "3", "m <= x", "1 <= m,2 <= n"):
        with pytest.raises(InvalidValueError, match="expected one as `14 <= photos`"):
            replace(row(), limits=f"1 <= k, {text}")


def test_a_limit_is_what_its_text_says() -> None:
    assert [Limit.of("0.5 <= m <= 2").holds({"m": m}) for m in (0.4, 0.5, 2, 2.1)] == [
        False,
        True,
        True,
        False,
    ]
    assert [Limit.of("m = -1").holds({"m": m}) for m in (-1, 0)] == [True, False]
    assert [Limit.of("0 <= m").holds({"m": m}) for m in (-1, 0, 1e9)] == [False, True, True]
    assert not any(Limit.of("0 <= m").holds(figures) for figures in ({"m": None}, {"m": "1"}, {}))


def test_rows_have_names_of_their_own_and_real_sets_are_not_outnumbered() -> None:
    names = [r.name for r in ROWS]
    assert len(set(names)) == len(names)
    groups = [r.group for r in ROWS]
    assert groups.count("real") >= groups.count("simulated")
    assert sum(r.minutes for r in ROWS if r.form == "quick") <= 20
    assert 0 < sum(r.readme for r in ROWS) <= MOST_IN_README


def test_every_result_is_of_a_row() -> None:
    assert {r.row for r in read_results()} <= {r.name for r in ROWS} | _GONE
    assert not _GONE & {r.name for r in ROWS}
    assert all(json.dumps(r.figures) for r in read_results())


def test_the_documentation_says_what_was_measured() -> None:
    results = newest(read_results())
    assert PAGE.read_text(encoding="utf-8") == page(ROWS, results)
    readme = README.read_text(encoding="utf-8")
    assert readme == with_table(readme, readme_table(ROWS, results)), "run python -m tools.scoreboard --write"
