"""The same town on another day: another sun, and other cars at the kerbs."""

from dataclasses import dataclass, replace

import numpy as np

from featuredb.simworld.town.scene import Faces, Scene, texture_index

# Share of the remaining cars in whose place another stands, of another colour and not quite at the same spot.
_CARS_SWAPPED = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class DayOptions:
    """What differs from the day of the scene.

    Attributes:
        to_sun: direction to the sun in town axes, any length; None leaves it where it is. Shadows on the
            ground, the light on faces and crowns follow it.
        cars_gone: share of the parked cars that are not there.
        leaf_tint: factors on red, green, blue of the crowns: the season.
    """

    seed: int = 1
    to_sun: tuple[float, float, float] | None = None
    cars_gone: float = 0.4
    leaf_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


def another_day(scene: Scene, options: DayOptions) -> Scene:
    """The scene on that day; what does not move is the same to the last bit."""
    faces, plan = _other_cars(scene, options), scene.plan
    crowns = scene.ellipsoids
    if options.leaf_tint != (1.0, 1.0, 1.0):
        crowns = replace(crowns, tint=crowns.tint * np.asarray(options.leaf_tint))
    if options.to_sun is not None:
        sun = np.asarray(options.to_sun) / np.linalg.norm(options.to_sun)
        old, new = (faces.sunlight(scene.enu_from_town @ np.asarray(way)) for way in (plan.to_sun, sun))
        faces = replace(faces, tint=faces.tint * (new / old)[:, None])
        plan = replace(plan, to_sun=(float(sun[0]), float(sun[1]), float(sun[2])))
    return replace(scene, faces=faces, ellipsoids=crowns, plan=plan)


def _other_cars(scene: Scene, options: DayOptions) -> Faces:
    """The faces with some of the parked cars gone, and others in the place of some."""
    faces = scene.faces
    rng = np.random.default_rng((scene.seed, options.seed, 61))
    is_car = faces.texture == texture_index("car")
    origin, tint, keep = faces.origin.copy(), faces.tint.copy(), np.ones(len(faces), dtype=bool)
    for object_id in np.unique(faces.object_id[is_car]):
        gone, swapped = rng.random(2) < (options.cars_gone, _CARS_SWAPPED)
        shift, factors = rng.normal(0, [0.35, 0.35]), rng.uniform(0.25, 1.6) * rng.uniform(0.7, 1.2, 3)
        mine = is_car & (faces.object_id == object_id)
        if gone:
            keep &= ~mine
        elif swapped:
            origin[mine, :2] += shift
            tint[mine] *= factors
    return replace(faces, origin=origin, tint=tint).take(keep)
