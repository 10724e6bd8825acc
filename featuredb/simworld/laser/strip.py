"""What the surfaces of a strip make of its beams: which echoes there are, how strong, of what class."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.laser.beams import NOTHING, Hits
from featuredb.simworld.laser.echoes import Echoes
from featuredb.simworld.laser.scan_options import AirborneScanOptions
from featuredb.simworld.town.reflectance import LEAVES, Reflectance
from featuredb.simworld.town.scene import TEXTURES, Faces, Scene
from featuredb.simworld.town.town import BRIDGE_ID, BUILDING_ID, GROUND_ID, TREE_ID, WATER_ID

# ASPRS classes.
UNCLASSIFIED, GROUND, LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION = 1, 2, 3, 4, 5
BUILDING, LOW_NOISE, WATER, BRIDGE_DECK, HIGH_NOISE = 6, 7, 9, 17, 18

_MIRROR_DEG = 2.5  # within this angle off the nadir calm water throws the beam back
_WATER_SEEN = 0.08  # share of beams that water answers beyond it
_HIGH_M = 20.0  # above the ground: where noise counts as high


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strip:
    """What the steps of one strip share: faces and its displacement `shift` (3,) in the local frame."""

    scene: Scene
    faces: Faces
    reflectance: Reflectance
    options: AirborneScanOptions
    number: int
    shift: FloatArray


def answered(
    strip: Strip, echoes: Echoes, angle_deg: FloatArray, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Which echoes there are: calm water is a mirror, and throws most beams away."""
    on_water = (echoes.face != NOTHING) & (strip.faces.texture[echoes.face] == TEXTURES.index("water"))
    seen = (np.abs(angle_deg[echoes.beam]) < _MIRROR_DEG) | (rng.random(len(echoes)) < _WATER_SEEN)
    return np.asarray(~on_water | seen, dtype=bool)


def with_outliers(
    echoes: Echoes, hits: Hits, options: AirborneScanOptions, rng: np.random.Generator
) -> tuple[Echoes, NDArray[np.bool_]]:
    """Some beams' echoes replaced by one bird or one echo that took a detour; which rows these are."""
    draw = rng.random(hits.distance.size)
    bird, detour = draw < options.birds, draw > 1 - options.multipath
    first = np.concatenate([[True], echoes.beam[1:] != echoes.beam[:-1]])
    odd = (bird | detour)[echoes.beam]
    echoes = echoes.take(~odd | first)
    is_bird, outlier = bird[echoes.beam], (bird | detour)[echoes.beam]
    n = len(echoes)
    ground = hits.distance.ravel()[echoes.beam]
    replaced = np.where(is_bird, ground - rng.uniform(25, 160, n), ground + rng.uniform(1.5, 12.0, n))
    outlier &= np.isfinite(ground)
    none = np.full(n, NOTHING, dtype=np.int32)
    changed = replace(
        echoes,
        distance=np.where(outlier, replaced, echoes.distance),
        energy=np.where(outlier, 1.0, echoes.energy),
        face=np.where(outlier, none, echoes.face),
        ellipsoid=np.where(outlier, none, echoes.ellipsoid),
    )
    return changed, outlier


def received_light(
    strip: Strip,
    echoes: Echoes,
    outlier: NDArray[np.bool_],
    xyz: FloatArray,
    direction: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Received light (n,), as share of what a white wall across the beam at the flying height returns."""
    faces = strip.faces
    normal = np.cross(faces.edge_s, faces.edge_t)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Leaves hang at all angles.
    share = LEAVES * rng.uniform(0.5, 1.1, len(echoes))
    hard = np.flatnonzero(echoes.face != NOTHING)
    on = echoes.face[hard]
    cosine = np.clip(-np.einsum("ij,ij->i", normal[on], direction[hard]), 0.0, 1.0)
    texture = faces.texture[on]
    share[hard] = cosine * strip.reflectance.at(strip.scene, xyz[hard], texture, faces.object_id[on])
    mirror = (texture == TEXTURES.index("water")) & (cosine > np.cos(np.radians(_MIRROR_DEG)))
    share[hard[mirror]] *= rng.exponential(8.0, int(mirror.sum()))
    share[outlier] = rng.uniform(0.02, 0.35, int(outlier.sum()))
    spread = (strip.options.height_m / echoes.distance) ** 2
    return np.asarray(share * echoes.energy * spread, dtype=np.float64)


def objects_hit(strip: Strip, echoes: Echoes, outlier: NDArray[np.bool_]) -> NDArray[np.int32]:
    leaf = strip.scene.ellipsoids.object_id[echoes.ellipsoid] if len(strip.scene.ellipsoids) else NOTHING
    ids = np.where(echoes.face != NOTHING, strip.faces.object_id[echoes.face], leaf)
    return np.where(outlier, NOTHING, ids).astype(np.int32)


def classes_of(
    strip: Strip,
    object_id: NDArray[np.int32],
    xyz: FloatArray,
    outlier: NDArray[np.bool_],
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """ASPRS classes (n,): cars, masts and clutter are unclassified, as in public scans."""
    above = xyz[:, 2] - strip.scene.plan.height((xyz @ strip.scene.enu_from_town)[:, 1])
    classes = np.full(len(xyz), UNCLASSIFIED, dtype=np.uint8)
    for object_class, rows in (
        (GROUND, object_id == GROUND_ID),
        (WATER, object_id == WATER_ID),
        (BRIDGE_DECK, object_id == BRIDGE_ID),
        (BUILDING, (object_id >= BUILDING_ID) & (object_id < TREE_ID)),
    ):
        classes[rows] = object_class
    tree = (object_id >= TREE_ID) & (object_id < TREE_ID + 10_000)
    height_class = np.select([above > 2.0, above > 0.5], [HIGH_VEGETATION, MEDIUM_VEGETATION], LOW_VEGETATION)
    classes[tree] = height_class[tree]
    labelled = outlier & (rng.random(len(xyz)) < strip.options.noise_labelled)
    classes[labelled] = np.where(above[labelled] > _HIGH_M, HIGH_NOISE, LOW_NOISE)
    return classes
