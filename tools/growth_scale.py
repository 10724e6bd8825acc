"""How the time of an ingest grows: 500 and 5,000 simulated photos, wall time per photo and peak memory.

    python -m tools.growth_scale --out DIR [--size full] [--seed 3] [--max-features 2000] [--dask ADDRESS]

The world is that of `featuredb.simworld.scale_world`: ten districts of 500 photos. The first district alone
and all of them are ingested by `featuredb ingest photos` in a process of its own, from empty databases. With
--dask the large one is ingested again on that scheduler, and the maps are compared by their digests.

Prints seconds and processor seconds per photo, images per hour, registered photos, how many of these are more
than a metre from where the rest of their map is by the truth (their map was joined wrongly), and the peak of
the memory of all processes together (proportional shares, sampled twice a second). Writes scale.json. Exit
code 0 if the wall time per photo at the large size is at most 1.3 times that at the small one, the peak is
under 6 GiB, and the large one registers at least half as large a share of its photos: what fails early takes
no time.

A run that is killed goes on where it was, as the ingest does. The times of its parts add up; what was done
twice counts twice.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.simworld.album_files import AlbumFact
from featuredb.simworld.scale_world import ScaleOptions, write_scale
from featuredb.store import Database
from tools.growth_common import Album, Verdict, conclude, made, say, table, with_the_rest

_RATIO, _PEAK_GIB = 1.3, 6.0
# Of the share that the small one registers. Of 500 photos, single districts of the large one had 86 to 288 in
# maps; the small one is a single draw of that.
_REGISTERED = 0.5
_SAMPLE_S = 0.5
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(slots=True, kw_only=True)
class Spent:
    """What the parts of one ingest have taken, in seconds and bytes; on disk while it runs."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak: int = 0
    parts: int = 0

    @classmethod
    def read(cls, file: Path) -> "Spent":
        return cls(**json.loads(file.read_text(encoding="utf-8"))) if file.exists() else cls()

    def write(self, file: Path) -> None:
        part = file.with_suffix(".part")
        part.write_text(json.dumps(asdict(self)) + "\n", encoding="utf-8")
        part.replace(file)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ingest:
    """One ingest: photos, times in seconds, the peak of all its processes, what came of it.

    Attributes:
        apart: registered photos that are not where the rest of their map is by the truth.
    """

    photos: int
    wall_s: float
    cpu_s: float
    peak_gib: float
    registered: int
    apart: int
    maps: int
    parts: int = 1

    @property
    def wall_per_photo_s(self) -> float:
        return self.wall_s / self.photos

    @property
    def share(self) -> float:
        """Registered photos of all."""
        return self.registered / self.photos


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    world = ScaleOptions.short(args.seed) if args.size == "short" else ScaleOptions(seed=args.seed)
    folder = args.world or args.out / f"world-{args.size}-{args.seed}"
    album = made(write_scale, folder, world, args.workers)
    everything = album.of("street", "drone")
    runs = {}
    for name, facts in (("small", [f for f in everything if f.batch == 0]), ("large", everything)):
        runs[name] = ingested(args.out, name, album, facts, args, ())
    if args.dask:
        runs["dask"] = ingested(args.out, "dask", album, everything, args, ("--dask", args.dask))
    rows = [
        (
            *(name, r.photos, r.wall_s, r.wall_per_photo_s, r.cpu_s / r.photos),
            *(round(3600 * r.photos / r.wall_s), r.peak_gib, r.registered, r.apart, r.maps),
        )
        for name, r in runs.items()
    ]
    head = (
        "ingest",
        "photos",
        "wall s",
        "s/photo",
        "cpu s/photo",
        "per hour",
        "peak GiB",
        "registered",
        "apart",
        "maps",
    )
    sys.stdout.write(table(rows, head) + "\n")
    small, large = (registered_photos(args.out / name) for name in ("small", "large"))
    say(f"of {len(small)} photos in maps of the small one {len(small & large)} are in maps of the large one")
    figures: dict[str, Any] = {name: asdict(r) for name, r in runs.items()}
    return conclude(args.out, "scale", judge(args.out, runs), figures)


def judge(out: Path, runs: dict[str, Ingest]) -> list[Verdict]:
    small, large = runs["small"], runs["large"]
    ratio = large.wall_per_photo_s / small.wall_per_photo_s
    verdicts = [
        Verdict(
            name="time per photo",
            text=f"{large.wall_per_photo_s:.2f} s at {large.photos}, {ratio:.2f} times that at "
            f"{small.photos}; at most {_RATIO} wanted",
            holds=ratio <= _RATIO,
        ),
        Verdict(
            name="peak memory",
            text=f"{large.peak_gib:.2f} GiB, under {_PEAK_GIB} wanted",
            holds=large.peak_gib < _PEAK_GIB,
        ),
        Verdict(
            name="registered",
            text=f"{large.share:.1%} of {large.photos}, {small.share:.1%} of {small.photos}; "
            f"{large.apart} and {small.apart} are apart from their map",
            holds=large.share >= _REGISTERED * small.share > 0,
        ),
    ]
    if "dask" in runs:
        digests = [content(out / name) for name in ("large", "dask")]
        text = f"{len(digests[0] & digests[1])} maps are the same of {len(digests[0])} and {len(digests[1])}"
        verdicts.append(Verdict(name="the same on Dask", text=text, holds=digests[0] == digests[1]))
    return verdicts


