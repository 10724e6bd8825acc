"""The scoreboard's tables: `docs/measurements.md`, and the rows that README shows."""

from collections.abc import Mapping, Sequence

from tools.scoreboard.results import ROOT, Result
from tools.scoreboard.row import Figures, Row

PAGE = ROOT / "docs" / "measurements.md"
README = ROOT / "README.md"
BEGIN, END = "<!-- measured: written by tools.scoreboard -->", "<!-- end of measured -->"
MOST_IN_README = 4
_TITLES = {
    "real": "Real photos, films and scans",
    "simulated": "The simulated town",
    "speed": "Speed and memory",
}
_HEAD = """# Measurements

Written by `python -m tools.scoreboard --full`; do not edit. A row is a claim of this documentation,
with the command that measures it. Rows that were never run have no figure. All results by commit:
`docs/measurements.jsonl`.
"""


def page(rows: Sequence[Row], results: Mapping[str, Result]) -> str:
    """The page of all rows, by group, with each one's newest result."""
    parts = [_HEAD]
    for group, title in _TITLES.items():
        parts.append(f"## {title}\n")
        parts.append("| row | what | figure | limit | holds | form | commit, date | minutes |")
        parts.append("|---|---|---|---|---|---|---|---|")
        parts += [_line(row, results.get(row.name)) for row in rows if row.group == group]
        parts.append("")
    parts.append("## Commands\n")
    parts.append("`{data}` is the folder of the real sets, `{work}` and `{cache}` are folders for work.\n")
    for row in rows:
        lines = [f"`python -m {line}`" for line in row.commands.splitlines()]
        parts.append(f"- **{row.name}**: {', '.join(lines)}")
    return "\n".join(parts).rstrip() + "\n"


def readme_table(rows: Sequence[Row], results: Mapping[str, Result]) -> str:
    """README's table: rows that are meant for it and were measured."""
    shown = [row for row in rows if row.readme and row.name in results and not results[row.name].failure]
    if not shown:
        return "Nothing was measured yet."
    lines = ["| what | figure | holds |", "|---|---|---|"]
    for row in shown[:MOST_IN_README]:
        figures = results[row.name].figures
        lines.append(f"| {row.claim} | {row.words(figures)} | {_yes(row, figures)} |")
    return "\n".join(lines)


def with_table(readme: str, table: str) -> str:
    """README's text with the table between its markers.

    Raises:
        SystemExit: the markers are not there.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise SystemExit(f"README.md: expected the lines {BEGIN} and {END}, found no such pair")
    return f"{before}{BEGIN}\n\n{table}\n\n{END}{after}"


def _line(row: Row, result: Result | None) -> str:
    if result is None:
        cells = ["not run", row.limits, "-", row.form, "", f"about {row.minutes:g}"]
    elif result.failure:
        failure = result.failure.replace("|", "/").replace("`", "'").replace("<", "(").replace(">", ")")
        cells = [f"FAILED: {failure}", row.limits, "no", row.form, f"{result.commit}, {result.date}", "-"]
    else:
        cells = [row.words(result.figures), row.limits, _yes(row, result.figures), row.form]
        cells += [f"{result.commit}, {result.date}", f"{result.seconds / 60:.1f}"]
    return f"| {row.name} | {row.claim} | {' | '.join(cells)} |"


def _yes(row: Row, figures: Figures) -> str:
    """Whether it holds; if not, which limit is missed and by what figure."""
    missed = row.missed(figures)
    return f"**no**: {missed}" if missed else "yes"
