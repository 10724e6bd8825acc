"""Run what README and docs claim, keep the figures by commit, and write them into the documentation.

    python -m tools.scoreboard [--full] [ROWS]      rows that have no result for this commit
    python -m tools.scoreboard --list               names, forms, minutes, newest result
    python -m tools.scoreboard --write              docs/measurements.md and README from what was measured

Exit code 0 if every row that has a result of this commit holds.
"""

import argparse
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tools.scoreboard.catalogue import ROWS
from tools.scoreboard.report import PAGE, README, page, readme_table, with_table
from tools.scoreboard.results import ROOT, Result, code_commit, newest, read_results, write_results
from tools.scoreboard.row import Row
from tools.scoreboard.run import Folders, run


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    signal.signal(signal.SIGTERM, _stopped)
    if args.list:
        return _list(newest(read_results()))
    commit = code_commit()
    if not args.write:
        _run_all(_chosen(args.rows, args.full), args, commit)
    results = newest(read_results())
    PAGE.write_text(page(ROWS, results), encoding="utf-8")
    readme = README.read_text(encoding="utf-8")
    README.write_text(with_table(readme, readme_table(ROWS, results)), encoding="utf-8")
    mine = [(row, results[row.name]) for row in ROWS if row.name in results]
    failed = [row.name for row, result in mine if result.commit == commit and not row.holds(result.figures)]
    sys.stdout.write(f"do not hold: {', '.join(failed)}\n" if failed else "")
    return 1 if failed else 0


def _stopped(signum: int, _: object) -> None:
    """Leave as Ctrl-C does: the row's processes end with this one, and its result is not kept."""
    raise SystemExit(128 + signum)


def _chosen(names: Sequence[str], full: bool) -> list[Row]:
    """The rows of these names, or all of the form."""
    if unknown := set(names) - {row.name for row in ROWS}:
        raise SystemExit(f"no such row: {', '.join(sorted(unknown))}; --list names them")
    return [row for row in ROWS if (row.name in names if names else full or row.form == "quick")]


def _run_all(rows: Sequence[Row], args: argparse.Namespace, commit: str) -> None:
    """Run what has no result yet; each result is kept at once, so that an interrupted run goes on."""
    places = Folders(data=args.data, work=args.work)
    places.work.mkdir(parents=True, exist_ok=True)
    for row in rows:
        known = next((r for r in read_results() if (r.row, r.commit) == (row.name, commit)), None)
        if known is not None and known.clean and not known.failure and not args.again:
            _tell(row, known, "known")
            continue
        if missing := places.missing(row):
            sys.stdout.write(f"{row.name}: skipped, {missing[0]} is not there (--data, FEATUREDB_DATA)\n")
            continue
        sys.stdout.write(f"{row.name}: about {row.minutes:g} minutes ...\n")
        sys.stdout.flush()
        result = run(row, places, commit)
        write_results([*read_results(), result])
        _tell(row, result, f"{result.seconds:.0f} s")


def _tell(row: Row, result: Result, when: str) -> None:
    if result.failure:
        text = f"FAILED, {result.failure}"
    else:
        text = f"{'holds' if row.holds(result.figures) else 'does NOT hold'}: {row.words(result.figures)}"
    sys.stdout.write(f"{row.name} ({when}): {text}\n")
    sys.stdout.flush()


def _list(results: dict[str, Result]) -> int:
    for row in ROWS:
        result = results.get(row.name)
        last = "never run" if result is None else f"{result.commit}, {result.date}"
        sys.stdout.write(f"{row.name:<28}{row.group:<11}{row.form:<7}{row.minutes:>5g} min  {last}\n")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="tools.scoreboard", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help="only these; default: all of the form")
    parser.add_argument("--full", action="store_true", help="rows that take long, too")
    parser.add_argument("--again", action="store_true", help="also those that have a result for this commit")
    parser.add_argument("--list", action="store_true", help="name the rows, run nothing")
    parser.add_argument("--write", action="store_true", help="write the documentation, run nothing")
    data = Path(os.environ.get("FEATUREDB_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of the real sets")
    work = Path(tempfile.gettempdir()) / "featuredb-scoreboard"
    parser.add_argument("--work", type=Path, default=work, help=f"default: {work}")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