def content(database: Path) -> set[tuple[str, str]]:
    """Ids and digests of the maps of a database."""
    return {(m.map_id, m.content_digest) for m in Database.open(database).snapshot().maps()}


def registered_photos(database: Path) -> set[str]:
    """Names of the photos in its maps."""
    snapshot = Database.open(database).snapshot()
    return {image.name for m in snapshot.maps() for image in snapshot.load_map(m.map_id).images}


def apart(database: Path, album: Album) -> int:
    """Photos over a metre from where the rest of their map is, by robust fits of the maps to the truth."""
    snapshot, count = Database.open(database).snapshot(), 0
    for summary in snapshot.maps():
        images = snapshot.load_map(summary.map_id).images
        centers = np.array([image.cam_from_local.center for image in images])
        truth = np.array([album.truth.images[image.name].cam_from_local.center for image in images])
        count += int((~with_the_rest(centers, truth)).sum())
    return count


def ingested(
    out: Path,
    name: str,
    album: Album,
    facts: Sequence[AlbumFact],
    args: argparse.Namespace,
    extra: Sequence[str],
) -> Ingest:
    """One ingest from an empty database, measured; a run that is measured already is not repeated."""
    log = out / f"{name}.json"
    if log.exists():
        return Ingest(**json.loads(log.read_text(encoding="utf-8")))
    # The folder's name is in the maps, so that it is the same for all that are compared.
    photos, database, so_far = out / f"{name}-files" / "photos", out / name, out / f"{name}-so-far.json"
    spent = Spent.read(so_far)
    if not spent.parts:
        link(album.folder, photos, (f.name for f in facts))
        shutil.rmtree(database, ignore_errors=True)
    spent.parts += 1
    command = [
        *(sys.executable, "-m", "featuredb.cli", "ingest", "photos", str(database), str(photos)),
        *("--workers", str(args.workers), "--max-features", str(args.max_features)),
        *("--quiet", *extra, *args.ingest_option),
    ]
    said = out / f"{name}.txt"  # a line for each photo that is in no map
    with said.open("wb") as file, subprocess.Popen(command, stdout=file) as process:
        watch(process, spent, so_far)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}; see {said}")
    maps = Database.open(database).snapshot().maps()
    run = Ingest(
        photos=len(facts),
        wall_s=spent.wall_s,
        cpu_s=spent.cpu_s,
        peak_gib=spent.peak / 2**30,
        registered=sum(m.images for m in maps),
        apart=apart(database, album),
        maps=len(maps),
        parts=spent.parts,
    )
    log.write_text(json.dumps(asdict(run)) + "\n", encoding="utf-8")
    say(f"{name}: {run}")
    return run


def link(source: Path, target: Path, names: Iterable[str]) -> None:
    """A folder of hard links, made anew; copies where the disk has none."""
    shutil.rmtree(target, ignore_errors=True)
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source / name, target / name)
        except OSError:
            shutil.copyfile(source / name, target / name)


def watch(process: "subprocess.Popen[bytes]", spent: Spent, file: Path) -> None:
    """Add what a process and its descendants take until it ends, and keep the sum in `file` meanwhile."""
    before, start, ours = (spent.wall_s, spent.cpu_s), time.monotonic(), os.times()
    while process.poll() is None:
        pids = family(process.pid)
        spent.peak = max(spent.peak, sum(memory(pid) for pid in pids))
        spent.wall_s = before[0] + time.monotonic() - start
        # The time of a worker that is just ending is nobody's for a moment.
        spent.cpu_s = max(spent.cpu_s, before[1] + sum(_processor_s(pid) for pid in pids))
        spent.write(file)
        time.sleep(_SAMPLE_S)
    spent.wall_s = before[0] + time.monotonic() - start
    now = os.times()
    spent.cpu_s = (
        before[1] + now.children_user + now.children_system - ours.children_user - ours.children_system
    )
    spent.write(file)


def _processor_s(pid: int) -> float:
    """Seconds of a process and of its children that have ended."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(map(int, words[11:15])) / _TICKS


def family(pid: int) -> list[int]:
    """A process and its descendants."""
    found = [pid]
    for parent in found:
        for task in Path(f"/proc/{parent}/task").glob("*/children"):
            try:
                found += [int(child) for child in task.read_text().split()]
            except OSError:
                continue  # it has just ended
    return found


def memory(pid: int) -> int:
    """Proportional set size: pages that processes share are counted once in all."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("growth-scale"))
    parser.add_argument("--size", choices=("short", "full"), default="full")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--world", type=Path, default=None, help="a world of these options, made before")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--max-features", type=int, default=2000, help="of a photo of 640 pixels; default: 2000"
    )
    parser.add_argument("--dask", default="", metavar="ADDRESS", help="ingest once more on this scheduler")
    parser.add_argument(
        "--ingest-option",
        action="append",
        default=[],
        metavar="WORD",
        help="handed on to the ingest; repeat it",
    )
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
