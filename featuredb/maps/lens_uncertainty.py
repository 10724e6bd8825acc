"""Standard deviations of the lenses that a map was made with, stored in its provenance.

An error of a lens bends the points that were reconstructed with it. A photo whose own lens is known exactly
sees this as an error of its lens; so localisation needs to know how large it may be.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera

_KEY, _NUMBERS = "lens_uncertainty", 9


@dataclass(frozen=True, slots=True, kw_only=True)
class LensUncertainty:
    """Standard deviations of a map's lenses, of all together.

    Attributes:
        focal_rel: of the focal length. aspect: of the second focal length over the first.
        center_rel: (x, y) of the principal point, as shares of the longer side.
        radial, tangential: of the two coefficients of each.
        dilution: so many observations counted as one against what was known of the lenses.
    """

    focal_rel: float
    aspect: float
    center_rel: tuple[float, float]
    radial: tuple[float, float]
    tangential: tuple[float, float]
    dilution: float

    def as_provenance(self) -> dict[str, Any]:
        """To be merged into a map's provenance."""
        numbers = np.hstack([getattr(self, field.name) for field in fields(self)])
        return {_KEY: [float(f"{number:.4g}") for number in numbers]}

    @classmethod
    def of_provenance(cls, provenance: dict[str, Any]) -> "LensUncertainty | None":
        """None for maps that were made before it was kept, or of lenses that have no such parameters.

        Raises:
            InvalidValueError: it is not what `as_provenance` writes.
        """
        numbers = provenance.get(_KEY)
        if numbers is None:
            return None
        if (
            not isinstance(numbers, list)
            or len(numbers) != _NUMBERS
            or not all(isinstance(n, int | float) and 0.0 <= n < np.inf for n in numbers)
        ):
            raise InvalidValueError(
                f"provenance {_KEY}: expected {_NUMBERS} numbers of at least 0, found {numbers!r}"
            )
        return _of_numbers(*numbers)


def uncertainty_of_lenses(
    cameras: Sequence[Camera], covariances: Sequence[FloatArray], photos: Sequence[int], dilution: float
) -> LensUncertainty | None:
    """Of independent lenses that have so many photos each; None where none is of OPENCV's parameters.

    Args:
        covariances: (8, 8) of OPENCV's parameters. dilution: that they were found with.
    """
    rows = [c for c, camera in enumerate(cameras) if camera.model == "OPENCV" and photos[c]]
    if not rows:
        return None
    share = np.array([photos[c] for c in rows], dtype=np.float64)
    share /= share.sum()
    variance = np.zeros(8)
    for weight, c in zip(share, rows, strict=True):
        camera = cameras[c]
        fx, fy = camera.params[:2]
        longer = max(camera.width, camera.height)
        by = np.diag([1.0 / fx, 0.0, 1.0 / longer, 1.0 / longer, 1.0, 1.0, 1.0, 1.0])
        by[1, :2] = -fy / fx**2, 1.0 / fx
        variance += weight**2 * np.diag(by @ covariances[c] @ by.T)
    return _of_numbers(*np.sqrt(np.maximum(variance, 0.0)).tolist(), dilution)


def _of_numbers(*numbers: float) -> LensUncertainty:
    f, aspect, cx, cy, k1, k2, p1, p2, dilution = numbers
    return LensUncertainty(
        focal_rel=f,
        aspect=aspect,
        center_rel=(cx, cy),
        radial=(k1, k2),
        tangential=(p1, p2),
        dilution=dilution,
    )
