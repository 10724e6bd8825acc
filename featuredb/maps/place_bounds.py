"""How well a map is placed on Earth, as figures for people: its place, its tilt and its heading."""

import math
from dataclasses import dataclass
from typing import Self

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceBounds:
    """What holds 95 % of the errors of a placement, by its covariance.

    Attributes:
        horizontal_m, vertical_m: of the frame's origin, which is the middle of the photos' positions; metres.
        tilt_deg: of the map's up against the true one.
        heading_deg: of the map about up.
    """

    horizontal_m: float
    vertical_m: float
    tilt_deg: float
    heading_deg: float

    @classmethod
    def of(cls, covariance: FloatArray) -> Self:
        """Of a placement's covariance (7, 7): scale, turn (3), place (3) along the local axes."""
        tilt, heading, across, up = (
            error_radius(covariance[a:b, a:b], 0.95) for a, b in ((1, 3), (3, 4), (4, 6), (6, 7))
        )
        return cls(
            horizontal_m=across,
            vertical_m=up,
            tilt_deg=math.degrees(tilt),
            heading_deg=math.degrees(heading),
        )

    def words(self) -> tuple[str, str]:
        """Place and turn, a sentence each."""
        rise_m = 100.0 * math.tan(math.radians(min(self.tilt_deg, 45.0)))
        return (
            f"place: right to {self.horizontal_m:.2f} m horizontally and {self.vertical_m:.2f} m vertically "
            "(95 %)",
            f"turn: may be tilted by {self.tilt_deg:.1f} degrees, which is {rise_m:.1f} m of height at 100 m "
            f"from its middle, and turned about the vertical by {self.heading_deg:.1f} degrees (95 %)",
        )
