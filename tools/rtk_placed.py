"""Positions good to 2 cm, said in each way that makers and tables have: believed, and how right is the map?

1. A flight over the simulated town; its photos get positions with 2 cm of noise per axis, the same for all.
2. Each way of saying so is ingested by itself: XMP of DJI, of Autel, of Pix4D (which senseFly and Parrot
   write), EXIF's error of positioning, a table's columns, geo.txt. Beside XMP, EXIF says 5 m.
3. Control points, of 2 cm and marked to half a pixel, place the right flight, and one whose GPS heights
   are all 20 m too high: that and nothing else has to be told.

Believed is what gives a map whose place is known to 4 cm (a standard deviation per axis).
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import TrueImage, Truth, World, WorldOptions, open_world, town_of, write_world
from featuredb.store import Database
from tools.anchor_simworld import camera_errors
from tools.commands import featuredb, first_map, largest_map, once
from tools.figures import median, say, study_parser, write_figures
from tools.photo_files import copied, position_table, with_place
from tools.worlds.sights import SeenPlaces

_SEED = 1
_SIGMA_M, _OTHERWISE_M, _DATUM_M = 0.02, 5.0, 20.0
_RADIUS_68 = float(np.sqrt(-2.0 * np.log(1.0 - 0.68)))
_XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {words}/></rdf:RDF></x:xmpmeta>'
_RTK = '{0}:RtkFlag="50" {0}:RtkStdLat="0.02" {0}:RtkStdLon="0.02" {0}:RtkStdHgt="0.02"'
_TAGS = {
    "dji": _RTK.format("drone-dji"),
    "autel": _RTK.format("drone"),
    "pix4d": 'Camera:GPSXYAccuracy="0.02" Camera:GPSZAccuracy="0.02"',
    "exif": "",
}
_WAYS = (*_TAGS, "table", "geo_txt")
_MOST = ("--max-features", "4000", "--quiet")
_POINTS, _MARK_PX = 9, 0.5


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    flight = FlightOptions(lines=3, per_line=5, oblique=3, width=1024)
    options = replace(WorldOptions.short(_SEED), flight=flight, queries=0, street=0, negatives_per_kind=0)
    inputs = args.inputs / f"rtk-flight-{_SEED}"
    world = open_world(once(inputs, lambda making: write_world(making, options)))
    rng = np.random.default_rng((_SEED, 11))
    images = world.truth.group("drone")
    places = np.array([image.cam_from_local.center for image in images])
    places = places + rng.normal(0.0, _SIGMA_M, places.shape)
    found = []
    for way in _WAYS:
        source = said(world, places, way, args.work / way)
        found.append(ingested(args.work / f"{way}.db", source, world.truth))
        say(f"{way}: {found[-1]}")
    figures = {
        "worst_m": max(one["off_m"] for one in found),
        "worst_sigma_m": max(one["sigma_m"] for one in found),
        "active": sum(one["active"] for one in found),
    }
    write_figures(args.json, figures | with_control(world, options, places, args.work, rng))


def said(world: World, places: FloatArray, way: str, folder: Path) -> Path:
    """The flight's photos with these positions (n, 3), said in a way; what to ingest."""
    images = world.truth.group("drone")
    names = [Path(image.name).name for image in images]
    if way in _TAGS:
        folder.mkdir(parents=True, exist_ok=True)
        for name, place in zip(names, places, strict=True):
            error_m = _SIGMA_M * _RADIUS_68 if way == "exif" else _OTHERWISE_M
            data = (world.folder / "drone" / name).read_bytes()
            xmp = _XMP.format(words=_TAGS[way]).encode()
            told = with_place(data, world.truth.frame, place, error_m, xmp, "ellipsoid", heading_deg=0.0)
            (folder / name).write_bytes(told)
        return folder
    copied(world.folder / "drone", names, folder, strip=True)
    rows = list(zip(names, world.truth.frame.geodetic_from_enu(places).tolist(), strict=True))
    if way == "table":
        return position_table(folder, [(name, *place, _SIGMA_M, _SIGMA_M) for name, place in rows])
    angles_and_sigmas = f"0 0 0 {_SIGMA_M} {_SIGMA_M}"
    lines = [f"{name} {lon:.10f} {lat:.10f} {up:.4f} {angles_and_sigmas}" for name, (lat, lon, up) in rows]
    file = folder / "geo.txt"
    file.write_text("\n".join(["EPSG:4326", *lines]) + "\n", encoding="utf-8")
    return file


