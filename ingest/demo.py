"""`featuredb demo`: the whole line on a simulated town, with the truth beside every answer.

World -> ingest -> Zenoh server -> client -> table of errors; no photos of yours and no network needed.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import format_table
from featuredb.errors import FeatureDbError

if TYPE_CHECKING:
    from featuredb.simworld.scoring import PoseError
    from featuredb.simworld.world import World
    from ingest.report.values import IngestReport
    from reloc.client import Client
    from reloc.wire.query import LocaliseReply

Say = Callable[[str], None]
# What the simulated drone's exact tags are good for: they are rounded by EXIF to about a millimetre, and a
# reconstruction places its cameras to a few of them.
_EXACT_SIGMA_M = 0.003


def register(subparsers: Any) -> None:
    """Add `demo` to the parser of `featuredb`."""
    demo = subparsers.add_parser(
        "demo",
        help="the whole line on a simulated town",
        description="Make a simulated town with photos, ingest the drone's, serve them over Zenoh, ask where "
        "held-out photos were taken, and compare with the truth.",
    )
    demo.add_argument("--out", type=Path, default=Path("featuredb-demo"), help="default: ./featuredb-demo")
    demo.add_argument("--size", choices=("short", "full"), default="short", help="default: short")
    demo.add_argument("--seed", type=int, default=1, help="of the town and of everything in it")
    demo.set_defaults(run=_run)


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoAnswer:
    """One query and what came of it.

    Attributes:
        group: drone, street, or the kind of negative.
        error: None where not localised, or where there is no truth (negatives).
    """

    group: str
    name: str
    reply: "LocaliseReply"
    error: "PoseError | None"
    wall_ms: float


def _run(args: argparse.Namespace) -> int:
    def say(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    answers = run_demo(args.out, size=args.size, seed=args.seed, say=say)
    return 0 if demo_holds(answers) else 1


def run_demo(out: Path, *, size: str, seed: int, say: Say) -> list[DemoAnswer]:
    """Everything, into `out`: world/, db/, report/, overlay.png. Returns all answers.

    Raises:
        FeatureDbError: a step could not be done.
    """
    from featuredb.store import Database
    from reloc.client import Client
    from reloc.service.options import ServeOptions
    from reloc.service.serve import start_server

    start = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    _tell(say, start, "drawing the town and its photos, a minute or two ...")
    world = make_world(out / "world", size=size, seed=seed)
    _tell(say, start, f"simulated town: {len(world.images('drone'))} drone photos in {world.folder}")
    _tell(say, start, "making a map of them; each stage is told when it is done ...")
    database = Database.create(out / "db")
    report = ingest_world(world, database, out / "report")
    made = next((m for m in report.maps if m.status != "refused"), None)
    if made is None:
        raise FeatureDbError(
            "demo: no map came of the drone photos: " + "; ".join(m.reason for m in report.maps)
        )
    page = out / "report" / "report.html"
    _tell(say, start, f"map: {made.photos} photos, {made.points} points; {page}")
    _tell(say, start, "serving the map, and asking it where other photos were taken ...")
    with (
        start_server(database, ServeOptions(listen=("tcp/127.0.0.1:0",))) as server,
        Client(server.endpoints[0]) as client,
    ):
        answers = ask_all(world, client)
        _write_overlay(out / "overlay.png", world, client, answers)
    _tell(say, start, f"{len(answers)} photos asked over Zenoh; {out / 'overlay.png'}")
    say("")
    say(table(answers))
    return answers


def make_world(folder: Path, *, size: str, seed: int) -> "World":
    """The world in `folder`, made unless it is there already; its drone's tags are exact."""
    from featuredb.simworld.world import WorldOptions, open_world, write_world

    if (folder / "truth.json").exists():
        return open_world(folder)
    options = WorldOptions.short(seed) if size == "short" else WorldOptions(seed=seed)
    return write_world(folder, replace(options, flight=replace(options.flight, gps_error="none")))


