"""`featuredb backup` and `featuredb restore`."""

import argparse
import sys
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import add_database_argument, open_database, storage_options

if TYPE_CHECKING:
    from featuredb.store.durable.backup import CopyReport


def register(subparsers: Any) -> None:
    for name, run, text, source in (
        ("backup", run_backup, "copy a database that may be in use; again: what is new", "the database"),
        ("restore", run_restore, "make a database of a backup, where there is none", "the backup"),
    ):
        parser = subparsers.add_parser(name, help=text, description=text)
        add_database_argument(parser, "SOURCE", f"folder or URL of {source}")
        parser.add_argument("target", metavar="TARGET", help="folder or URL to write to")
        parser.add_argument(
            "--target-storage-option",
            metavar="KEY=VALUE",
            action="append",
            default=[],
            help="option of the target's object store, where it is not the source's; may be repeated",
        )
        parser.set_defaults(run=run)


def run_backup(args: argparse.Namespace) -> None:
    from featuredb.store.durable.backup import backup

    report = backup(open_database(args), args.target, _target_options(args))
    _write_report("backup", args.target, report)


def run_restore(args: argparse.Namespace) -> None:
    from featuredb.store import Database
    from featuredb.store.durable.backup import restore

    target = Database(args.target, _target_options(args))
    report = restore(args.db, target, storage_options(args))
    _write_report("database", target.url, report)


def _target_options(args: argparse.Namespace) -> dict[str, str]:
    """Those of the target, else those of the source."""
    given = argparse.Namespace(storage_option=args.target_storage_option or args.storage_option)
    return storage_options(given)


def _write_report(what: str, target: str, report: "CopyReport") -> None:
    removed = f", {report.removed} of before removed" if report.removed else ""
    sys.stdout.write(
        f"{what} at {target}: version {report.version}, {report.files} files copied "
        f"({report.bytes / 1e6:.1f} MB), {report.kept} there already{removed}\n"
    )
