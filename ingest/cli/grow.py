"""`featuredb grow`, `featuredb promote`, `featuredb canary`: arguments in, reports out."""

import argparse
import json
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import add_command, add_database_argument, format_table, open_database

if TYPE_CHECKING:
    from featuredb.store.canaries import KnownPose
    from ingest.growing import GrowingOptions
    from ingest.growth.growth_report import GrowthReport


def register(subparsers: Any) -> None:
    _register_grow(subparsers)
    _register_promote(subparsers)
    _register_canary(subparsers)


def _register_grow(subparsers: Any) -> None:
    grow = add_command(
        subparsers,
        "grow",
        run_grow,
        "let contributed photos become maps, and maps without a place find theirs",
        description="Place the photos that wait, and the maps without a place, by the maps there are. New "
        "maps stay in quarantine until photos of someone else confirm them; see docs/growth.md.",
    )
    grow.add_argument("--watch", action="store_true", help="run whenever photos arrive, until Ctrl-C")
    grow.add_argument("--poll", type=float, default=30.0, metavar="SECONDS", help="of --watch; default 30")
    grow.add_argument("--budget", type=float, metavar="M", help="drift from the anchors; default: 0.5")
    grow.add_argument(
        "--trust",
        action="append",
        default=[],
        metavar="IDENTITY",
        help="trust this client: its photos need no confirmation by others; may be repeated. anonymous: all "
        "that come without a certificate",
    )
    grow.add_argument("--max-features", type=int, help="per photo; default: 12000")
    grow.add_argument("--workers", type=int, default=1, help="processes; default: 1")
    grow.add_argument("--work", type=Path, metavar="DIR", help="default: DB/_work")
    grow.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
    grow.add_argument("--json", action="store_true", help="print the report as JSON")


def _register_promote(subparsers: Any) -> None:
    promote = add_command(
        subparsers,
        "promote",
        run_promote,
        "take a quarantined map into service by hand",
        description="Promote a map without confirmation. Canaries are run first; if one "
        "regresses, the promotion is refused unless --force is given. `featuredb retire` undoes it.",
    )
    promote.add_argument("map_id", metavar="MAP", help="id of the map; its first letters are enough")
    promote.add_argument("--reason", required=True, help="kept with the map")
    promote.add_argument("--force", action="store_true", help="even if canaries regress")


def _register_canary(subparsers: Any) -> None:
    canary = subparsers.add_parser("canary", help="known queries, run before every promotion")
    add_database_argument(canary)
    kinds = canary.add_subparsers(title="what to do", metavar="ACTION", required=True)
    add = kinds.add_parser("add", help="add a photo whose right answer is known")
    add.add_argument("image", type=Path, metavar="IMAGE")
    add.add_argument("--name", default="", help="default: the file's name")
    what = add.add_mutually_exclusive_group()
    what.add_argument(
        "--pose",
        type=Path,
        metavar="FILE",
        help='JSON: {"epsg", "utm": [e, n, h], "height_datum", "cam_from_utm_xyzw": [x, y, z, w]}; default: '
        "what the database answers now",
    )
    what.add_argument("--elsewhere", action="store_true", help="of another place: it must not be localised")
    add.set_defaults(run=run_canary_add)
    listing = kinds.add_parser("list", help="list them")
    listing.set_defaults(run=run_canary_list)
    remove = kinds.add_parser("remove", help="remove one")
    remove.add_argument("name", metavar="NAME")
    remove.set_defaults(run=run_canary_remove)
    ask = kinds.add_parser("run", help="localise all of them in the active maps; exit 1 if one is wrong")
    ask.add_argument("--json", action="store_true")
    ask.set_defaults(run=run_canary_run)


def run_grow(args: argparse.Namespace) -> int:
    """Grow once or until stopped; 0."""
    from featuredb.stop_signals import on_stop_signals
    from ingest.growing import grow_candidates, watch_and_grow

    database, options = open_database(args), _options(args)
    if not args.watch:
        _show(grow_candidates(database, options), args)
        return 0
    stop = threading.Event()
    with on_stop_signals(stop.set):
        sys.stdout.write(f"watching {database.url}; stop with Ctrl-C\n")
        sys.stdout.flush()
        watch_and_grow(database, options, stop, lambda report: _show(report, args), poll_s=args.poll)
    return 0