def ingest_world(world: "World", database: Any, report_folder: Path) -> "IngestReport":
    """Ingest the drone photos and write the report."""
    from featuredb.features.extractor import ExtractorOptions
    from ingest.api.ingesting import ingest
    from ingest.map_builder import MapOptions
    from ingest.pipeline import IngestOptions
    from ingest.reconstruction import MapMakingOptions

    options = IngestOptions(
        gps_sigma_m=(_EXACT_SIGMA_M, _EXACT_SIGMA_M),
        # The town is rich in texture; a quarter of the usual features make a first impression short.
        making=MapMakingOptions(
            extractor=ExtractorOptions(max_features=3000), maps=MapOptions(height_datum="ellipsoidal")
        ),
    )
    return ingest(database, world.folder / "drone", options, report=report_folder)


def ask_all(world: "World", client: "Client") -> list[DemoAnswer]:
    """Held-out drone photos, street photos and negatives, each as a client would ask."""
    answers = [_ask(world, client, "drone", path, has_truth=True) for path in world.images("queries")]
    answers += [_ask(world, client, "street", path, has_truth=True) for path in world.images("street")]
    for path in world.negatives():
        answers.append(_ask(world, client, path.parent.name, path, has_truth=False))
    return answers


def _ask(world: "World", client: "Client", group: str, path: Path, *, has_truth: bool) -> DemoAnswer:
    from featuredb.simworld.scoring import pose_difference

    start = time.perf_counter()
    reply = client.localise(path, timeout_s=60.0)
    wall_ms = 1000.0 * (time.perf_counter() - start)
    error = None
    if has_truth and reply.utm is not None:
        true = world.truth.images[path.relative_to(world.folder).as_posix()].cam_from_local
        utm = reply.utm
        place = (utm.easting, utm.northing, utm.height)
        error = pose_difference(world.truth.frame, true, utm.epsg, place, utm.cam_from_utm_xyzw)
    return DemoAnswer(group=group, name=path.name, reply=reply, error=error, wall_ms=wall_ms)


def table(answers: Sequence[DemoAnswer]) -> str:
    """Errors by group, as text."""
    from featuredb.simworld.scoring import summarise

    rows: list[tuple[object, ...]] = []
    for group in dict.fromkeys(answer.group for answer in answers):
        mine = [answer for answer in answers if answer.group == group]
        answered = sum(a.reply.status == "localised" for a in mine)
        wall_ms = sorted(a.wall_ms for a in mine)[len(mine) // 2]
        figures: tuple[object, ...] = (None, None, None, None, answered)  # no true place
        if answered and group in ("drone", "street"):
            found = summarise([a.error for a in mine])
            figures = (*found.position_m, *found.angle_deg, found.wrong)
        shown = (f"{f:.3f}" if isinstance(f, float) else f for f in figures)
        rows.append((group, len(mine), answered, *shown, round(wall_ms)))
    head = ("photos", "asked", "answered", "median_m", "95%_m", "median_deg", "95%_deg", "wrong", "median_ms")
    return format_table(head, rows)


def demo_holds(answers: Sequence[DemoAnswer]) -> bool:
    """Whether most drone photos were answered and nothing was answered wrongly."""
    drone = [a for a in answers if a.group == "drone"]
    found = sum(a.error is not None for a in drone)
    wrong = sum(a.error is not None and a.error.position_m > 5.0 for a in answers)
    invented = sum(a.reply.status == "localised" for a in answers if a.group not in ("drone", "street"))
    return found >= 0.8 * len(drone) and wrong == 0 and invented == 0


def _write_overlay(path: Path, world: "World", client: "Client", answers: Sequence[DemoAnswer]) -> None:
    """The first answered drone photo with the map drawn on it."""
    from reloc.overlay import write_overlay

    answered = {a.name for a in answers if a.group == "drone" and a.error is not None}
    for photo in world.images("queries"):
        if photo.name in answered:
            data = photo.read_bytes()
            write_overlay(path, data, client.localise(data, inliers=True, timeout_s=60.0))
            return


def _tell(say: Say, start: float, text: str) -> None:
    say(f"[{time.monotonic() - start:5.0f} s] {text}")
