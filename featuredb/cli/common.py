"""What subcommands share: the database argument and plain tables for people."""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from featuredb.errors import InvalidValueError
from featuredb.plain_json import plain

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from featuredb.store import Database

LONGEST_CELL = 72  # a wider cell makes a table unreadable; csv and json give everything


def add_database_argument(
    parser: argparse.ArgumentParser,
    metavar: str = "DB",
    help: str = "folder or URL of the database, e.g. maps.db, s3://bucket/maps",
) -> None:
    """Add the positional DB and the options to reach it."""
    parser.add_argument("db", metavar=metavar, help=help)
    parser.add_argument(
        "--storage-option",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="option of the object store, e.g. AWS_ENDPOINT_URL=...; may be repeated",
    )


def add_command(
    subparsers: Any,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    text: str,
    *,
    description: str | None = None,
    **more: Any,
) -> argparse.ArgumentParser:
    """Add a subcommand on a database; `description` is `text` where none is given, `more` is argparse's."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name, help=text, description=description or text, **more
    )
    add_database_argument(parser)
    parser.set_defaults(run=run)
    return parser


def storage_options(args: argparse.Namespace) -> dict[str, str]:
    """The --storage-option values.

    Raises:
        InvalidValueError: one is not KEY=VALUE.
    """
    options = {}
    for text in args.storage_option:
        key, separator, value = text.partition("=")
        if not separator or not key:
            raise InvalidValueError(f"--storage-option: expected KEY=VALUE, found {text!r}")
        options[key] = value
    return options


def open_database(args: argparse.Namespace) -> "Database":
    """The existing database that the arguments name."""
    from featuredb.store import Database  # seconds; many commands need no store

    return Database.open(args.db, storage_options=storage_options(args))


def place_for_database(args: argparse.Namespace) -> "Database":
    """The database that the arguments name, which a command makes later where there is none.

    Raises:
        StoreError: there is no place for it, as where the path is mistyped.
    """
    from featuredb.store import Database
    from featuredb.store.durable.making import check_place

    database = Database(args.db, storage_options(args))
    check_place(database.url)
    return database


def version_or_time(text: str) -> int | datetime:
    """A snapshot given by number, or by an ISO 8601 time (UTC where it names no zone)."""
    if text.isdigit():
        return int(text)
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"expected a version number or a time such as 2026-05-01T12:00, found {text!r}"
        ) from error
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def add_as_of_argument(parser: argparse.ArgumentParser) -> None:
    """Add --as-of, an earlier version to look at."""
    parser.add_argument(
        "--as-of",
        type=version_or_time,
        metavar="VERSION",
        help="an earlier version, by number or ISO 8601 time (UTC unless it says otherwise)",
    )


def numbers(text: str, what: str, *counts: int) -> tuple[float, ...]:
    """Numbers with commas between them, as many as one of `counts`; for `type` of an argument.

    Args:
        what: is expected, for the message.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts:
        raise argparse.ArgumentTypeError(f"expected {what}, found {text!r}")
    return values


def hours(text: str) -> float:
    """A number of hours, >= 0."""
    try:
        value = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a number of hours, found {text!r}") from error
    if not 0 <= value < 1e6:
        raise argparse.ArgumentTypeError(f"expected 0 <= hours < 1000000, found {text}")
    return value


def progress_of_maps() -> Callable[[int, int], None]:
    """Says on stderr how many maps are done, where a person looks on."""

    def told(done: int, total: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{done} of {total} maps", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return told


def count_bars() -> "Progress":
    """Bars on stderr that count, with the time gone and the time left; to be used in a `with` block."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


def drawn(bars: "Progress", titles: Mapping[str, str]) -> Callable[[str, int, int], None]:
    """A callback progress(stage, done, total) that draws a bar for each stage, under its title."""
    tasks: dict[str, TaskID] = {}

    def draw(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(titles.get(stage, stage), total=total)
        bars.update(tasks[stage], completed=done, total=total)

    return draw


def format_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Columns aligned for reading, numbers to the right."""
    body = [list(row) for row in rows]
    cells = [list(header), *([_cell(value) for value in row] for row in body)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    right = [
        bool(body) and all(isinstance(row[i], int | float | Decimal | None) for row in body)
        for i in range(len(header))
    ]
    lines = [
        "  ".join(
            c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in cells
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines) + "\n"


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, datetime):
        return value.strftime("%Y-%m-%d %H:%M:%S")
    text = value.hex() if isinstance(value, bytes) else str(value)
    text = text.replace("\n", " ")
    return text if len(text) <= LONGEST_CELL else text[: LONGEST_CELL - 1] + "…"


def write_json(value: Any) -> None:
    """Write a value to stdout as JSON."""
    sys.stdout.write(json_text(value, indent=2) + "\n")


def json_text(value: Any, indent: int | None = None) -> str:
    """A value as JSON; see `plain`."""
    return json.dumps(plain(value), indent=indent, allow_nan=False)
