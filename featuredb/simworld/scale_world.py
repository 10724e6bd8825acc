"""Thousands of photos of many districts, cheap to draw: for measuring how the time of an ingest grows.

Every district is a town of its own, a kilometre or two from the next, photographed by a community as the
one of `community`, with as many photos each. So the first 500 photos and all 5,000 are equally dense, and
geotags that are wrong by kilometres point into other districts. Kinds: street, drone. `AlbumFact.batch`
is the district.
"""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.simworld.album import PlannedPhoto, Progress, album_is_complete, write_album
from featuredb.simworld.gathering import named, plan_visits, tagged
from featuredb.simworld.geotags import GeotagOptions
from featuredb.simworld.people import Person, community
from featuredb.simworld.scene import Scene
from featuredb.simworld.sights import find_sights
from featuredb.simworld.surveyed import day_scene
from featuredb.simworld.town import TOWN_PLACE, make_town

_SPACING_DEG = (0.0135, 0.0203)  # 1.5 km north and east at this latitude
_COLUMNS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleOptions:
    """What to write. The same options give the same bytes; more districts keep the photos of the first ones.

    Attributes:
        seed: of everything. districts: number of towns. per_district: photos of each.
        town_size_m: of a district. sights: that people visit in each.
        width: of the widest camera, pixels.
        texel_m: resolution of the painted ground. pieces: of walls and roofs (see `make_town`).
        geotags: how wrong they are.
    """

    seed: int = 3
    districts: int = 10
    per_district: int = 500
    town_size_m: tuple[float, float] = (300.0, 260.0)
    sights: int = 24
    width: int = 640
    texel_m: float = 0.1
    pieces: int = 16
    geotags: GeotagOptions = field(default_factory=lambda: GeotagOptions(sigma_m=8.0, far_share=0.03))

    def __post_init__(self) -> None:
        if not (self.districts > 0 and self.per_district > 0 and self.width >= 64):
            raise InvalidValueError(f"ScaleOptions: value out of range in {self}")

    @classmethod
    def short(cls, seed: int = 3) -> "ScaleOptions":
        """Four small districts of 60 photos."""
        return cls(seed=seed, districts=4, per_district=60, town_size_m=(200.0, 180.0), sights=6, pieces=4)

    def scene(self, key: str) -> Scene:
        """Scenes "d<district>/light/week"; one light in all, since each is painted anew."""
        return day_scene(_district(self, int(key.split("/")[0][1:])), key)


@lru_cache(maxsize=4)
def _district(options: ScaleOptions, number: int) -> Scene:
    row, column = divmod(number, _COLUMNS)
    latitude, longitude, height, epsg = TOWN_PLACE
    place = (latitude + row * _SPACING_DEG[0], longitude + column * _SPACING_DEG[1], height, epsg)
    return make_town(
        options.seed + 100 * number,
        name=f"district {number + 1}",
        size_m=options.town_size_m,
        place=place,
        texel_m=options.texel_m,
        pieces=options.pieces,
    )


def write_scale(
    folder: Path, options: ScaleOptions, workers: int = 0, progress: Progress | None = None
) -> Path:
    """Write the album into `folder`, or what of it is missing there (see `featuredb.simworld.album`).

    Raises:
        OSError: the folder cannot be written.
    """
    if album_is_complete(folder):
        return Path(folder)
    photos = _plan(options, workers)
    return write_album(folder, options, options.scene("d0/0/000"), photos, workers, progress)


def _plan(options: ScaleOptions, workers: int) -> list[PlannedPhoto]:
    """The photos of all districts, planned in a pool of processes, since finding sights takes long."""
    count = min(workers or os.cpu_count() or 1, options.districts)
    if count <= 1:
        return [p for number in range(options.districts) for p in plan_district(options, number)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context) as pool:
        districts = pool.map(plan_district, [options] * options.districts, range(options.districts))
        return [photo for district in districts for photo in district]


def plan_district(options: ScaleOptions, number: int) -> list[PlannedPhoto]:
    """The photos of one district; poses in the local frame of the first."""
    town, first = options.scene(f"d{number}/0/000"), options.scene("d0/0/000")
    people = tuple(_of_district(p, number) for p in community(options.width))
    seed = options.seed + 100 * number
    places = find_sights(town, options.sights, seed)
    photos = plan_visits(
        town, people, places, options.per_district, seed, f"d{number}", first_visit=100_000 * number
    )
    rng = np.random.default_rng((seed, 58))
    photos = named(tagged(town, photos, people, options.geotags, rng), seed)
    return [
        replace(
            p,
            # All days have the light of noon: painting the shadows again costs more than a hundred photos.
            scene=f"d{number}/2/{p.scene.split('/')[2]}",
            fact=replace(p.fact, home=True, batch=number),
            scene_from_home=town.frame.enu_from(first.frame),
        )
        for p in photos
    ]


def _of_district(person: Person, number: int) -> Person:
    return replace(person, name=f"{person.name}{number + 1}")
