"""What becomes of a folder of photos whose positions nobody knows: maps, and photos in them.

    python -m tools.made_maps --photos FOLDER --work FOLDER [--gcp FILE]

The folder is ingested into a new database.
Prints how many photos are in the largest map, in any map, and in how many, placed or not, and
what the placement of the first leaves between positions and the map (of --gcp: ground control points, of
which no other position is known).
"""

import io
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from PIL import Image

from featuredb.features.exif.write import EXIF_PREFIX, with_app1
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store import Database
from tools.commands import featuredb
from tools.figures import study_parser, write_figures

_SUFFIXES = (".jpg", ".jpeg", ".png")
_GPS_IFD = 34853


def main() -> None:
    parser = study_parser(__doc__, "--photos", "--work")
    parser.add_argument("--gcp", type=Path, default=None, metavar="FILE", help="control points of the photos")
    args = parser.parse_args()
    control = () if args.gcp is None else ("--gcp", str(args.gcp))
    made = make(args.work / "db", "photos", args.photos, control)
    write_figures(args.json, made | {"photos": len(photo_names(args.photos))})


def make(database: Path, kind: str, source: Path, more: Sequence[str] = ()) -> dict[str, float]:
    """Ingest photos or a film, with more arguments, and count what is in maps.

    Photos in the largest map and in any (mapped), maps with a place and without, those placed, seconds of the
    command, and the root mean square that is left of the first placed map.
    """
    start = time.monotonic()
    featuredb("ingest", kind, str(database), str(source), "--quiet", *more, refusals=(1,))
    seconds = time.monotonic() - start
    snapshot = Database.open(database).snapshot()
    placed = snapshot.maps()
    sizes = [*(m.images for m in placed), *(m.images for m in snapshot.unplaced_maps())]
    residual_m = [snapshot.load_map(m.map_id).placement.residual_rms_m for m in placed[:1]]
    return {
        "largest": max(sizes, default=0),
        "mapped": sum(sizes),
        "maps": len(sizes),
        "placed": len(placed),
        "seconds": seconds,
        "residual_m": residual_m[0] if residual_m else float("nan"),
    }


def once(target: Path, make: Callable[[Path], object]) -> Path:
    """`target`, which `make` makes once under another name: what is half made is made anew."""
    if not target.exists():
        making = target.with_name(f"making{target.suffix}")
        shutil.rmtree(making, ignore_errors=True)
        make(making)
        making.rename(target)
    return target


def with_scan(source: Path, scan: Path, target: Path) -> Path:
    """A copy of a database with a scan, made once."""

    def add(making: Path) -> None:
        shutil.copytree(source, making)
        featuredb("lidar", "add", str(making), str(scan), "--quiet")

    return once(target, add)


def all_maps(database: Path) -> list[AnyMap]:
    """The maps of a database, with a place and without."""
    snapshot = Database.open(database).snapshot()
    ids = [m.map_id for m in snapshot.maps()] + [m.map_id for m in snapshot.unplaced_maps()]
    return [snapshot.load_any(one) for one in ids]


def photo_names(folder: Path) -> list[str]:
    """Names of the photos of a folder, sorted."""
    return sorted(p.name for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES)


def position_table(folder: Path, rows: Iterable[tuple[object, ...]]) -> Path:
    """A table beside photos: name, latitude, longitude (degrees), height, and both accuracies (m)."""
    lines = ["path,lat,lon,height,accuracy,accuracy_height", *(",".join(map(str, row)) for row in rows)]
    table = folder / "table.csv"
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return table


def copied(folder: Path, names: Sequence[str], target: Path, *, strip: bool) -> Path:
    """Copies of photos, without positions where `strip` says so; the pictures stay bit for bit."""
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        data = (folder / name).read_bytes()
        (target / name).write_bytes(without_position(data) if strip else data)
    return target


def without_position(jpeg: bytes) -> bytes:
    """A JPEG without the GPS directory of its EXIF and with empty XMP; the picture as it was."""
    with Image.open(io.BytesIO(jpeg)) as image:
        exif = image.getexif()
    exif.pop(_GPS_IFD, None)
    return with_app1(jpeg, exif.tobytes().removeprefix(EXIF_PREFIX), b"")


if __name__ == "__main__":
    main()
