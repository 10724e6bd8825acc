"""How a map may be off as a whole: joint displacements of its images and lenses, stored in its provenance.

A lens that is slightly wrong bends all poses and points of a map together. Covariances of single images and
points do not say so, and whoever is localised by those points is off with them.
"""

from base64 import b64decode, b64encode
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, freeze

_KEY = "error_modes"
LENS_SIZE = 8  # parameters of OPENCV


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ErrorModes:
    """Independent displacements of one standard deviation each, relative to the map's placement.

    Attributes:
        image_id: (k,) of the map's images.
        poses: (k, 6, r) left perturbation of cam_from_local: rad, and shares of the median distance of the
            points that the image sees.
        lenses: (c, 8, r) of OPENCV's parameters of the map's cameras; zero for others.
    """

    image_id: NDArray[np.int64]
    poses: FloatArray
    lenses: FloatArray

    def __post_init__(self) -> None:
        freeze(self, poses=(len(self.image_id), 6, None))
        freeze(self, lenses=(None, LENS_SIZE, self.poses.shape[2]))

    def as_provenance(self) -> dict[str, Any]:
        """To be merged into a map's provenance: numbers as base64 of little-endian float32."""
        written = {
            "image_id": self.image_id.tolist(),
            "modes": int(self.poses.shape[2]),
            "poses": _text(self.poses),
            "lenses": _text(self.lenses),
        }
        return {_KEY: written}

    @classmethod
    def of_provenance(cls, provenance: dict[str, Any], cameras: int) -> "ErrorModes | None":
        """None for maps that keep none.

        Raises:
            InvalidValueError: it is not what `as_provenance` writes of such a map.
        """
        written = provenance.get(_KEY)
        if written is None:
            return None
        try:
            ids = np.array(written["image_id"], dtype=np.int64)
            modes = int(written["modes"])
            poses = _numbers(written["poses"]).reshape(len(ids), 6, modes)
            lenses = _numbers(written["lenses"]).reshape(cameras, LENS_SIZE, modes)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InvalidValueError(
                f"provenance {_KEY}: expected image_id, modes, and poses and lenses of as many images and "
                f"{cameras} cameras as base64 of float32; found: {error}"
            ) from error
        return cls(image_id=ids, poses=poses, lenses=lenses)

    def of(self, images: Collection[int], cameras: Sequence[int]) -> "ErrorModes":
        """Of the images with these ids, and of cameras in this order."""
        rows = np.flatnonzero(np.isin(self.image_id, list(images)))
        return ErrorModes(
            image_id=self.image_id[rows], poses=self.poses[rows], lenses=self.lenses[list(cameras)]
        )


def without_modes(provenance: dict[str, Any]) -> dict[str, Any]:
    """Of a map whose poses were adjusted anew: its images' own covariances count again."""
    return {key: value for key, value in provenance.items() if key != _KEY}


def _text(numbers: FloatArray) -> str:
    return b64encode(numbers.astype("<f4").tobytes()).decode("ascii")


def _numbers(text: str) -> FloatArray:
    return np.frombuffer(b64decode(text, validate=True), dtype="<f4").astype(np.float64)
