"""The viewer's pictures in the docs, of the demo's town with its scan and a film over it.

featuredb demo --out featuredb-demo
python -m tools.viewer_pictures featuredb-demo --out docs/figures

Works on a copy of the demo's database, in WORK (default: featuredb-demo/viewer); needs the extra lidar, and
Chromium. What WORK has already is used again.
"""

import argparse
import io
import shutil
from dataclasses import replace
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page

from featuredb.lidar.add import add_scan
from featuredb.lidar.options import OrthoChoice
from featuredb.simworld.scan_world import ORTHO_FILE, SCAN_FILE, write_lidar
from featuredb.simworld.world import WorldOptions
from featuredb.store import Database
from reloc.localiser import Localiser
from reloc.tracking.track_video import track_video
from reloc.tracking.trajectory.files import write_trajectory
from reloc.tracking.trajectory.read import read_trajectory_csv
from reloc.viewer.scene import build_scene
from tools.viewer_page import open_page, settled
from tools.worlds.film_world import FILM_FILE, FilmOptions, write_film
from tools.worlds.flight_path import PathOptions

_QUALITY = 80
# Twelve seconds; two of them show another town, which no map has.
_FILM = {"frames": 120, "rate_hz": 10.0, "samples": 1, "cut": (55, 75)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the viewer's pictures.")
    parser.add_argument("demo", type=Path, help="folder of `featuredb demo`")
    parser.add_argument("--work", type=Path, help="default: viewer in that folder")
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    args = parser.parse_args()
    work = args.work or args.demo / "viewer"
    database, track = make_town(args.demo, work)
    scene = build_scene(database, database.snapshot(), [read_trajectory_csv(track)])
    queries = sorted((args.demo / "world" / "queries").iterdir())
    args.out.mkdir(parents=True, exist_ok=True)
    with open_page(database, scene, args.demo / "world" / "drone") as page:
        take_pictures(page, queries[2], args.out)


def make_town(demo: Path, work: Path) -> tuple[Database, Path]:
    """The demo's database with the scan of its town, and the track of a film over it."""
    world = WorldOptions.short(1)
    world = replace(world, flight=replace(world.flight, gps_error="none"))
    if not (work / "town.db").exists():
        shutil.copytree(demo / "db", work / "town.db")
    database = Database.open(work / "town.db")
    if not (work / "lidar" / ORTHO_FILE).exists():
        write_lidar(work / "lidar", world)
    add_scan(database, [work / "lidar" / SCAN_FILE], ortho=OrthoChoice(path=work / "lidar" / ORTHO_FILE))
    track = work / "film.csv"
    if not track.exists():
        path = PathOptions(duration_s=12.0, half_extent_m=(45.0, 25.0), river=False)
        folder = write_film(work / "film", FilmOptions(world=world, path=path, **_FILM))
        found = track_video(folder / FILM_FILE, Localiser.open(database).areas_of(None))
        write_trajectory(track, found.trajectory)
    return database, track


def take_pictures(page: Page, query: Path, out: Path) -> None:
    """An answer in plan, photo and scan in space, a track in colours by height."""
    page.locator("#size").fill("3")
    page.uncheck("#kinds label:has-text('tracks') input")
    page.set_input_files("#file", query)
    page.wait_for_selector("#panel .good")
    _save(page, out / "viewer_answer.jpg")

    page.click("#panel button[aria-label=Close]")
    page.click("#view-all")
    page.click("#view-space")
    page.evaluate(
        "window.featuredb.then((v) => { const photo = v.place.maps[0].photos[8];"
        "v.openPhoto(v.place.maps[0], photo);"
        "const [east, north, up] = photo.center; v.stage.goTo([east + 30, north - 25, up - 45], 190, 0); })"
    )
    page.wait_for_selector("#picture img")
    _save(page, out / "viewer_space.jpg")

    page.click("#panel button[aria-label=Close]")
    page.check("#kinds label:has-text('tracks') input")
    page.click("#view-plan")
    page.select_option("#colour", "height")
    page.locator("#time").fill("4.2")
    page.click("#view-all")
    page.evaluate("window.featuredb.then((v) => v.stage.goTo(v.player.frame.pose.center, 200, 0))")
    _save(page, out / "viewer_track.jpg")


def _save(page: Page, path: Path) -> None:
    page.mouse.move(140, 715)  # over no photo and no control
    settled(page)
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(path, quality=_QUALITY, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
