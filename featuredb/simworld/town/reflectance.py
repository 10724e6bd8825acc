"""What the town's materials throw back at a laser's near infrared: another picture than the one in light.

Plants are bright, asphalt, slate and bitumen dark, water is black; there are no shadows.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.ground import paint_infrared
from featuredb.simworld.town.noise import periodic
from featuredb.simworld.town.scene import REFLECTANCE, GroundPlan, Scene, texture_index

_PATCHES = 0.10  # relative strength of weathering, patches of decimetres to metres
_PATCH_TEXEL_M = 0.12
_OBJECT_SPREAD = 0.13  # two roofs of one material differ by about as much
_CAR_SPREAD = 0.55  # paints differ most, and not as their colours do


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reflectance:
    """Reflectance of a scene in the near infrared.

    Attributes:
        ground: (h, w) float32 of the painted rectangle, rows to the north in town axes.
        patches: (p, p) float32 periodic factors.
    """

    ground: NDArray[np.float32]
    ground_texel_m: float
    patches: NDArray[np.float32]

    def at(
        self, scene: Scene, xyz: FloatArray, texture: NDArray[np.integer], object_id: NDArray[np.integer]
    ) -> FloatArray:
        """Reflectance (n,) at points (n, 3) of the local frame on faces of these textures and objects."""
        value = np.array(list(REFLECTANCE.values()))[texture]
        town = xyz @ scene.enu_from_town
        painted = texture == texture_index("ground")
        size = np.asarray(scene.plan.size)
        cell = np.floor((town[painted, :2] + 0.5 * size) / self.ground_texel_m).astype(np.int64)
        column, row = (cell[:, k].clip(0, self.ground.shape[1 - k] - 1) for k in (0, 1))
        value[painted] = self.ground[row, column]
        # Each object has its own age and make, by its number.
        of_object = np.random.default_rng((scene.seed, 91)).standard_normal(65_536)[object_id % 65_536]
        spread = np.where(texture == texture_index("car"), _CAR_SPREAD, _OBJECT_SPREAD)
        value = np.where(painted, value, value * np.exp(spread * of_object))
        patch = np.floor(town[:, :2] / _PATCH_TEXEL_M).astype(np.int64) % len(self.patches)
        return np.asarray(value * self.patches[patch[:, 1], patch[:, 0]], dtype=np.float64)


def scene_reflectance(scene: Scene) -> Reflectance:
    """The reflectance of a scene; painted once per process."""
    return _painted(scene.seed, scene.plan, scene.texel_m)


@lru_cache(maxsize=2)
def _painted(seed: int, plan: GroundPlan, texel_m: float) -> Reflectance:
    fine = paint_infrared(plan, texel_m)
    # A laser's footprint is some 12 cm wide: nothing finer comes back.
    shrink = max(1, round(_PATCH_TEXEL_M / texel_m))
    h, w = fine.shape[0] // shrink, fine.shape[1] // shrink
    ground = cv2.resize(fine[: h * shrink, : w * shrink], (w, h), interpolation=cv2.INTER_AREA)
    patches = 1.0 + _PATCHES * periodic(1024, np.random.default_rng((seed, 92)), exponent=0.8, low=4)
    return Reflectance(
        ground=np.asarray(ground, dtype=np.float32),
        ground_texel_m=texel_m * shrink,
        patches=np.clip(patches, 0.4, 1.8).astype(np.float32),
    )
