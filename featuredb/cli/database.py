"""The commands that keep a database: from init and maps to verify, repair and vacuum.

`lineage` and `candidates` are in modules of their own and are registered here.
"""

import argparse
import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from featuredb.cli import candidates, lineage
from featuredb.cli.common import (
    add_as_of_argument,
    add_command,
    add_database_argument,
    format_table,
    hours,
    json_text,
    open_database,
    place_for_database,
    storage_options,
    version_or_time,
    write_json,
)
from featuredb.store.vacuum_options import VacuumOptions

if TYPE_CHECKING:
    from featuredb.maps.place_bounds import PlaceBounds
    from featuredb.store import MapSummary, UnplacedSummary
    from featuredb.store.durable.backup import CopyReport
    from featuredb.store.sql import SqlResult

_DEFAULTS = VacuumOptions()
_BOUNDS = (
    "place_95_m, tilt_95_deg, heading_95_deg: 95 of 100 maps lie no further off horizontally, and are tilted "
    "and turned about the vertical by no more\n"
)


def register(subparsers: Any) -> None:
    add_command(subparsers, "init", run_init, "make an empty database")
    maps = add_command(subparsers, "maps", run_maps, "list the maps")
    maps.add_argument("--all", action="store_true", help="retired maps, too")
    add_as_of_argument(maps)
    maps.add_argument("--json", action="store_true", help="everything that is known, as JSON")
    add_command(subparsers, "history", run_history, "list the versions of the database")
    sql = add_command(
        subparsers,
        "sql",
        run_sql,
        "read by SQL (DuckDB): maps, images, cameras, points, observations, lidar, lidar_points, candidates, "
        "canaries",
        epilog='example: featuredb sql DB "select tile, count(*) from points group by tile"; see docs/sql.md',
    )
    sql.add_argument("query", metavar="SELECT", help="one reading statement")
    sql.add_argument("--format", choices=("table", "csv", "json"), default="table", help="default: table")
    add_as_of_argument(sql)
    check = add_command(
        subparsers, "verify", run_verify, "check every file, row and reference; exit 1 if broken"
    )
    check.add_argument("--json", action="store_true", help="the report as JSON")
    retire = add_command(
        subparsers, "retire", run_retire, "take a map out of service, with its descendants, or a scan"
    )
    retire.add_argument("map_id", metavar="MAP", help="id of a map or of a LiDAR scan, or its first letters")
    retire.add_argument("--reason", required=True, help="kept with the map or scan")
    rollback = add_command(subparsers, "rollback", run_rollback, "show again what an earlier version showed")
    rollback.add_argument("version", type=version_or_time, metavar="VERSION", help="number or ISO 8601 time")
    lineage.register(subparsers)
    candidates.register(subparsers)
    _register_backup(subparsers)
    add_command(subparsers, "compact", run_compact, "merge small files")
    add_command(subparsers, "upgrade", run_upgrade, "bring a database of an older release to today's format")
    _register_vacuum(subparsers)
    _register_repair(subparsers)


def run_init(args: argparse.Namespace) -> None:
    from featuredb.store import Database

    place_for_database(args)
    database = Database.create(args.db, storage_options=storage_options(args))
    sys.stdout.write(f"database at {database.url}, version {database.poll_version()}\n")


def run_maps(args: argparse.Namespace) -> None:
    snapshot = open_database(args).snapshot(args.as_of)
    if args.json:
        rows = [row for row in snapshot.rows() if args.all or row["status"] != "retired"]
        write_json({"snapshot": snapshot.version, "timestamp": snapshot.timestamp, "maps": rows})
        return
    maps = snapshot.maps(include_retired=args.all)
    unplaced = snapshot.unplaced_maps(include_retired=args.all)
    sys.stdout.write(maps_table(maps, snapshot.place_bounds()) + unplaced_text(unplaced))


