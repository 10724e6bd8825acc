"""How well a map is placed on Earth, as figures for people: its place, its tilt and its heading."""

import math
from dataclasses import dataclass
from typing import Self

from numpy.typing import ArrayLike

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.sim3 import place_covariance

NO_HEIGHT_M = 1e4  # no place is so high; where no photo tells a height, 1e5 m and more are left open


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceBounds:
    """What holds 95 % of the errors of a placement, by its covariance.

    Attributes:
        horizontal_m, vertical_m: of the middle of the map's cameras, metres.
        tilt_deg: of the map's up against the true one.
        heading_deg: of the map about up.
    """

    horizontal_m: float
    vertical_m: float
    tilt_deg: float
    heading_deg: float

    @classmethod
    def of(cls, covariance: FloatArray, middle: ArrayLike) -> Self:
        """
        Args:
            covariance: (7, 7) of a placement: scale, turn (3), place (3) along the local axes, about the
                origin.
            middle: (3,) of the map's cameras, in the local frame, metres.
        """
        place, turn = place_covariance(covariance, middle), covariance[1:4, 1:4]
        tilt, heading, across, up = (
            error_radius(of[a:b, a:b], 0.95)
            for of, a, b in ((turn, 0, 2), (turn, 2, 3), (place, 0, 2), (place, 2, 3))
        )
        return cls(
            horizontal_m=across, vertical_m=up, tilt_deg=math.degrees(tilt), heading_deg=math.degrees(heading)
        )

    def words(self) -> tuple[str, str]:
        """Place and turn, a sentence each."""
        rise_m = 100.0 * math.tan(math.radians(min(self.tilt_deg, 45.0)))
        height = f"and {self.vertical_m:.2f} m vertically (95 %)"
        if self.vertical_m > NO_HEIGHT_M:
            height = "(95 %); its height is not known"
        return (
            f"place: right to {self.horizontal_m:.2f} m horizontally {height}",
            f"turn: may be tilted by {self.tilt_deg:.1f} degrees, which is {rise_m:.1f} m of height at 100 m "
            f"from its middle, and turned about the vertical by {self.heading_deg:.1f} degrees (95 %)",
        )
