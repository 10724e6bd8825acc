"""Photos of a rolling shutter, placed by positions alone: what answers, and is it inside its bounds?

1. One frame a second of the simulated films, smooth and jerky, whose rows are read out over 30 ms.
2. Each flight is ingested as photos with EXIF, by a drone's receiver (1.5 m that wander, 0.3 s late) and by
   RTK (2 cm, stated).
3. Each map that answers is compared with the truth: the squared errors of position and of orientation of its
   cameras by their covariance, at the median camera, against 99.9 %.
"""

from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.camera.photograph import Device, Shot, exif_of, jpeg_bytes
from featuredb.simworld.world import WorldOptions, in_order, town_of
from featuredb.store import Database
from tools.commands import featuredb, once
from tools.figures import say, study_parser, write_figures
from tools.laser_truth import camera_squares
from tools.photo_files import with_place
from tools.worlds.film_world import (
    FilmOptions,
    FlightStyle,
    PathOptions,
    film_frame,
    flight_path,
    wandering_errors,
)

_PHOTOS, _SEEDS = 24, (1, 2)
_READOUT_S = 0.03  # from the first row to the last
_STYLES: tuple[FlightStyle, ...] = ("smooth", "jerky")
_RECEIVER_M, _LATE_S, _RTK_M = 1.5, 0.3, 0.02
_START = datetime(2025, 6, 21, 12, 40, 3, tzinfo=UTC)
_OUTSIDE = float(chi2.ppf(0.999, 3))


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    figures = {"flights": 0, "active": 0, "outside": 0, "held_back": 0, "unnamed": 0, "worst_squared": 0.0}
    for style, seed in product(_STYLES, _SEEDS):
        film = film_options(style, seed)
        pictures = drawn(film, args.inputs / f"rolling-{style}-{seed}-{_PHOTOS}")
        for receiver in ("plain", "rtk"):
            name = f"{style}-{seed}-{receiver}"
            photos = tagged(film, pictures, receiver == "rtk", args.work / name)
            words = ("ingest", "photos", str(args.work / f"{name}.db"), str(photos))
            told = featuredb(*words, "--max-features", "4000", "--quiet", refusals=(1,))
            maps = Database.open(args.work / f"{name}.db").snapshot()
            squares = [normalised(film, maps.load_map(m.map_id)) for m in maps.maps() if m.status == "active"]
            figures["flights"] += 1
            figures["active"] += bool(squares)
            figures["outside"] += sum(max(one) > _OUTSIDE for one in squares)
            figures["held_back"] += not squares
            figures["unnamed"] += "rolling shutter" not in told.stdout + told.stderr
            figures["worst_squared"] = max([figures["worst_squared"], *map(max, squares)])
            say(f"{name}: squared errors of position and orientation ({_OUTSIDE:.1f} is 99.9 %): {squares}")
    write_figures(args.json, figures)


def film_options(style: FlightStyle, seed: int) -> FilmOptions:
    """A film with a frame a second."""
    return FilmOptions(
        world=WorldOptions.short(1),
        path=PathOptions(seed=seed, style=style, half_extent_m=(32.0, 26.0)),
        frames=_PHOTOS,
        rate_hz=1.0,
        width=960,
        height=540,
        samples=2,
        readout_s=_READOUT_S,
    )


def drawn(film: FilmOptions, folder: Path) -> Path:
    """The film's frames as JPEG with EXIF of a camera and times; what is there is taken as it is."""

    def draw(making: Path) -> None:
        making.mkdir(parents=True)
        for k, data in enumerate(in_order(partial(_jpeg, film), film.frames)):
            (making / f"{k:04d}.jpg").write_bytes(data)

    return once(folder, draw)


def _jpeg(film: FilmOptions, frame: int) -> bytes:
    device = Device(make="Maker", model="Film", camera=film.camera, focal_mm=4.5, focal_35mm=26)
    time_s = film.time_s(frame)
    shot = Shot(
        name=f"{frame:04d}.jpg",
        device=device,
        cam_from_local=flight_path(film).pose(time_s),
        time=_START + timedelta(seconds=time_s),
        seed=frame,
    )
    return jpeg_bytes(film_frame(film, frame), exif_of(shot, None), 92)


def tagged(film: FilmOptions, pictures: Path, rtk: bool, folder: Path) -> Path:
    """The pictures with positions as a receiver gives them."""
    folder.mkdir(parents=True, exist_ok=True)
    frame, rng = town_of(film.world).frame, np.random.default_rng((film.path.seed, 74))
    sigma, late_s, keep = (_RTK_M, 0.0, 0.0) if rtk else (_RECEIVER_M, _LATE_S, np.exp(-1.0 / 20.0))
    for k, error in enumerate(wandering_errors(rng, sigma, keep, film.frames)):
        place = flight_path(film).pose(film.time_s(k) - late_s).center + error
        picture = pictures / f"{k:04d}.jpg"
        told = with_place(picture.read_bytes(), frame, place, 1.51 * _RTK_M if rtk else None)
        (folder / picture.name).write_bytes(told)
    return folder


def normalised(film: FilmOptions, feature_map: FeatureMap) -> tuple[float, float]:
    """Squared errors of position and orientation by their covariance, at the median camera."""
    frames = {image.name: int(Path(image.name).stem) for image in feature_map.images}
    true = {name: flight_path(film).pose(film.time_s(frame)) for name, frame in frames.items()}
    squares = camera_squares(feature_map, town_of(film.world).frame, true)
    return float(np.median(squares["position"])), float(np.median(squares["orientation"]))


if __name__ == "__main__":
    main()