def maps_table(maps: Sequence["MapSummary"], bounds: Mapping[str, "PlaceBounds"]) -> str:
    """Maps with a place, how far off each may be, by id, and why some are in quarantine."""
    header = (
        "map", "name", "status", "method", "gen", "drift_m", "epsg", "images", "points", "residual_m",
        "place_95_m", "tilt_95_deg", "heading_95_deg", "committed",
    )  # fmt: skip
    rows = [
        (
            m.map_id, m.name, m.status, m.method, m.generation,
            None if m.drift_m is None else round(m.drift_m, 3), m.epsg, m.images, m.points,
            round(m.residual_rms_m, 3), round(b.horizontal_m, 2), round(b.tilt_deg, 2),
            round(b.heading_deg, 2), m.created_at,
        )
        for m, b in ((m, bounds[m.map_id]) for m in maps)
    ]  # fmt: skip
    words = _BOUNDS if maps else ""
    return (
        format_table(header, rows)
        + words
        + "".join(
            f"{m.map_id}: {m.status_reason}\n" for m in maps if m.status == "quarantined" and m.status_reason
        )
    )


def unplaced_text(unplaced: Sequence["UnplacedSummary"]) -> str:
    """The maps without a place, with what would give them one; nothing where there are none."""
    if not unplaced:
        return ""
    header = (
        "map without a place", "name", "status", "metric", "upright", "images", "points", "why", "committed",
    )  # fmt: skip
    rows = [
        (
            m.map_id, m.name, m.status, "yes" if m.frame.metric else "no", "yes" if m.frame.upright else "no",
            m.images, m.points, m.no_place.reason_code, m.created_at,
        )
        for m in unplaced
    ]  # fmt: skip
    lines = ["\n" + format_table(header, rows)]
    for m in unplaced:
        lines.append(f"{m.map_id}: {m.no_place.reason}\n")
        lines += [f"  {way}\n" for way in m.no_place.ways]
    return "".join(lines)


def run_history(args: argparse.Namespace) -> None:
    rows = [
        (e.version, e.timestamp, e.operation, ", ".join(e.maps), e.reason)
        for e in open_database(args).history()
    ]
    sys.stdout.write(format_table(("version", "time", "operation", "maps", "reason"), rows))


def run_sql(args: argparse.Namespace) -> None:
    from featuredb.store.sql import SqlSession

    database = open_database(args)
    with SqlSession(database.snapshot(args.as_of), database) as session:
        write_result(session.query(args.query), args.format)


def run_verify(args: argparse.Namespace) -> int:
    from featuredb.store import Database
    from featuredb.store.verify import verify

    report = verify(Database(args.db, storage_options(args)))  # not opened: a damaged log is a finding
    if args.json:
        write_json({"ok": report.ok, **asdict(report)})
        return 0 if report.ok else 1
    for problem in report.problems:
        sys.stdout.write(f"PROBLEM {problem.where}: {problem.what}\n")
    for orphan in report.orphans:
        sys.stdout.write(f"orphan rows of write {orphan}: harmless, `featuredb vacuum` removes them\n")
    verdict = "sound" if report.ok else f"{len(report.problems)} problems"
    sys.stdout.write(
        f"version {report.version}: {report.maps} maps, {report.scans} scans, "
        f"{report.candidates} candidates, {report.canaries} canaries, {report.files} files, "
        f"{report.rows} rows: {verdict}\n"
    )
    return 0 if report.ok else 1


def run_retire(args: argparse.Namespace) -> None:
    from featuredb.errors import MapNotFoundError
    from featuredb.store.scans import list_scans, retire_scan
    from featuredb.store.snapshot import full_id

    database = open_database(args)
    scans = {scan.scan_id for scan in list_scans(database, include_retired=True)}
    ids = scans | {m.map_id for m in database.snapshot().any_maps(include_retired=True)}
    none = f"no map or scan {args.map_id}; `featuredb maps` and `featuredb lidar list` list what there is"
    meant = full_id(args.map_id, ids, "maps and scans", MapNotFoundError, none)
    retired: tuple[str, ...] = ()
    if meant not in scans:
        retired = database.retire(meant, args.reason)
    elif retire_scan(database, meant, args.reason):
        retired = (meant,)
    sys.stdout.write(f"retired: {', '.join(retired) if retired else 'nothing, it was retired already'}\n")


