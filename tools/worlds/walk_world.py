"""A long town: an anchor at one end, people who walk and fly away from it, and an anchor at the far end.

Folders: survey/ (first anchor), photos/<owner>/ (contributed, `AlbumFact.batch` says in which step they
arrive), probes/ (never contributed: what coverage and error are measured on, of the same steps) and
survey_far/. Kinds: survey, survey_far, walk, probe.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.flight import FlightOptions, shot_seed
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import PlannedPhoto, TownOptions, day_key, moment, photo_ids, survey_photos, town_of
from tools.worlds.people import community, geotag_at, planned
from tools.worlds.sights import Surroundings, look_at

_PROBE = "probe"
_TRIES = 8
_VERTICAL_M = 4.0  # what a drone's height is off by


@dataclass(frozen=True, slots=True, kw_only=True)
class Walker:
    """One of those who go along: whose camera, how high (metres over ground), how far down the camera looks
    (degrees below the horizon), how far apart across the way, and the error of the receiver, 0 for none."""

    owner: str
    heights_m: tuple[float, float]
    down_deg: tuple[float, float]
    across_m: float
    gps_sigma_m: float


WALKERS = (
    Walker(owner="bert", heights_m=(45.0, 60.0), down_deg=(60.0, 90.0), across_m=25.0, gps_sigma_m=3.0),
    Walker(owner="carla", heights_m=(25.0, 45.0), down_deg=(35.0, 75.0), across_m=25.0, gps_sigma_m=6.0),
    Walker(owner="jonas", heights_m=(12.0, 28.0), down_deg=(25.0, 60.0), across_m=18.0, gps_sigma_m=0.0),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkOptions(TownOptions):
    """What to write; people walk along the width of the town.

    Attributes:
        start_m, end_m: where the two surveys stand along the town's x axis.
        step_m: how far the people get from one step to the next; they start at the edge of the first survey
            and arrive in the second.
        per_step: photos of each walker in a step. probes: photos of a step that nobody contributes.
    """

    seed: int = 2
    town_size_m: tuple[float, float] = (420.0, 200.0)
    flight: FlightOptions = field(
        default_factory=lambda: FlightOptions(lines=3, per_line=5, oblique=4, width=1200, gps_error="rtk")
    )
    start_m: float = -140.0
    end_m: float = 130.0
    step_m: float = 35.0
    per_step: int = 4
    probes: int = 2
    texel_m: float = 0.08

    @property
    def steps(self) -> int:
        """Number of steps from one survey to the other."""
        return int(np.ceil((self.end_m - self.start_m) / self.step_m)) + 1


def plan_walk(options: WalkOptions) -> list[PlannedPhoto]:
    """All photos: both surveys, contributed photos and probes, in the order of the steps."""
    home = options.scene("home/0/000")
    photos = []
    for folder, at, seed in (("survey", options.start_m, 0), ("survey_far", options.end_m, 500)):
        flight = replace(options.flight, center_m=(at, _middle(options)))
        for p in survey_photos(home, flight, options.seed + seed, folder=folder):
            photos.append(replace(p, fact=replace(p.fact, kind=folder)))
    walk = _Walk(options, home)
    for step in range(options.steps):
        rng = np.random.default_rng((options.seed, 81, step))
        for who, walker in enumerate(WALKERS):
            photos += walk.photos(walker, walk.aims(walker, step, options.per_step, rng), step, who, "walk")
        walker = WALKERS[step % len(WALKERS)]
        photos += walk.photos(walker, walk.aims(walker, step, options.probes, rng), step, 9, _PROBE)
    return photos


def _middle(options: WalkOptions) -> float:
    """The y of the way: the middle of the town north of the river."""
    return 0.5 * (0.5 * options.town_size_m[1] + max(town_of(options).plan.river))


Aim = tuple[FloatArray, FloatArray]


class _Walk:
    """Where people go, and what they photograph."""

    def __init__(self, options: WalkOptions, home: Scene) -> None:
        self._options, self._home, self._around = options, home, Surroundings(home)
        self._people = {p.name: p for p in community(options.width)}
        count = 4 * options.steps * (options.per_step + options.probes)
        self._ids = iter(photo_ids(options.seed, count))

    def aims(self, walker: Walker, step: int, count: int, rng: np.random.Generator) -> list[Aim]:
        """Eyes and targets (town axes) of one person in one step: spread over the step and a little before
        it, looking ahead, back or aside, as free of obstacles as a drone has to be."""
        options, drone = self._options, self._people[walker.owner].drone
        assert drone is not None
        found: list[Aim] = []
        for i in range(count):
            for _ in range(_TRIES):
                along = step + ((i + rng.random()) / count * 1.4 - 0.4)
                y = _middle(options) + float(rng.normal(0, walker.across_m))
                low, high = walker.heights_m
                above = low + float(rng.random()) * (high - low)
                down = np.radians(rng.uniform(*walker.down_deg))
                turn = float(rng.choice([0.0, 180.0, 90.0, -90.0], p=[0.5, 0.2, 0.15, 0.15]))
                heading = np.radians(turn) + rng.normal(0, 0.2)
                x = options.start_m + options.step_m * along
                eye = np.array([x, y, self._around.ground(y) + above])
                reach = above / np.tan(down)
                target = eye + np.array([reach * np.cos(heading), reach * np.sin(heading), -above])
                pose = look_at(self._home, eye, target)
                if self._around.free(eye) and self._around.worth_taking(drone.camera, pose, 3.0):
                    found.append((eye, target))
                    break
        return found

    def photos(self, walker: Walker, aims: list[Aim], step: int, who: int, kind: str) -> list[PlannedPhoto]:
        """The photos of one person's step; a step is a day, and nobody flies at the same hour."""
        person, home, seed = self._people[walker.owner], self._home, self._options.seed
        assert person.drone is not None
        rng = np.random.default_rng((seed, 82, step, who))
        day, hour = 9 * step + who, float(rng.uniform(9.0, 18.0))
        photos = []
        for i, (eye, target) in enumerate(aims):
            photo_id = next(self._ids)
            wobble = rng.normal(0, [1.5, 1.0, 0.8])
            place = home.enu_from_town @ eye + np.append(rng.normal(0, walker.gps_sigma_m, 2), 0.0)
            tag = None
            if walker.gps_sigma_m > 0:
                tag = geotag_at(home, place, float(rng.normal(0, _VERTICAL_M)), walker.gps_sigma_m)
            photo = planned(
                person,
                kind,
                name=f"{'photos/' + person.name if kind == 'walk' else 'probes'}/{photo_id}.jpg",
                device=person.drone,
                cam_from_local=look_at(home, eye, target, (wobble[0], wobble[1], wobble[2])),
                time=moment(day, hour + 0.005 * i),
                seed=shot_seed(seed, 7, step, who, i),
                scene=day_key("home", day, hour),
                geotag=tag,
                photo_id=photo_id,
                owner=person.name if kind == "walk" else _PROBE,
                visit=10 * step + who,
                batch=step,
            )
            photos.append(photo)
        return photos
