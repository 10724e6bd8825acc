"""The command that writes a simulated world: photos of a town that does not exist, with exact truth."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import count_bars

if TYPE_CHECKING:
    from featuredb.simworld.world import World


def register(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "simworld",
        help="write photos of a simulated town, with exact truth",
        description="Write photos of a simulated town (drone survey, held-out queries, street photos, "
        "negatives) and truth.json with every camera's true pose.",
    )
    parser.add_argument("out", metavar="OUT", type=Path, help="folder to write, made if missing")
    parser.add_argument("--size", choices=("short", "full"), default="short", help="default: short")
    parser.add_argument("--seed", type=int, default=1, help="another seed is another town; default: 1")
    parser.add_argument(
        "--gps-error",
        choices=("realistic", "none"),
        default="realistic",
        help="none: EXIF positions are the truth; default: realistic",
    )
    parser.add_argument(
        "--lidar",
        action="store_true",
        help="also write scan.laz (airborne, intensity only) and ortho.tif of the town, and those of another "
        "town at the same place; needs the extra lidar",
    )
    parser.add_argument("--workers", type=int, default=0, help="processes; default: one per core")
    parser.set_defaults(run=run_simworld)


def run_simworld(args: argparse.Namespace) -> None:
    from rich.console import Console

    from featuredb.simworld.scan_world import write_lidar
    from featuredb.simworld.world import WorldOptions, write_world

    options = WorldOptions.short(args.seed) if args.size == "short" else WorldOptions(seed=args.seed)
    options = replace(options, workers=args.workers, flight=replace(options.flight, gps_error=args.gps_error))
    console = Console(stderr=True)
    if args.lidar:  # first, since it may lack a package
        write_lidar(args.out, options, lambda name: console.print(f"writing {name}"))
    with count_bars() as bars:
        task = bars.add_task("photos", total=None)
        world = write_world(
            args.out, options, lambda done, total: bars.update(task, completed=done, total=total)
        )
    Console().print(_summary(world, lidar=args.lidar))


def _summary(world: "World", *, lidar: bool) -> str:
    from featuredb.simworld.scan_world import ORTHO_FILE, OTHER_ORTHO_FILE, OTHER_SCAN_FILE, SCAN_FILE

    counts = {
        "survey photos": len(world.images("drone")),
        "queries": len(world.images("queries")),
        "street photos": len(world.images("street")),
        "negatives": len(world.negatives()),
    }
    files = [SCAN_FILE, ORTHO_FILE, OTHER_SCAN_FILE, OTHER_ORTHO_FILE] if lidar else []
    return f"{world.folder}: " + ", ".join(
        [*(f"{n} {what}" for what, n in counts.items()), "truth.json", *files]
    )