def run_rollback(args: argparse.Namespace) -> None:
    sys.stdout.write(f"version {open_database(args).rollback(args.version)}\n")


def run_compact(args: argparse.Namespace) -> None:
    from featuredb.store.maintenance import compact

    for table, saved in compact(open_database(args)).items():
        sys.stdout.write(f"{table}: {saved} files less\n")


def run_upgrade(args: argparse.Namespace) -> None:
    from featuredb.store.maintenance import upgrade
    from featuredb.store.tables import FORMAT_VERSION

    steps = upgrade(open_database(args))
    sys.stdout.writelines(f"{step}\n" for step in steps)
    if not steps:
        sys.stdout.write(f"format {FORMAT_VERSION}, nothing to do\n")


def run_repair(args: argparse.Namespace) -> int:
    from featuredb.store import Database
    from featuredb.store.durable.repair import repair

    database = Database(args.db, storage_options(args))
    steps = repair(database, apply=args.apply, give_up_lost=args.give_up_lost)
    for step in steps:
        done = step.action and ("done" if args.apply else "would be done")
        sys.stdout.write(f"{step.where}: {step.what}\n")
        sys.stdout.write(f"  {done or 'NOT REPAIRED'}: {step.action or step.advice}\n")
    open_ends = [step for step in steps if not (step.action and args.apply)]
    if not steps:
        sys.stdout.write("the logs are whole, nothing to repair; `featuredb verify` checks the rest\n")
    elif not args.apply:
        sys.stdout.write("nothing was changed; --apply does it\n")
    elif not open_ends:
        sys.stdout.write("now run `featuredb verify`\n")
    return 1 if open_ends else 0


def run_vacuum(args: argparse.Namespace) -> None:
    from featuredb.store.maintenance import vacuum

    options = VacuumOptions(
        history_h=args.keep_history_hours,
        orphan_grace_h=args.orphan_grace_hours,
        file_grace_h=args.file_grace_hours,
    )
    report = vacuum(open_database(args), options, dry_run=args.dry_run)
    would = "would remove" if report.dry_run else "removed"
    images = f", and {len(report.candidate_images)} refused photos" if report.candidate_images else ""
    sys.stdout.write(
        f"{would} {len(report.files)} files and the rows of {len(report.write_ids)} writes that no map "
        f"names{images}; versions from {report.kept_from} on stay readable\n"
    )


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


def write_result(result: "SqlResult", output: str) -> None:
    """Write a query's rows to stdout as table, csv or json; the latter two row by row."""
    if output == "table":
        sys.stdout.write(format_table(result.columns, result.rows))
    elif output == "csv":
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(result.columns)
        for row in result.rows:
            writer.writerow([v.hex() if isinstance(v, bytes) else v for v in row])
    else:
        sys.stdout.write("[")
        for count, row in enumerate(result.rows):
            sys.stdout.write(",\n" if count else "\n")
            sys.stdout.write(json_text(dict(zip(result.columns, row, strict=True))))
        sys.stdout.write("\n]\n")


def _register_vacuum(subparsers: Any) -> None:
    parser = add_command(subparsers, "vacuum", run_vacuum, "remove what no snapshot needs any more")
    for option, default, text in (
        ("--keep-history-hours", _DEFAULTS.history_h, "snapshots of this time stay readable"),
        ("--orphan-grace-hours", _DEFAULTS.orphan_grace_h, "rows of unfinished commits stay this long"),
        ("--file-grace-hours", _DEFAULTS.file_grace_h, "unused files stay this long for running readers"),
    ):
        parser.add_argument(option, type=hours, default=default, help=f"{text} (default: %(default)s)")
    parser.add_argument("--dry-run", action="store_true", help="only say what would be removed")


def _register_repair(subparsers: Any) -> None:
    parser = add_command(
        subparsers, "repair", run_repair, "say what is damaged in the logs; with --apply, mend what can be"
    )
    parser.add_argument("--apply", action="store_true", help="do it; files are moved, none is deleted")
    parser.add_argument(
        "--give-up-lost",
        action="store_true",
        help="go back also behind commits that were done and whose log entry is lost",
    )


def _register_backup(subparsers: Any) -> None:
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
