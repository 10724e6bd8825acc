"""The command `import`: the maps of a dataset into a database."""

import argparse
import sys
from pathlib import Path
from typing import Any

from featuredb.cli.common import add_command, open_database, progress_of_maps


def register(subparsers: Any) -> None:
    text = "bring the maps of an exported dataset into a database"
    parser = add_command(subparsers, "import", run_import, text, description=f"{text}; see docs/export.md")
    parser.add_argument(
        "folder", metavar="FOLDER", type=Path, help="a dataset, as `featuredb export` makes it"
    )
    parser.add_argument(
        "--trusted",
        action="store_true",
        help="trust the dataset: its maps keep their status; default: active maps are quarantined",
    )
    parser.add_argument("--dry-run", action="store_true", help="check everything and say what would be done")


def run_import(args: argparse.Namespace) -> None:
    from featuredb.export.dataset import import_dataset

    done = import_dataset(
        open_database(args), args.folder, trusted=args.trusted, dry_run=args.dry_run, told=progress_of_maps()
    )
    would = "would import" if done.dry_run else "imported"
    lines = [f"{would} {len(done.created)} maps; {len(done.present)} were there already"]
    lines += [
        f"{map_id}: is retired here ({why}) and stays so; `featuredb promote` takes it into service again"
        for map_id, why in done.retired.items()
    ]
    if done.quarantined and not args.trusted:
        lines.append(
            f"{len(done.quarantined)} of them in quarantine, because nobody here has vouched for them: "
            "`featuredb promote` takes one into service, `--trusted` the whole of a dataset"
        )
    for map_id, missing in done.quarantined.items():
        if not missing:
            continue
        needs = f"what placed it is neither in the dataset nor in the database: {', '.join(missing)}"
        lines.append(f"{map_id}: in quarantine, {needs}")
    if not done.dry_run:
        lines.append(f"version {done.version}")
    sys.stdout.write("\n".join(lines) + "\n")
