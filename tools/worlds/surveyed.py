"""What worlds of contributed photos share: a town on many days, and the anchored survey of a part of it."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache

import numpy as np

from featuredb.simworld.flight import FlightOptions, survey
from featuredb.simworld.town.scene import DayOptions, Scene, another_day
from featuredb.simworld.town.town import OTHER_TOWN_PLACE, TOWN_PLACE, make_town
from tools.worlds.album import AlbumFact, Geotag, PlannedPhoto

# Suns by the hour, town axes; index 0 is the scene's own.
_SUNS = (None, (0.62, -0.42, 0.62), (0.10, -0.55, 0.83), (-0.66, -0.30, 0.55))
_SEASONS = ((1.0, 1.0, 1.0), (1.05, 1.08, 0.9), (1.35, 0.95, 0.6), (0.9, 0.95, 0.9))
_FIRST = datetime(2024, 3, 2, 0, 0, tzinfo=UTC)
DAYS = 730
_OTHER_SEED = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class TownOptions:
    """What to write. The same options give the same bytes.

    Attributes:
        seed: of everything. town_size_m: width and height of the town.
        flight: the anchored survey. width: of people's widest camera, pixels.
        texel_m: resolution of the painted ground. pieces: of walls and roofs (see `make_town`).
    """

    seed: int
    town_size_m: tuple[float, float]
    flight: FlightOptions
    width: int = 1200
    texel_m: float = 0.06
    pieces: int = 4

    def scene(self, key: str) -> Scene:
        """Scenes "home/light/week" and, of another town, "away/light/week"."""
        return day_scene(town_of(self, away=key.startswith("away/")), key)


@lru_cache(maxsize=4)
def town_of(options: TownOptions, *, away: bool = False) -> Scene:
    """The town as it was built, or another one elsewhere on Earth."""
    return make_town(
        options.seed + (_OTHER_SEED if away else 0),
        size_m=options.town_size_m,
        place=OTHER_TOWN_PLACE if away else TOWN_PLACE,
        texel_m=options.texel_m,
        pieces=options.pieces,
    )


def day_key(town: str, day: int, hour: float) -> str:
    """Key of the scene of a town on a day (0 to 729) at an hour; sorts by what is dear to paint.

    Days of a week share their parked cars.
    """
    light = 1 if hour < 11 else 2 if hour < 15 else 3
    return f"{town}/{light}/{day // 7:03d}"


def day_scene(base: Scene, key: str) -> Scene:
    """The scene of a key made by `day_key`; "town/0/000" is the base itself."""
    _, light, week = key.split("/")
    sun = _SUNS[int(light)]
    if sun is None:
        return base
    season = _SEASONS[(int(week) // 13) % 4]
    return another_day(base, DayOptions(seed=int(week) + 1, to_sun=sun, leaf_tint=season))


def moment(day: int, hour: float) -> datetime:
    """Time of a day of the two years."""
    return _FIRST + timedelta(days=day, hours=hour)


def survey_photos(
    scene: Scene, flight: FlightOptions, seed: int, *, folder: str = "survey"
) -> list[PlannedPhoto]:
    """An anchored survey as planned photos: full EXIF, positions as its receiver believes them."""
    photos = []
    for i, shot in enumerate(survey(scene, flight, seed)):
        shot = replace(shot, name=f"{folder}/SW_{i + 1:04d}.jpg")
        assert shot.gps_enu is not None
        latitude, longitude, height = scene.frame.geodetic_from_enu(shot.gps_enu)
        fact = AlbumFact(
            name=shot.name,
            photo_id=f"{folder}-{i + 1}",
            kind="survey",
            owner="survey office",
            licence="CC-BY-4.0",
            time=shot.time,
        )
        tag = Geotag(latitude_deg=float(latitude), longitude_deg=float(longitude), height_m=float(height))
        photos.append(PlannedPhoto(shot=shot, scene="home/0/000", fact=fact, geotag=tag))
    return photos


@lru_cache(maxsize=64)
def photo_ids(seed: int, count: int) -> tuple[str, ...]:
    """Numbers as a photo site gives them, all different."""
    rng = np.random.default_rng((seed, 57))
    return tuple(str(n) for n in rng.choice(900_000_000, count, replace=False) + 100_000_000)
