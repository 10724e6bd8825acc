"""Street photos of a town by ten people: visits to a few places, poor geotags on a third."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from featuredb.simworld.flight import FlightOptions
from tools.worlds.album import PlannedPhoto, write_album
from tools.worlds.gathering import named, plan_visits, tagged
from tools.worlds.geotags import GeotagOptions
from tools.worlds.people import Person, community
from tools.worlds.sights import find_sights
from tools.worlds.surveyed import TownOptions

_PEOPLE = 10
_TAGGED = 1.0 / 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetOptions(TownOptions):
    """What to write: the town of `WorldOptions.short` as people see it from its streets.

    Attributes:
        pieces: so many that no two walls of a house share their bricks: maps of those that do are joined
            wrongly, which is not what is asked here.
        photos: of all people. sights: places that they visit, the k-th 1/k as often as the first.
        geotag_sigma_m: per horizontal axis; a third of the photos has a geotag.
    """

    seed: int = 1
    town_size_m: tuple[float, float] = (260.0, 230.0)
    flight: FlightOptions = field(default_factory=FlightOptions)
    pieces: int = 8
    width: int = 1000
    photos: int = 60
    sights: int = 4
    geotag_sigma_m: float = 10.0


def write_street_album(folder: Path, options: StreetOptions, workers: int = 0) -> Path:
    """Write the photos with their table and truth; an album that is complete is kept."""
    return write_album(folder, options, partial(_planned, options), workers)


def _planned(options: StreetOptions) -> list[PlannedPhoto]:
    home, people = options.scene("home/0/000"), _walkers(options.width)
    places = find_sights(home, options.sights, options.seed)
    photos = plan_visits(home, people, places, options.photos, options.seed, "home", by_rank=True)
    geotags = GeotagOptions(sigma_m=options.geotag_sigma_m, far_share=0.0)
    rng = np.random.default_rng((options.seed, 58))
    return named(tagged(home, photos, people, geotags, rng), options.seed)


def _walkers(width: int) -> tuple[Person, ...]:
    """Ten people without drones; who owns nothing else borrows a phone."""
    everybody = community(width)
    phones = [person.ground for person in everybody if person.ground is not None]
    return tuple(
        replace(
            person,
            drone=None,
            ground=person.ground or phones[k % len(phones)],
            tags=_TAGGED,
            exif="full" if person.exif == "no_gps" else person.exif,
        )
        for k, person in enumerate(everybody[:_PEOPLE])
    )
