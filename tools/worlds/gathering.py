"""Photos that people take of a town: visits to sights, then geotags, numbers and file names."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import Device
from featuredb.simworld.flight import shot_seed
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import DAYS, PlannedPhoto, day_key, moment, photo_ids, renamed
from tools.worlds.edits import Edit
from tools.worlds.people import GeotagOptions, Person, Tagging, give_geotags, planned, stored_upright, zoomed
from tools.worlds.sights import Sight, Surroundings, look_at

_AHEAD = 15  # photos that somebody may be ahead of his share: two visits
_VISIT_TRIES = 4  # visits per wanted photo: then the sights cannot be photographed by these people

_NEAREST_DRONE_M, _NEAREST_GROUND_M = 4.0, 2.5
_TRIES = 6  # a photographer who sees nothing but a wall takes a step and tries again


View = tuple[Device, Rigid3, int]  # of one photo of a visit: with what, from where, EXIF orientation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """Where one photo is taken from and of what, town axes; `turn_deg` is heading, pitch, roll on top."""

    eye: FloatArray
    target: FloatArray
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)


def ground_visit(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[View]:
    """Photos from the ground: near one of the places where most people stand, a few steps between them."""
    assert person.ground is not None
    stand = np.array(sight.stands[int(rng.integers(len(sight.stands)))])
    careless = 1.0 - person.skill
    views: list[View] = []
    for _ in range(count):
        for _ in range(_TRIES):
            eye = stand + np.append(rng.normal(0, 3.0 + 4.0 * careless, 2), 0.0)
            eye[2] = around.ground(float(eye[1])) + rng.uniform(1.45, 1.8)
            aim = np.asarray(sight.target) + rng.normal(0, [2.0, 2.0, 1.0])
            if rng.random() < 0.15:  # somebody turns and photographs what else is there
                away = rng.normal(0, 1, 2)
                aim = eye + np.append(25.0 * away / np.linalg.norm(away), 2.0)
            factor = float(rng.choice([1.0, person.zoom], p=[0.7, 0.3]))
            device = person.ground if factor == 1.0 else zoomed(person.ground, factor)
            upright = person.upright != "never" and rng.random() < 0.5
            by_exif = upright and person.upright == "tagged"
            device = stored_upright(device) if upright and not by_exif else device
            roll, orientation = (90.0, 6) if by_exif else (0.0, 1)
            wobble = rng.normal(0, [3.0, 2.0, 0.8 + 3.0 * careless])
            look = Viewpoint(eye=eye, target=aim, turn_deg=(wobble[0], wobble[1], wobble[2] + roll))
            view = _view(around, look, device, orientation, _NEAREST_GROUND_M)
            if view is not None:
                views.append(view)
                break
    return views


def drone_visit(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[View]:
    """Photos of one flight: around a sight, climbing, along a street, straight down, or the whole town."""
    assert person.drone is not None
    low = person.heights_m[0] < 35.0
    names = ["orbit", "climb", "along", "down", "overview"]
    shares = [0.36, 0.2, 0.2, 0.12, 0.12] if low else [0.3, 0.08, 0.12, 0.25, 0.25]
    mode = str(rng.choice(names, p=shares))
    views = []
    for look in getattr(_Flight(person, sight, around, count, rng), mode)():
        wobble = rng.normal(0, [1.5, 1.2, 0.6 + 1.5 * (1 - person.skill)])
        turned = replace(look, turn_deg=tuple(np.add(look.turn_deg, wobble).tolist()))
        view = _view(around, turned, person.drone, 1, _NEAREST_DRONE_M)
        if view is not None:
            views.append(view)
    return views


def _view(
    around: Surroundings, look: Viewpoint, device: Device, orientation: int, nearest_m: float
) -> View | None:
    """The view, or None where nobody would take it or the camera would stand in something."""
    inside = np.abs(look.eye[:2]) < 0.5 * np.asarray(around.scene.plan.size) + 20.0
    if not inside.all() or not around.free(look.eye):
        return None
    pose = look_at(around.scene, look.eye, look.target, look.turn_deg)
    return (device, pose, orientation) if around.worth_taking(device.camera, pose, nearest_m) else None


class _Flight:
    """A flight at a sight: each way of flying gives so many viewpoints, or fewer."""

    def __init__(
        self, person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
    ) -> None:
        self._person, self._sight, self._around, self._count, self._rng = person, sight, around, count, rng
        self._target = np.asarray(sight.target)

    def _height(self) -> float:
        low, high = self._person.heights_m
        return float(low * (high / low) ** self._rng.random())

    def _at(self, place: FloatArray, above: float) -> FloatArray:
        """A place so high above the ground."""
        return np.array([*place[:2], self._around.ground(float(place[1])) + above])

    def orbit(self) -> list[Viewpoint]:
        """A part of a circle, 8 to 20 degrees between photos; the town lies behind the sight or under it."""
        rng, above = self._rng, self._height()
        radius = self._sight.radius + above * float(rng.uniform(0.5, 1.6))
        start, step = float(rng.uniform(0, 360)), float(rng.choice([-1, 1]) * rng.uniform(8, 20))
        height = self._at(self._target, above)[2]
        looks = []
        for i in range(self._count):
            x, y, _ = self._target + radius * _ahead(start + step * i) + rng.normal(0, 0.8, 3)
            looks.append(Viewpoint(eye=np.array([x, y, height]), target=self._target))
        return looks

    def climb(self) -> list[Viewpoint]:
        """Take-off before the sight: from the height of a person's head up, camera lowered as it rises."""
        x, y, eye_z = self._sight.stands[int(self._rng.integers(len(self._sight.stands)))]
        top = max(self._height(), 12.0)
        away = np.array([x, y]) - self._target[:2]
        away /= max(float(np.linalg.norm(away)), 1.0)
        looks = []
        for height in 2.0 * (top / 2.0) ** np.linspace(0.0, 1.0, max(self._count, 2)):
            back = 0.35 * height * away + self._rng.normal(0, 0.4, 2)
            eye = np.array([x + back[0], y + back[1], eye_z - 1.6 + height])
            looks.append(Viewpoint(eye=eye, target=self._target))
        return looks[: self._count]

    def along(self) -> list[Viewpoint]:
        """Forward over the town towards and past the sight, camera 20 to 45 degrees down."""
        rng, above = self._rng, min(self._height(), 45.0)
        ahead = _ahead(float(rng.choice([0.0, 90.0, 180.0, 270.0]) + rng.normal(0, 8)))
        step, down = above * float(rng.uniform(0.2, 0.45)), float(rng.uniform(20, 45))
        reach = above / np.tan(np.radians(down))
        return self._hops(above, ahead * step, 0.7, ahead * reach)

    def down(self) -> list[Viewpoint]:
        """Straight down in hops of a quarter to a half of the height, some with the camera a bit forward."""
        rng, above = self._rng, max(self._height(), 30.0)
        ahead = _ahead(float(rng.uniform(0, 360)))
        lean = float(rng.choice([0.02, 0.15, 0.35]))
        step = above * float(rng.uniform(0.25, 0.5))
        return self._hops(above, ahead * step, 0.5, ahead * lean * above)

    def _hops(self, above: float, step: FloatArray, before: float, look: FloatArray) -> list[Viewpoint]:
        """Over the sight step by step, a share of the way before it; `look`: to where on the ground."""
        eyes = [self._at(self._target + step * (i - before * self._count), above) for i in range(self._count)]
        return [Viewpoint(eye=eye, target=eye + look - [0, 0, above]) for eye in eyes]

    def overview(self) -> list[Viewpoint]:
        """The town from above its rim, or panned from one place: high, 15 to 45 degrees down."""
        rng, (low, high) = self._rng, self._person.heights_m
        above = float(rng.uniform(max(60.0, low), max(75.0, high)))
        angle, down = float(rng.uniform(0, 360)), float(rng.uniform(15, 45))
        eye = self._at(self._target - above / np.tan(np.radians(down)) * _ahead(angle), above)
        pan = float(rng.choice([0.0, 12.0, 20.0]))
        hop = (0.0 if pan else 0.3 * above) * _ahead(angle + 90.0)
        count, looks = min(self._count, 5), []
        for i in range(count):
            offset = i - 0.5 * (count - 1)
            here = eye + hop * offset + rng.normal(0, 0.7, 3)
            turn_deg = (pan * offset, 0.0, 0.0)
            looks.append(Viewpoint(eye=here, target=self._target + hop * offset, turn_deg=turn_deg))
        return looks


