"""How far a map is thinned."""

from dataclasses import dataclass

from featuredb.errors import InvalidValueError


@dataclass(frozen=True, slots=True, kw_only=True)
class ThinOptions:
    """How far a map is thinned.

    Attributes:
        cover: K, described points that each image keeps seeing. From 400 on the simulated town gains hardly
            any answer within its limits (docs/measurements/growth.md).
        max_views: described observations that a chosen point keeps, those that differ most in direction and
            distance. More only repeat what the mean descriptor says already.
        keep_points: points that are not chosen stay without descriptors.
    """

    cover: int = 400
    max_views: int = 8
    keep_points: bool = True

    def __post_init__(self) -> None:
        # Localisation believes a pose from 15 inliers on, and a photo finds only a part of what is there.
        if self.cover < 15:
            raise InvalidValueError(f"ThinOptions.cover: expected at least 15 points, found {self.cover}")
        if self.max_views < 2:
            raise InvalidValueError(f"ThinOptions.max_views: expected at least 2, found {self.max_views}")