def _show(report: "GrowthReport", args: argparse.Namespace) -> None:
    if args.report is not None:
        from ingest.workspace import write_json

        write_json(args.report, report.as_json())
    sys.stdout.write(json.dumps(report.as_json()) + "\n" if args.json else report.as_text())
    sys.stdout.flush()


def _options(args: argparse.Namespace) -> "GrowingOptions":
    from featuredb.features.extractor import ExtractorOptions
    from ingest.growing import GrowingOptions
    from ingest.growth.values import GrowthOptions
    from ingest.reconstruction import MapMakingOptions

    budget = {} if args.budget is None else {"drift_budget_m": args.budget}
    extractor = {} if args.max_features is None else {"max_features": args.max_features}
    return GrowingOptions(
        growth=GrowthOptions(trusted=tuple(args.trust), **budget),
        making=MapMakingOptions(extractor=ExtractorOptions(**extractor)),
        workers=args.workers,
        work=args.work,
    )


def run_promote(args: argparse.Namespace) -> int:
    """Promote by hand; 0, or 1 where canaries refuse."""
    from ingest.growth.trust.promotion import promote_by_hand

    outcome = promote_by_hand(open_database(args), args.map_id, args.reason, force=args.force)
    became = "promoted" if outcome.promoted else f"stays in quarantine: {outcome.reason_code}"
    sys.stdout.write(f"map {outcome.map_id}: {became}: {outcome.reason}\n")
    return 0 if outcome.promoted else 1


def run_canary_add(args: argparse.Namespace) -> int:
    """Add a known query; its answer is given, or is what the database answers now."""
    from featuredb.errors import InvalidValueError
    from featuredb.store.canaries import Origin, add_canary
    from ingest.growth.trust.canaries import answer_now

    database, image = open_database(args), args.image.read_bytes()
    name = args.name or args.image.name
    snapshot = None
    pose: KnownPose | None = None
    if args.pose is not None:
        pose = _pose(args)
    elif not args.elsewhere:
        pose, snapshot = answer_now(database, image)
        if pose is None:
            raise InvalidValueError(
                f"{args.image}: the database does not localise it; give --pose, or --elsewhere where it "
                "must not"
            )
    origin: Origin = "person" if snapshot is None else "answer"
    add_canary(database, name, image, pose, origin=origin, snapshot=snapshot)
    sys.stdout.write(f"canary {name}: {'not to be localised' if pose is None else f'known by {origin}'}\n")
    return 0


def _pose(args: argparse.Namespace) -> "KnownPose":
    import numpy as np

    from featuredb.errors import InvalidValueError
    from featuredb.store.canaries import KnownPose

    try:
        value = json.loads(args.pose.read_text(encoding="utf-8"))
        return KnownPose(
            epsg=int(value["epsg"]),
            utm=np.asarray(value["utm"], dtype=np.float64),
            height_datum=str(value.get("height_datum", "unknown")),
            cam_from_utm_xyzw=np.asarray(value["cam_from_utm_xyzw"], dtype=np.float64),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidValueError(f"{args.pose}: expected the JSON of a pose, {error!r}") from error


def run_canary_list(args: argparse.Namespace) -> int:
    from featuredb.store.canaries import list_canaries

    rows = [
        (
            c.name, "not localised" if c.pose is None else "localised", c.origin,
            c.created_at,
        )
        for c in list_canaries(open_database(args))
    ]  # fmt: skip
    sys.stdout.write(format_table(("name", "expected", "known by", "added"), rows))
    return 0


def run_canary_remove(args: argparse.Namespace) -> int:
    from featuredb.store.canaries import remove_canary

    remove_canary(open_database(args), args.name)
    sys.stdout.write(f"removed {args.name}\n")
    return 0


def run_canary_run(args: argparse.Namespace) -> int:
    """Ask all known queries of the active maps; 1 if one is not answered rightly."""
    from featuredb.store.canaries import list_canaries
    from ingest.growth.trust.canaries import check_known
    from reloc.localiser import Localiser

    database = open_database(args)
    localiser = Localiser.open(database)
    checks = [check_known(database, canary, localiser, localiser) for canary in list_canaries(database)]
    if args.json:
        sys.stdout.write(json.dumps([check.as_json() for check in checks]) + "\n")
    else:
        rows = [(c.name, c.after, "" if c.error_m != c.error_m else round(c.error_m, 3)) for c in checks]
        sys.stdout.write(format_table(("canary", "answer", "error_m"), rows))
    return 0 if all(check.after in ("right", "not_found") for check in checks) else 1
