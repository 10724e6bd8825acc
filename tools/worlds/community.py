"""A community's photos of a town that a survey has mapped in part: twelve owners, two years, the rest.

Kinds of photos (`AlbumFact.kind`): survey; street, drone (the town's own, what growth is measured on);
other_town; copy (a re-upload by somebody else); indoor, portrait (belong nowhere).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.camera.photograph import look_pose
from featuredb.simworld.flight import FlightOptions, shot_seed
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import DAYS, PlannedPhoto, Subject, TownOptions, moment, renamed, survey_photos
from tools.worlds.edits import Edit
from tools.worlds.gathering import named, plan_visits, tagged
from tools.worlds.people import ACCURACY_SHARE, GeotagOptions, Person, community, geotag_at, planned
from tools.worlds.sights import find_sights

# Of another town's visits: claimed here, or at their own place; the rest not at all.
_TAGGED_HERE, _TAGGED_THERE = 0.6, 0.8
_PEOPLE = 10
_TAGGED, _STREET_SIGMA_M = 1.0 / 3.0, 10.0  # geotags of street photos


@dataclass(frozen=True, slots=True, kw_only=True)
class CommunityOptions(TownOptions):
    """What to write; the survey is of most of what people visit.

    Attributes:
        photos: of the town, by the twelve. other_town: photos of another town.
        copies, indoor, portraits: numbers of re-uploads, indoor shots, portraits.
        sights: places that people visit.
    """

    seed: int = 1
    town_size_m: tuple[float, float] = (260.0, 230.0)
    flight: FlightOptions = field(
        default_factory=lambda: FlightOptions(
            lines=4, per_line=6, oblique=4, width=1200, gps_error="rtk", center_m=(-25.0, 10.0)
        )
    )
    photos: int = 48
    other_town: int = 12
    copies: int = 6
    indoor: int = 2
    portraits: int = 2
    sights: int = 6


def community_album(options: CommunityOptions) -> list[PlannedPhoto]:
    """All photos."""
    survey = survey_photos(options.scene("home/0/000"), options.flight, options.seed)
    return survey + plan_community(options)


def plan_community(options: CommunityOptions) -> list[PlannedPhoto]:
    """All photos but the survey's."""
    home, away = options.scene("home/0/000"), options.scene("away/0/000")
    people = community(options.width)
    places = find_sights(home, options.sights, options.seed, options.flight.center_m)
    mine = plan_visits(home, people, places, options.photos, options.seed, "home", by_rank=True)
    places = find_sights(away, options.sights, options.seed + 1)
    theirs = plan_visits(
        away,
        people[:8],
        places,
        options.other_town,
        options.seed + 1,
        "away",
        first_visit=10_000,
        kind="other_town",
        by_rank=True,
    )
    rng = np.random.default_rng((options.seed, 58))
    mine = tagged(home, mine, people, GeotagOptions(), rng)
    theirs = _other_tags(home, away, theirs, GeotagOptions(), rng)
    copies = plan_copies(mine, people, options.copies, options.seed)
    nowhere = _plan_nowhere(options, people, home)
    return named([*mine, *theirs, *copies, *nowhere], options.seed)


def _other_tags(
    home: Scene, away: Scene, photos: list[PlannedPhoto], options: GeotagOptions, rng: np.random.Generator
) -> list[PlannedPhoto]:
    """Another town's photos: most claim to be of this one, visit by visit; some say where they are."""
    place_of: dict[int, tuple[float, FloatArray]] = {}
    result = []
    for p in photos:
        half = 0.4 * np.asarray(home.plan.size)
        drawn = float(rng.random()), np.array([*rng.uniform(-half, half), 2.0])
        fate, spot = place_of.setdefault(p.fact.visit, drawn)
        accuracy = float(np.round(options.sigma_m)) if rng.random() < ACCURACY_SHARE else None
        jitter = np.array([*rng.normal(0, 0.5 * options.sigma_m, 2), 0.0])
        if fate < _TAGGED_HERE:
            p = replace(p, geotag=geotag_at(home, home.enu_from_town @ spot + jitter, 0.0, accuracy))
        elif fate < _TAGGED_THERE:
            p = replace(p, geotag=geotag_at(away, p.shot.cam_from_local.center + jitter, 0.0, accuracy))
        result.append(p)
    return result


