"""Geotags as people's photos have them: tens of metres off, alike within a visit, or kilometres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import Geotag

_FAR_M = (1_000.0, 12_000.0)
_HEIGHT_SIGMA_M = 15.0  # of the heights, where there are any
ACCURACY_SHARE = 0.6  # of the tagged photos, those that say how accurate they are


@dataclass(frozen=True, slots=True, kw_only=True)
class GeotagOptions:
    """How wrong geotags are.

    Attributes:
        sigma_m: standard deviation per horizontal axis of an ordinary geotag; half of the variance is
            common to the photos of a visit. So the distance from the truth is sigma times root 2, rms.
        far_share: of the tagged photos, those that are wrong by 1 to 12 km; half of them as whole visits.
    """

    sigma_m: float = 30.0
    far_share: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tagging:
    """One photo that may get a geotag: where it was taken (3,) local, its visit, whether, and how."""

    center: FloatArray
    visit: int
    tagged: bool
    by_hand: bool


def give_geotags(
    scene: Scene, photos: Sequence[Tagging], options: GeotagOptions, rng: np.random.Generator
) -> list[Geotag | None]:
    """A geotag for each photo.

    Geotags of the far kind claim the same accuracy as others: nothing in a file gives them away.
    """
    far = _far_ones(photos, options.far_share, rng)
    shared: dict[int, FloatArray] = {}
    given: list[Geotag | None] = []
    for i, photo in enumerate(photos):
        share = np.sqrt(0.5) * options.sigma_m
        common = shared.setdefault(photo.visit, rng.normal(0, share, 2)) if photo.visit >= 0 else None
        own = rng.normal(0, share, 2)
        error = own + (common if common is not None else rng.normal(0, share, 2))
        height_error = float(rng.normal(0, _HEIGHT_SIGMA_M))
        claimed = float(np.clip(np.round(options.sigma_m * rng.lognormal(0.0, 0.4)), 3, 200))
        says = rng.random() < ACCURACY_SHARE
        if not photo.tagged:
            given.append(None)
            continue
        if i in far:
            error = far[i]
        height = None if photo.by_hand else height_error
        center = photo.center + np.append(error, 0.0)
        given.append(geotag_at(scene, center, height, claimed if says else None))
    return given


def geotag_at(
    scene: Scene, point: FloatArray, height_error_m: float | None, accuracy_m: float | None
) -> Geotag:
    """The geotag of a point (3,) in the scene's local frame; without height where the error is None."""
    latitude, longitude, height = scene.frame.geodetic_from_enu(point)
    return Geotag(
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        height_m=None if height_error_m is None else float(height) + height_error_m,
        accuracy_m=accuracy_m,
    )


def _far_ones(photos: Sequence[Tagging], share: float, rng: np.random.Generator) -> dict[int, FloatArray]:
    """Errors (2,) of the photos that are wrong by kilometres: whole visits first, then single ones."""
    tagged = [i for i, photo in enumerate(photos) if photo.tagged]
    wanted = round(share * len(tagged))
    far: dict[int, FloatArray] = {}
    visits = sorted({photos[i].visit for i in tagged if photos[i].visit >= 0})
    for visit in rng.permutation(visits):
        mine = [i for i in tagged if photos[i].visit == visit]
        if len(far) + len(mine) <= wanted // 2:
            error = _far_error(rng)
            far |= {i: error + rng.normal(0, 10.0, 2) for i in mine}
    for i in rng.permutation([i for i in tagged if i not in far])[: wanted - len(far)]:
        far[int(i)] = _far_error(rng)
    return far


def _far_error(rng: np.random.Generator) -> FloatArray:
    distance = _FAR_M[0] * (_FAR_M[1] / _FAR_M[0]) ** rng.random()
    angle = rng.uniform(0, 2 * np.pi)
    return np.asarray(distance * np.array([np.cos(angle), np.sin(angle)]), dtype=np.float64)
