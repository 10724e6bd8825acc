"""Values of anchoring: its options, one round of placing, and the result with its reasons."""

from dataclasses import dataclass, field
from typing import Any, Literal

from featuredb.maps.feature_map import FeatureMap
from ingest.register.anchor.agreement import AgreementOptions, FrameAgreement
from ingest.register.anchor.frames import FramesOptions, TriedFrame
from ingest.register.structure.adjustment_options import AdjustLidarOptions
from ingest.register.structure.map_move import MapResidual
from ingest.register.structure.projection import StructureOptions

AnchorReason = Literal[
    "NO_SCAN",  # no frame of the map sees the scan
    "NO_FRAME",  # no frame was registered
    "TOO_FEW_FRAMES",  # fewer agree than are needed without a person
    "FRAMES_DISAGREE",  # frames send the map to different places, and none are in the majority
    "STRUCTURE",  # the map's points do not lie on the scan under any similarity
    "CONTRADICTS_PLACEMENT",  # the map would go where its placement says it cannot be
    "NOT_BETTER",  # the map's points are no closer to the scan than before
]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorOptions:
    """How a map is anchored.

    Attributes:
        frames: which frames, and how each is registered.
        agreement: of frames with each other.
        structure, adjust: of the placing.
        min_agreeing: so many frames must agree before a map is moved without a person's word. One frame's
            verdict is good; two that were found independently and agree are hardly both wrong.
        max_placement_sigmas: how far the map may move in the plane and turn, in standard deviations of its
            placement. Six, because receivers understate their errors. Heights are not judged: those of GPS
            have an unknown datum and differ from a scan's by tens of metres.
        min_move_m, min_turn_deg: that much is always allowed.
        max_scale_change: relative; GPS and scan both measure metres.
        max_residual_share: median distance of the map's points from the scan after, as a share of the
            distance from which they are seen: 0.02 is 1 m from 50 m, what trees and a day's change leave.
        lens_rounds: a map's lens is adjusted with its placement; while it changes, frames are registered
            again with the better one, so many times at most.
        lens_settled: relative change of the focal length that needs no further round: 0.3 % is 0.15 m of
            height from 50 m.
        again_sigma_m, again_sigma_deg: prior of frames that are registered again.
    """

    frames: FramesOptions = field(default_factory=FramesOptions)
    agreement: AgreementOptions = field(default_factory=AgreementOptions)
    structure: StructureOptions = field(default_factory=StructureOptions)
    adjust: AdjustLidarOptions = field(default_factory=AdjustLidarOptions)
    min_agreeing: int = 2
    max_placement_sigmas: float = 6.0
    min_move_m: float = 2.0
    min_turn_deg: float = 2.0
    max_scale_change: float = 0.1
    max_residual_share: float = 0.02
    lens_rounds: int = 4
    lens_settled: float = 0.003
    again_sigma_m: float = 2.0
    again_sigma_deg: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaceRound:
    """One round of projecting the structure and adjusting the map.

    Attributes:
        frames: as they were registered for it.
        structure_s, adjust_s: wall time of the two steps. structure_cpu_s: processor time of the first.
        focal_px: of the map's cameras after it.
        figures: of both steps, JSON-able.
    """

    frames: tuple[TriedFrame, ...]
    structure_s: float
    structure_cpu_s: float
    adjust_s: float
    focal_px: tuple[float, ...]
    figures: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnchorResult:
    """A placed map, or why there is none.

    Attributes:
        reason, message: of the refusal; None and "" for a placed map.
        feature_map: the map at its new place, None when refused.
        agreement: of the frames, None where there was nothing to compare.
        used: ids of the images that placed the map.
        rounds: of placing; more than one where the lens changed.
        before, after: how the map lies on the scan, None where it was not come to.
        checks: figures of the gates, JSON-able.
        seconds: wall time by step.
    """

    reason: AnchorReason | None
    message: str
    feature_map: FeatureMap | None
    agreement: FrameAgreement | None = None
    used: tuple[int, ...] = ()
    rounds: tuple[PlaceRound, ...] = ()
    before: MapResidual | None = None
    after: MapResidual | None = None
    checks: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