def _ahead(angle_deg: float) -> FloatArray:
    """The direction of that angle, from the x axis."""
    angle = np.radians(angle_deg)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


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
    around = Surroundings(scene)
    shares = np.array([p.weight for p in people]) / sum(p.weight for p in people)
    taken_by = np.zeros(len(people))
    popularity = [1.0 / k if by_rank else s.weight**0.7 for k, s in enumerate(places, start=1)]
    taste = rng.lognormal(0.0, 0.5, (len(people), len(places))) * popularity
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
            raise InvalidValueError(f"plan_visits: {len(photos)} of {count} photos came of {visit} visits")
    return photos


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
    for i, (device, pose, orientation) in enumerate(views):
        crop = Edit(kind="cropped", amount=float(rng.uniform(0.08, 0.25)))
        photo = planned(
            person,
            kind or ("drone" if by_drone else "street"),
            name=f"{town}-{visit}-{i}",
            device=device,
            cam_from_local=pose,
            time=moment(day, hour + 0.01 * i),
            seed=shot_seed(seed, 4, visit, i),
            scene=day_key(town, day, hour),
            exif=person.exif,
            home=town == "home",
            visit=visit,
            edits=(*([crop] if rng.random() < person.crop_share else []), *person.edits),
            orientation=orientation,
        )
        photos.append(photo)
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
    asked = []
    for p in photos:
        owner, center = by_name[p.fact.owner], p.shot.cam_from_local.center
        has_tag = bool(rng.random() < owner.tags)
        asked.append(Tagging(center=center, visit=p.fact.visit, tagged=has_tag, by_hand=owner.by_hand))
    given = give_geotags(scene, asked, options, rng)
    return [replace(p, geotag=tag) for p, tag in zip(photos, given, strict=True)]


def named(photos: list[PlannedPhoto], seed: int) -> list[PlannedPhoto]:
    """The photos with numbers and file names that give nothing away; copies name their originals."""
    ids = photo_ids(seed, len(photos))
    names = {p.shot.name: f"photos/{p.fact.owner}/{i}.jpg" for p, i in zip(photos, ids, strict=True)}
    return [
        renamed(p, names[p.shot.name], photo_id=photo_id, copy_of=names.get(p.fact.copy_of, ""))
        for p, photo_id in zip(photos, ids, strict=True)
    ]
