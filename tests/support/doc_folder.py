"""The folder in which the documentation's commands run: what they name is there, of one simulated town.

    photo.jpg                 a photo of the town that no map was made of
    home/photos/park          photos of a flight, and table.csv beside the folder; ~ of the commands is home
    photos                    the same photos
    scan.laz                  an airborne scan; tile1.laz and tile2.laz are its halves
    film.mp4, film.srt        a film of another flight, and its telemetry
    gcp_list.txt              ground control points, marked in the photos of the park

The quick start is run first, and leaves what the other pages begin with: my.db with MAP, of the photos of the
park. `go_on` adds what comes from elsewhere: the scan in my.db, OTHER_MAP of another flight, in quarantine,
track.csv of the film, and colmap and opensfm, MAP as models of those programs that do not say how surely they
lie there.
"""

import csv
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import numpy as np
from PIL import Image

from featuredb.cli.main import main
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.laser.airborne import AirborneScan, AirborneScanOptions, scan_town
from featuredb.simworld.scan_world import write_scan
from featuredb.simworld.world import Truth, World, WorldOptions, town_of, write_world
from featuredb.store import Database
from featuredb.store.scans import list_scans
from tools.worlds.film_world import FilmOptions, PathOptions, write_film

_LICENCE = "CC-BY-4.0"
_TOWN = WorldOptions(
    town_size_m=(190.0, 170.0),
    flight=FlightOptions(lines=3, per_line=3, oblique=0, width=512, gps_error="rtk"),
    queries=1,
    query_width=512,
    street=0,
    negatives_per_kind=0,
    workers=1,
)
_WALK = WorldOptions(
    town_size_m=_TOWN.town_size_m,
    flight=FlightOptions(
        lines=2, per_line=3, oblique=0, width=512, height_m=60.0, gps_error="rtk", center_m=(20.0, 10.0)
    ),
    queries=0,
    street=0,
    negatives_per_kind=0,
    workers=1,
)
# Few frames, soon made. It looks down, so that its rate is no hindrance, and turns: a line places no map.
_FILM = FilmOptions(
    world=_TOWN,
    path=PathOptions(
        duration_s=3.0,
        half_extent_m=(22.0, 18.0),
        heights_m=(58.0, 62.0),
        speed_m_s=20.0,
        down_deg=(80.0, 88.0),
        river=False,
    ),
    frames=24,
    rate_hz=8.0,
    width=480,
    height=270,
    samples=1,
)
_FIRST_NAME = 27  # so that DJI_0034.JPG registers best


def make_folder(folder: Path) -> Path:
    """Fill `folder`."""
    park = folder / "home" / "photos" / "park"
    town = write_world(folder / "world", _TOWN)
    names = _take_photos(town, park)
    (folder / "photos").symlink_to(park)
    _write_table(park.parent / "table.csv", town.truth, names)
    shutil.copy(town.images("queries")[0], folder / "photo.jpg")
    scan = scan_town(town_of(_TOWN), AirborneScanOptions(density_per_m2=4.0))
    write_scan(folder / "scan.laz", scan)
    _write_tiles(folder)
    (folder / "gcp_list.txt").write_text(_control(town.truth, names, scan))
    write_film(folder / "world", _FILM, workers=1)
    for name in ("film.mp4", "film.srt"):
        shutil.move(folder / "world" / name, folder / name)
    shutil.rmtree(folder / "world")
    _take_photos(write_world(folder / "world", _WALK), folder / "home" / "photos" / "walk")
    shutil.rmtree(folder / "world")
    return folder


def go_on(folder: Path) -> None:
    """Add what other pages than the first one have from elsewhere."""
    with inside(folder):
        _run("lidar add my.db scan.laz --quiet")
        _run("ingest photos my.db home/photos/walk --quiet")
        values = placeholders(Path("my.db"))
        database = Database.open("my.db")
        database.set_status([values["OTHER_MAP"]], "quarantined", "nobody has confirmed it")
        _run(f"track my.db film.mp4 --map {values['MAP']} --end 1 --out track.csv")
        for program in ("colmap", "opensfm"):
            _run(f"export my.db exported --format {program} --maps {values['MAP']}")
            shutil.move(f"exported/{values['MAP']}", program)
            Path(program, "georeference.json").unlink()
            shutil.rmtree("exported")


def _run(arguments: str) -> None:
    assert main(arguments.split()) == 0, arguments


@contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in `folder`."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def placeholders(database: Path) -> dict[str, str]:
    """What a reader would write for the words in capitals, of a database as it is now."""
    values = {"HOST": "127.0.0.1", "V": "1"}
    if not database.exists():
        return values
    opened = Database.open(database)
    for summary in opened.snapshot().maps():
        values[{"park": "MAP", "walk": "OTHER_MAP"}.get(summary.name, summary.name)] = summary.map_id
    for scan in list_scans(opened):
        values["SCAN"] = scan.scan_id
    return values


def _take_photos(world: World, folder: Path) -> dict[str, str]:
    """The survey's photos as a drone names them, with a licence; their names by those of the world."""
    folder.mkdir(parents=True)
    names = {}
    for number, path in enumerate(world.images("drone"), start=_FIRST_NAME):
        name = f"DJI_{number:04}.JPG"
        with Image.open(path) as image:
            exif = image.getexif()
            exif[0x8298] = _LICENCE  # Copyright
            image.save(folder / name, "JPEG", quality=95, exif=exif)
        names[path.relative_to(world.folder).as_posix()] = name
    return names


def _write_table(path: Path, truth: Truth, names: dict[str, str]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["path", "lat", "lon", "accuracy", "owner", "licence"])
        for name, photo in names.items():
            image = truth.images[name]
            lat, lon, _ = truth.frame.geodetic_from_enu(image.cam_from_local.center)
            writer.writerow([f"park/{photo}", f"{lat:.8f}", f"{lon:.8f}", 2.0, "A. Person", _LICENCE])


def _write_tiles(folder: Path) -> None:
    with laspy.open(folder / "scan.laz") as reader:
        las = reader.read()
    west = las.x < np.median(las.x)
    for name, chosen in (("tile1.laz", west), ("tile2.laz", ~west)):
        tile = laspy.LasData(las.header)
        tile.points = las.points[chosen]
        tile.write(folder / name)


def _control(truth: Truth, names: dict[str, str], scan: AirborneScan) -> str:
    """OpenDroneMap's file: ground points of the scan, marked where the true cameras see them."""
    ground = np.flatnonzero(scan.classification == 2)
    chosen = ground[np.random.default_rng(3).choice(len(ground), 400, replace=False)]
    lines, points = [f"EPSG:{truth.epsg}"], 0
    for local, utm in zip(scan.xyz[chosen], scan.utm()[chosen], strict=True):
        marks = []
        for name, photo in names.items():
            image = truth.images[name]
            seen = image.cam_from_local.act(local[None])
            u, v = image.camera.project(seen)[0]
            if 40 < u < image.camera.width - 40 and 40 < v < image.camera.height - 40:
                marks.append(f"{utm[0]:.3f} {utm[1]:.3f} {utm[2]:.3f} {u:.2f} {v:.2f} {photo} gcp{points:02}")
        if len(marks) >= 6 and points < 8:
            lines += marks
            points += 1
    return "\n".join(lines) + "\n"