def ingested(database: Path, source: Path, truth: Truth) -> dict[str, float]:
    """Whether a map answers, how far off its cameras are (median), and to what its place is known."""
    trust = ("--trust-geotags",) if source.is_file() else ()
    featuredb("ingest", "photos", str(database), str(source), *trust, *_MOST)
    made = largest_map(database)
    evidence = made.placement.evidence
    return {
        "off_m": float(np.median(camera_errors(made, truth)[0])),
        "active": int(made.status == "active"),
        "sigma_m": float(np.hypot(evidence["bias_sigma_m"][0], evidence["noise_m"][0])),
    }


def with_control(
    world: World, options: WorldOptions, places: FloatArray, work: Path, rng: np.random.Generator
) -> dict[str, float]:
    """What is told of the heights' offset: with a datum that is 20 m off, and of right positions."""
    gcp = work / "gcp_list.txt"
    gcp.write_text(control_text(world, options, rng), encoding="utf-8")
    right = first_map(Database.open(work / "dji.db"))
    featuredb("register", str(work / "dji.db"), right.map_id, "--gcp", str(gcp))
    high = said(world, places + np.array([0.0, 0.0, _DATUM_M]), "dji", work / "high")
    featuredb("ingest", "photos", str(work / "high.db"), str(high), "--gcp", str(gcp), *_MOST)
    placed = [first_map(Database.open(work / f"{name}.db")).placement for name in ("dji", "high")]
    notes = [[note for note in one.evidence["notes"] if "GPS" in note] for one in placed]
    told = [re.search(r"heights are ([0-9.]+) m above", note) for note in notes[1]]
    metres = [float(one[1]) for one in told if one is not None]
    return {"told_m": median(metres[:1]), "told_wrongly": len(notes[0]) + len(notes[1]) - len(metres)}


def control_text(world: World, options: WorldOptions, rng: np.random.Generator) -> str:
    """OpenDroneMap's list: spots of the ground around the middles of photos, marked where they are seen."""
    scene, images = town_of(options), world.truth.group("drone")
    views = [SeenPlaces(scene, image.camera, image.cam_from_local) for image in images]
    lines = [f"EPSG:{world.truth.epsg}"]
    for k, own in enumerate(np.linspace(0, len(images) - 5, _POINTS).astype(int)):
        height, width = views[own].depth.shape
        (spot,) = views[own].places(np.array([[width // 2 + 0.5, height // 2 + 0.5]]))
        utm = world.truth.frame.utm_from_enu(spot + rng.normal(0.0, _SIGMA_M, 3), world.truth.epsg)
        for image, view in zip(images, views, strict=True):
            xy = marked(image, view.depth, spot)
            if xy is not None:
                x, y = xy + rng.normal(0.0, _MARK_PX, 2)
                words = " ".join(f"{v:.4f}" for v in (*utm, x, y))
                lines.append(f"{words} {Path(image.name).name} point{k}")
    return "\n".join(lines) + "\n"


def marked(image: TrueImage, depth: np.ndarray, spot: FloatArray) -> FloatArray | None:
    """Where a photo shows a spot (2,), None where it does not."""
    inside = image.cam_from_local.act(spot)
    (xy,) = image.camera.project(inside)
    if not ((xy >= 10) & (xy < [image.camera.width - 10, image.camera.height - 10])).all():  # or behind: NaN
        return None
    column, row = xy.astype(int)
    return xy if abs(float(depth[row, column]) - inside[2]) < 0.1 else None


if __name__ == "__main__":
    main()
