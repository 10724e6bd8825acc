"""Joint adjustment: how it is done, and what came of it."""

from dataclasses import dataclass, field
from typing import Any

from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.anchored import AnchoredOptions
from ingest.growth.graph.joint.links import LinkOptions

JOINT = "joint"  # key of Placement.evidence


@dataclass(frozen=True, slots=True, kw_only=True)
class JointOptions:
    """The joint adjustment.

    Attributes:
        min_shared_points: two maps are connected from so many points on: an accepted pose has 15 inliers,
            and an overlap is measured by 60.
        min_observations: photos that keep fewer refuse the adjustment, if they had more.
        max_residual_growth: the residuals of a map after the adjustment over those before, or over
            `least_sigma_px` where they are smaller; more, and the maps contradict each other. On
            `sacre_coeur` they shrink.
        least_sigma_px: keypoints are not located better, at `reference_side_px`; below, residuals say how few
            photos a map has: one of three photos of `lewis` had 0.14 px alone and 0.30 px with the others,
            of 4,000.
        reference_side_px: longer sides of photos count as at least this.
        min_kept: share of a map's observations that must still fit. On `sacre_coeur`, whose first map was
            bent by a fiftieth of its viewing distance, 0.98 to 1 do; 0.83 where one of two maps shows a
            scene that is bent as much in truth.
        sigmas: of its placement that an anchor's photos may move by, or `least_move_m`.
    """

    min_shared_points: int = 30
    min_observations: int = 15
    max_residual_growth: float = 1.5
    least_sigma_px: float = 0.3
    reference_side_px: int = 1600
    min_kept: float = 0.9
    sigmas: float = 3.0
    least_move_m: float = 0.05
    links: LinkOptions = field(default_factory=LinkOptions)
    adjust: AnchoredOptions = field(default_factory=lambda: AnchoredOptions())


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedMap:
    """What became of one map.

    Attributes:
        held: it was not to move.
        shape_m: root mean square of what its camera centres moved against each other: what no similarity of
            the map explains. move_m: largest way of a camera centre from where the map has it.
        sigma_before_px, sigma_px: of its reprojection errors, before and after.
        kept: share of its observations that still fit.
    """

    map_id: str
    held: bool
    photos: int
    shape_m: float
    move_m: float
    sigma_before_px: float
    sigma_px: float
    kept: float

    def as_json(self) -> dict[str, Any]:
        return {
            "map_id": self.map_id,
            "held": self.held,
            "photos": self.photos,
            "shape_m": round(self.shape_m, 4),
            "move_m": round(self.move_m, 4),
            "sigma_before_px": round(self.sigma_before_px, 4),
            "sigma_px": round(self.sigma_px, 4),
            "kept": round(self.kept, 4),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointAdjustment:
    """Adjusted maps, or why there are none.

    Attributes:
        reason: None, or UNCONNECTED, PHOTO_LOST, RESIDUALS, OBSERVATIONS_LOST, ANCHOR_MOVED; `message` for
            people.
        maps: those that moved, new; empty where there is a reason.
        reports: of each map, as far as it came.
        shared_points: points that more than one map has.
        elsewhere: photos that other maps have elsewhere than their own; they were not heard.
    """

    reason: str | None
    message: str
    maps: tuple[FeatureMap, ...] = ()
    reports: tuple[AdjustedMap, ...] = ()
    shared_points: int = 0
    elsewhere: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "reason": self.reason,
            "message": self.message,
            "maps": [report.as_json() for report in self.reports],
            "shared_points": self.shared_points,
            "elsewhere": list(self.elsewhere),
        }
