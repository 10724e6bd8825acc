"""The textures of a scene, painted once per process."""

from functools import lru_cache

import numpy as np

from featuredb.simworld.camera.shading import Look
from featuredb.simworld.town.ground import paint_ground
from featuredb.simworld.town.materials import town_textures, water_texture
from featuredb.simworld.town.scene import TEXTURES, GroundPlan, Scene
from featuredb.simworld.town.texture import Texture


def scene_look(scene: Scene, water_seed: int = 0) -> Look:
    """Textures and light of a scene; the water is that of the moment `water_seed`."""
    still = _materials(scene.seed, scene.pieces)
    painted = {"water": water_texture(water_seed), "ground": _ground(scene.plan, scene.texel_m)}
    textures = tuple(painted.get(name) or still[name] for name in TEXTURES)
    to_sun = scene.enu_from_town @ np.asarray(scene.plan.to_sun)
    return Look(textures=textures, detail=still["detail"], to_sun=to_sun)


@lru_cache(maxsize=4)
def _materials(seed: int, pieces: int) -> dict[str, Texture]:
    return town_textures(seed, pieces)


@lru_cache(maxsize=2)
def _ground(plan: GroundPlan, texel_m: float) -> Texture:
    return paint_ground(plan, texel_m)
