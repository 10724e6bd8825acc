"""The textures of a scene, painted once per process."""

from functools import lru_cache

import numpy as np

from featuredb.simworld.ground import paint_ground
from featuredb.simworld.materials import town_textures, water_texture
from featuredb.simworld.scene import TEXTURES, GroundPlan, Scene
from featuredb.simworld.shading import Look
from featuredb.simworld.texture import Texture


def scene_look(scene: Scene, water_seed: int = 0) -> Look:
    """Textures and light of a scene; the water is that of the moment `water_seed`."""
    still = _still_textures(scene.seed, scene.plan, scene.texel_m)
    water = water_texture(water_seed)
    textures = tuple(water if name == "water" else still[name] for name in TEXTURES)
    to_sun = scene.enu_from_town @ np.asarray(scene.plan.to_sun)
    return Look(textures=textures, detail=still["detail"], to_sun=to_sun)


@lru_cache(maxsize=2)
def _still_textures(seed: int, plan: GroundPlan, texel_m: float) -> dict[str, Texture]:
    return {**town_textures(seed), "ground": paint_ground(plan, texel_m)}
