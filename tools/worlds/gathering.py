"""Photos that people take of a town: visits to sights, then geotags, numbers and file names."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.camera.shot import Shot
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import AlbumFact, PlannedPhoto
from tools.worlds.edits import Edit
from tools.worlds.geotags import GeotagOptions, Tagging, give_geotags
from tools.worlds.people import Person
from tools.worlds.sights import Sight, Surroundings
from tools.worlds.surveyed import DAYS, day_key, moment, photo_ids, shot_seed
from tools.worlds.visits import drone_visit, ground_visit

_AHEAD = 15  # photos that somebody may be ahead of his share: two visits
_VISIT_TRIES = 4  # visits per wanted photo: then the sights cannot be photographed by these people


def plan_visits(
    scene: Scene,
    people: tuple[Person, ...],
    places: Sequence[Sight],
    count: int,
    seed: int,
    town: str,
    *,
    first_visit: int = 0,
    kind: str = "",
    by_rank: bool = False,
) -> list[PlannedPhoto]:
    """`count` photos of a town by these people, visit by visit; without geotags, under provisional names.

    Everybody goes to the popular sights, and each has a taste of his own.

    Args:
        places: most popular first.
        town: first part of the scenes' keys; only photos of "home" have a place in the truth.
        by_rank: the k-th sight is visited 1/k as often as the first, each person's taste apart. Photo sites
            show a few landmarks: the paper's 120,000 photos were of seven, and in every town one place leads.
            Otherwise by the sights' weights, which differ by little.
        first_visit: number of the first visit; visits of one album differ.
        kind: of the facts; by default street or drone.
    """
    rng = np.random.default_rng((seed, 52))
    if not places:
        raise InvalidValueError(f"plan_visits: no sight of {scene.name} can be photographed")
    around = Surroundings(scene)
    shares = np.array([p.weight for p in people]) / sum(p.weight for p in people)
    taken_by = np.zeros(len(people))
    taste = rng.lognormal(0.0, 0.5, (len(people), len(places))) * _popularity(places, by_rank)
    photos: list[PlannedPhoto] = []
    visit = first_visit
    while len(photos) < count:
        # Whoever is behind his share is likely to come next, so that everybody comes.
        behind = np.maximum(shares * (len(photos) + _AHEAD) - taken_by, 0.0)
        who = int(rng.choice(len(people), p=behind / behind.sum()))
        where = int(rng.choice(len(places), p=taste[who] / taste[who].sum()))
        taken = _visit(people[who], places[where], around, visit, seed, town, kind, rng)
        taken_by[who] += len(taken)
        photos += taken[: count - len(photos)]
        visit += 1
        if visit - first_visit > _VISIT_TRIES * max(count, 50):
            raise InvalidValueError(
                f"plan_visits: only {len(photos)} of {count} photos came of {visit} visits"
            )
    return photos


def _popularity(places: Sequence[Sight], by_rank: bool) -> FloatArray:
    if by_rank:
        return 1.0 / np.arange(1.0, len(places) + 1.0)
    return np.array([s.weight**0.7 for s in places])


def _visit(
    person: Person,
    sight: Sight,
    around: Surroundings,
    visit: int,
    seed: int,
    town: str,
    kind: str,
    rng: np.random.Generator,
) -> list[PlannedPhoto]:
    by_drone = person.drone is not None and (person.ground is None or rng.random() < person.drone_share)
    count = int(rng.integers(4, 10)) if by_drone else int(rng.integers(1, 7))
    views = (drone_visit if by_drone else ground_visit)(person, sight, around, count, rng)
    day, hour = int(rng.integers(DAYS)), float(rng.uniform(8.0, 19.0))
    photos = []
    for i, view in enumerate(views):
        name = f"{town}-{visit}-{i}"
        shot = Shot(
            name=name,
            device=view.device,
            cam_from_local=view.cam_from_local,
            time=moment(day, hour + 0.01 * i),
            seed=shot_seed(seed, 4, visit, i),
        )
        crop = Edit(kind="cropped", amount=float(rng.uniform(0.08, 0.25)))
        fact = AlbumFact(
            name=name,
            photo_id="",
            kind=kind or ("drone" if by_drone else "street"),
            owner=person.name,
            licence=person.licence,
            time=shot.time,
            home=town == "home",
            visit=visit,
        )
        photos.append(
            PlannedPhoto(
                shot=shot,
                scene=day_key(town, day, hour),
                fact=fact,
                exif=person.exif,
                edits=(*([crop] if rng.random() < person.crop_share else []), *person.edits),
                quality=person.quality,
                sensor=person.sensor,
                orientation=view.orientation,
            )
        )
    return photos


def tagged(
    scene: Scene,
    photos: list[PlannedPhoto],
    people: tuple[Person, ...],
    options: GeotagOptions,
    rng: np.random.Generator,
) -> list[PlannedPhoto]:
    """The photos with their geotags."""
    by_name = {p.name: p for p in people}
    asked = [
        Tagging(
            center=p.shot.cam_from_local.center,
            visit=p.fact.visit,
            tagged=bool(rng.random() < by_name[p.fact.owner].tags),
            by_hand=by_name[p.fact.owner].by_hand,
        )
        for p in photos
    ]
    given = give_geotags(scene, asked, options, rng)
    return [replace(p, geotag=tag) for p, (tag, _) in zip(photos, given, strict=True)]


def named(photos: list[PlannedPhoto], seed: int) -> list[PlannedPhoto]:
    """The photos with numbers and file names that give nothing away; copies name their originals."""
    ids = photo_ids(seed, len(photos))
    names = {p.shot.name: f"photos/{p.fact.owner}/{i}.jpg" for p, i in zip(photos, ids, strict=True)}
    return [
        replace(
            p,
            shot=replace(p.shot, name=names[p.shot.name]),
            fact=replace(
                p.fact,
                name=names[p.shot.name],
                photo_id=photo_id,
                copy_of=names.get(p.fact.copy_of, ""),
            ),
        )
        for p, photo_id in zip(photos, ids, strict=True)
    ]