def plan_copies(
    photos: list[PlannedPhoto], people: tuple[Person, ...], count: int, seed: int
) -> list[PlannedPhoto]:
    """Re-uploads of some of the photos by other people: smaller, re-encoded, marked, framed, cut."""
    rng = np.random.default_rng((seed, 53))
    ways: tuple[Callable[[], tuple[Edit, ...]], ...] = (
        tuple,  # encoded again, nothing else
        lambda: (Edit(kind="resized", amount=float(rng.uniform(0.4, 0.75))),),
        lambda: (Edit(kind="watermarked", amount=0.4, text="repost"),),
        lambda: (Edit(kind="bordered", amount=float(rng.uniform(0.015, 0.05))),),
        lambda: (Edit(kind="cropped", amount=float(rng.uniform(0.1, 0.3))), Edit(kind="resized", amount=0.7)),
    )
    copies = []
    for i, row in enumerate(rng.choice(len(photos), min(count, len(photos)), replace=False)):
        original = photos[int(row)]
        others = [p for p in people if p.name != original.fact.owner]
        owner = others[int(rng.integers(len(others)))]
        keeps_tag = original.geotag is not None and rng.random() < 0.4
        copy = replace(
            original,
            edits=original.edits + ways[i % len(ways)](),
            quality=int(rng.integers(60, 82)),
            exif="none",
            geotag=original.geotag if keeps_tag else None,
        )
        fact = {"owner": owner.name, "licence": owner.licence, "copy_of": original.shot.name}
        copies.append(renamed(copy, f"copy-{i}", kind="copy", **fact))
    return copies


def _plan_nowhere(options: CommunityOptions, people: tuple[Person, ...], home: Scene) -> list[PlannedPhoto]:
    """Rooms and faces, tagged with the town as everything on such a phone is."""
    rng = np.random.default_rng((options.seed, 54))
    walkers = [p for p in people if p.ground is not None]
    subjects: list[Subject] = ["indoor"] * options.indoor + ["portrait"] * options.portraits  # type: ignore[assignment]
    photos = []
    for i, subject in enumerate(subjects):
        person = walkers[int(rng.integers(len(walkers)))]
        assert person.ground is not None
        half = 0.4 * np.asarray(home.plan.size)
        spot = home.enu_from_town @ np.array([*rng.uniform(-half, half), 2.0])
        has_tag = rng.random() < person.tags
        photo = planned(
            person,
            subject,
            name=f"nowhere-{i}",
            device=person.ground,
            cam_from_local=look_pose(spot, 0.0, 0.0),
            time=moment(int(rng.integers(DAYS)), float(rng.uniform(8, 22))),
            seed=shot_seed(options.seed, 5, i),
            scene="home/0/000",
            exif=person.exif,
            home=False,
            geotag=geotag_at(home, spot, 0.0, None) if has_tag else None,
            subject=subject,
        )
        photos.append(photo)
    return photos


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetOptions(TownOptions):
    """What to write: the town of `WorldOptions.short` as people see it from its streets.

    Attributes:
        pieces: so many that no two walls of a house share their bricks: maps of those that do are joined
            wrongly, which is not what is asked here.
        photos: of all people. sights: places that they visit, the k-th 1/k as often as the first.
    """

    seed: int = 1
    town_size_m: tuple[float, float] = (260.0, 230.0)
    flight: FlightOptions = field(default_factory=FlightOptions)
    pieces: int = 8
    width: int = 1000
    photos: int = 60
    sights: int = 4


def street_album(options: StreetOptions) -> list[PlannedPhoto]:
    """All photos; a third of them has a geotag."""
    home, people = options.scene("home/0/000"), _walkers(options.width)
    places = find_sights(home, options.sights, options.seed)
    photos = plan_visits(home, people, places, options.photos, options.seed, "home", by_rank=True)
    geotags = GeotagOptions(sigma_m=_STREET_SIGMA_M, far_share=0.0)
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
