"""A feature map without a place on Earth: a reconstruction in a frame of its own.

It is another type than `FeatureMap`, so that nothing that needs a place takes one by mistake. A placement
makes a FeatureMap of it, under the same map id.
"""

from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapParts, PointColumns
from featuredb.maps.statuses import UNPLACED_STATUSES as UNPLACED_STATUSES
from featuredb.maps.statuses import UnplacedStatus as UnplacedStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnFrame:
    """The right-handed frame of a map without a place; its origin means nothing.

    Attributes:
        metric: one unit is one metre, up to what the map's evidence says. Otherwise the scale is arbitrary:
            the median distance from a camera to the points that it sees is set to `NOMINAL_DISTANCE`.
        upright: z is up. Otherwise the axes are arbitrary.
    """

    metric: bool
    upright: bool


# Units; between a photo of a front and one from a drone, so that numbers are of a size that people expect.
NOMINAL_DISTANCE = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NoPlace:
    """Why a map has no place, and what would give it one.

    Attributes:
        reason_code: as in ingest reports (TOO_FEW, RESIDUALS, DEGENERATE_LINE, ...).
        ways: commands or means that would place it, a sentence each.
        evidence: figures behind the reason, JSON-able.
    """

    reason_code: str
    reason: str
    ways: tuple[str, ...] = ()
    evidence: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.reason_code or not self.reason:
            raise InvalidValueError("NoPlace: expected a reason code and a reason, found none")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnPoints(PointColumns):
    """The 3D points of a map without a place.

    Attributes:
        xyz: (n, 3) float64 in the map's own frame.
    """

    coordinates = "xyz"
    xyz: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnplacedMap(MapParts):
    """A reconstruction without a place, complete.

    Attributes:
        frame: of poses, points and covariances.
        images: `cam_from_local` leads from the own frame to the camera.
        status: unplaced or retired.

    Raises:
        InvalidValueError: parts that contradict each other, or an unknown status.
    """

    statuses = UNPLACED_STATUSES

    frame: OwnFrame
    points: OwnPoints
    no_place: NoPlace
    status: UnplacedStatus = "unplaced"

    def points_local(self) -> FloatArray:
        """Points (n, 3) in the own frame."""
        return self.points.xyz


AnyMap: TypeAlias = FeatureMap | UnplacedMap
# A function over maps of either kind that gives back what it was given.
MapKind = TypeVar("MapKind", FeatureMap, UnplacedMap)
