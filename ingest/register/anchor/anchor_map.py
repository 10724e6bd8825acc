"""Anchoring: frames registered to a scan place the whole map on Earth (paper, figure 2).

Frames start from the map's present placement (or from a person's), are registered together or each on its
own, must agree with each other on where the map goes, and then place it together. Nothing is written here:
the result is a new map, or a reason. Gates ask of the map as a whole whether it lies on the scan, and may be
there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from featuredb.stage_clock import StageClock
from ingest.executor import Progress, no_progress
from ingest.register.anchor.frames import (
    FrameAgreement,
    LoneFrame,
    TriedFrame,
    TriedFrames,
    frames_that_agree,
)
from ingest.register.anchor.placing import PlaceRound, place_in_rounds
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.block import block_of_map
from ingest.register.structure.projection import project_structure
from ingest.register.structure.surface_fit import MapMove, map_move, map_residuals, median_m

# How far the map may move in the plane and turn, in standard deviations of its placement. Six, because
# receivers understate their errors. Heights are not judged: those of GPS have an unknown datum and differ
# from a scan's by tens of metres.
_MAX_PLACEMENT_SIGMAS = 6.0
# That much is always allowed.
_MIN_MOVE_M = 2.0
_MIN_TURN_DEG = 2.0
_MAX_SCALE_CHANGE = 0.1  # relative; GPS and scan both measure metres
# Median distance of the map's points from the scan after, as a share of the distance from which they are
# seen: 0.02 is 1 m from 50 m, what trees and a day's change leave.
_MAX_RESIDUAL_SHARE = 0.02
_GOOD_M = 0.05  # and that much is no objection
# So many frames must agree before a map is moved without a person's word. One frame's verdict is good; two
# that were found independently and agree are hardly both wrong. Who asks for one frame does not ask for two.
_MIN_AGREEING = 2

AnchorReason = Literal[
    "NO_SCAN",  # no frame of the map sees the scan
    "NO_FRAME",  # no frame was registered
    "TOO_FEW_FRAMES",  # fewer agree than are needed without a person
    "FRAMES_DISAGREE",  # frames send the map to different places, and none are in the majority
    "STRUCTURE",  # the map's points do not lie on the scan under any similarity
    "CONTRADICTS_PLACEMENT",  # the map would go where its placement says it cannot be
    "NOT_BETTER",  # the map's points are no closer to the scan than before
]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnchorResult:
    """A placed map, or why there is none.

    Attributes:
        reason, message: of the refusal; None and "" for a placed map.
        feature_map: the map at its new place, None when refused.
        agreement: of the frames, None where there was nothing to compare.
        used: ids of the images that placed the map.
        rounds: of placing; more than one where the lens changed.
        before, after: (k,) distances of map points from the scan, metres; None where it was not come to.
        checks: figures of the gates, JSON-able.
        seconds: wall time by step.
    """

    reason: AnchorReason | None
    message: str
    feature_map: FeatureMap | None = None
    agreement: FrameAgreement | None = None
    used: tuple[int, ...] = ()
    rounds: tuple[PlaceRound, ...] = ()
    before: FloatArray | None = None
    after: FloatArray | None = None
    checks: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def place_map(
    feature_map: FeatureMap,
    cloud: PointCloud,
    tried: TriedFrames,
    read_gray: PhotoReader,
    wanted: int,
    *,
    confirmed: bool = False,
    supervised: bool = False,
    progress: Progress = no_progress,
) -> AnchorResult:
    """Place the map by the frames that were registered, if they agree and all gates are passed.

    Args:
        wanted: frames that were asked for.
        confirmed: a person has looked at these frames: one is enough.
        supervised: a person has said where the photos are: the map's placement may be wrong by any distance.
    """
    frames = tried.accepted
    clock = StageClock()
    lone, refusals = _alone(feature_map, frames, cloud)
    agreement = frames_that_agree(lone)
    needed = 1 if confirmed else min(_MIN_AGREEING, wanted)
    refusal = _too_little(tried, lone, refusals, agreement, needed)
    if refusal is not None:
        reason, message = refusal
        return AnchorResult(reason=reason, message=message, agreement=agreement if lone else None)
    used = [frame for frame in frames if frame.image.image_id in agreement.agreeing]
    clock.lap("agreement")
    placed, rounds, words = place_in_rounds(feature_map, used, cloud, read_gray, progress)
    seconds = clock.seconds | {
        "structure projection": sum(r.structure_s for r in rounds),
        "adjustment": sum(r.adjust_s for r in rounds),
        "frames again": sum(f.seconds for r in rounds[1:] for f in r.frames),
    }
    found = AnchorResult(
        reason="STRUCTURE",
        message=words,
        agreement=agreement,
        used=agreement.agreeing,
        rounds=tuple(rounds),
        seconds=seconds,
    )
    if placed is None:
        return found
    return _judged(feature_map, placed, cloud, found, supervised=supervised or confirmed)


def on_outlines(feature_map: FeatureMap, cloud: PointCloud) -> AnchorResult:
    """A map that outlines have placed (`ingest.register.anchor.ground`), with its evidence.

    It waits in quarantine: how often outlines place a map wrongly is not known yet. How far its points lie
    from the scan's is told, not judged: a laser in the air sees hardly any fronts.
    """
    residual, _ = map_residuals(feature_map, feature_map, cloud)
    return AnchorResult(
        reason=None,
        message="",
        feature_map=replace(feature_map, generation=0, parents=(), status="quarantined"),
        before=residual,
        after=residual,
        checks={
            "move": asdict(map_move(feature_map, feature_map)),
            "outlines": feature_map.placement.evidence["outlines"],
        },
    )


def _alone(
    feature_map: FeatureMap, frames: Sequence[TriedFrame], cloud: PointCloud
) -> tuple[list[LoneFrame], dict[str, str]]:
    """Where each frame alone sends the map; and why not, by image name, of those that send it nowhere."""
    points = feature_map.points_local(cloud.frame)
    lone: list[LoneFrame] = []
    refused: dict[str, str] = {}
    for frame in frames:
        image = frame.image
        structure = project_structure(feature_map, {image.image_id: frame.registration}, cloud)
        if not structure.accepted or structure.new_from_old is None:
            refused[image.name] = f"{structure.reason}: {structure.message}"
            continue
        seen = points[np.unique(feature_map.points_in(image))]
        distance = np.median(np.linalg.norm(seen - image.cam_from_local.center, axis=1))
        lone.append(
            LoneFrame(
                image_id=image.image_id,
                new_from_old=structure.new_from_old,
                points=seen,
                distance_m=float(distance),
            )
        )
    return lone, refused


def _too_little(
    tried: TriedFrames,
    lone: Sequence[LoneFrame],
    refusals: Mapping[str, str],
    agreement: FrameAgreement,
    needed: int,
) -> tuple[AnchorReason, str] | None:
    """Why the frames do not carry a placement, or None."""
    names = {frame.image.image_id: frame.image.name for frame in tried.tried}
    if not tried.tried:
        return "NO_SCAN", (
            "no frame of the map sees enough of the scan from where the map is placed now; is it the scan of "
            "this place? A rough pose (--pose) or picks (--picks) can start elsewhere"
        )
    if not tried.accepted:
        found = [(f.image.name, f.registration) for f in tried.tried]
        words = "; ".join(f"{name}: {one.reason}: {one.message}" for name, one in found)
        return "NO_FRAME", f"none of {len(found)} frames was registered to the scan: {words}"
    if not lone:
        words = "; ".join(f"{name}: {why}" for name, why in refusals.items())
        return "STRUCTURE", f"the map's points do not fit the scan through any registered frame: {words}"
    if not agreement.agreeing or (len(agreement.agreeing) < needed and len(lone) >= 2):
        words = "; ".join(
            f"{names[a]} and {names[b]}: {metres:.2f} m apart, {allowed:.2f} m allowed"
            for (a, b), (metres, allowed) in agreement.apart_m.items()
        )
        return "FRAMES_DISAGREE", (
            f"the frames send the map to different places ({words}); look at them in anchor.html and "
            "confirm the right one (--confirm)"
        )
    if len(agreement.agreeing) < needed:
        words = "".join(f"; {name}: {why}" for name, why in refusals.items())
        return "TOO_FEW_FRAMES", (
            f"{len(agreement.agreeing)} frame places the map, {names[agreement.agreeing[0]]}{words}"
            f"; {needed} that agree are needed without a person; look at it in anchor.html and confirm it "
            "(--confirm), or accept one frame (--frames 1)"
        )
    return None


def _judged(
    old: FeatureMap, new: FeatureMap, cloud: PointCloud, found: AnchorResult, *, supervised: bool
) -> AnchorResult:
    """The gates on the placed map as a whole."""
    before, after = map_residuals(old, new, cloud)
    before_m, after_m = median_m(before), median_m(after)
    move = map_move(old, new)
    distance = float(np.median(block_of_map(new).distances()))
    most_m = max(_MAX_RESIDUAL_SHARE * distance, _GOOD_M)
    assert found.agreement is not None
    checks: dict[str, Any] = {
        "before": {"compared": len(before), "median_m": before_m},
        "after": {"compared": len(after), "median_m": after_m},
        "move": asdict(move),
        "viewing_distance_m": distance,
        "frames_apart_m": [
            {"frames": list(pair), "apart_m": metres, "allowed_m": allowed}
            for pair, (metres, allowed) in found.agreement.apart_m.items()
        ],
    }
    found = replace(found, before=before, after=after, checks=checks, message="")
    now, then = f"{before_m:.2f} m (median)", f"{after_m:.2f} m"
    if not after_m <= most_m:  # NaN where nothing could be compared
        words = f"the map's points would lie {then} (median) from the scan, {most_m:.2f} m allowed"
        return replace(found, reason="NOT_BETTER", message=words)
    if after_m > max(before_m, _GOOD_M):
        words = f"the map's points lie {now} from the scan now and would lie {then} from it"
        return replace(found, reason="NOT_BETTER", message=words)
    contradiction = None if supervised else _contradiction(move)
    if contradiction is not None:
        return replace(found, reason="CONTRADICTS_PLACEMENT", message=contradiction)
    names = [image.name for image in old.images if image.image_id in found.used]
    evidence = {"anchor": checks | {"frames": names, "supervised": supervised}}
    placement = replace(new.placement, evidence=new.placement.evidence | evidence)
    placed = replace(new, placement=placement, generation=0, parents=(), status="active")
    return replace(found, reason=None, feature_map=placed)


def _contradiction(move: MapMove) -> str | None:
    """Why the map cannot be there by its placement, or None; heights are not judged."""
    far = _MAX_PLACEMENT_SIGMAS
    if move.horizontal_m > _MIN_MOVE_M and move.horizontal_sigmas > far:
        what = f"move by {move.horizontal_m:.1f} m in plan, {move.horizontal_sigmas:.1f} sigmas"
    elif abs(move.heading_deg) > _MIN_TURN_DEG and move.heading_sigmas > far:
        what = f"turn by {move.heading_deg:.1f} degrees, {move.heading_sigmas:.1f} sigmas"
    elif move.tilt_deg > _MIN_TURN_DEG and move.tilt_sigmas > far:
        what = f"tilt by {move.tilt_deg:.1f} degrees, {move.tilt_sigmas:.1f} sigmas"
    elif abs(move.scale - 1.0) > _MAX_SCALE_CHANGE and move.scale_sigmas > far:
        what = f"change its scale by {100 * (move.scale - 1.0):+.1f} %, {move.scale_sigmas:.1f} sigmas"
    else:
        return None
    return (
        f"the map would {what} of its present placement, {far:.0f} allowed; if that placement is known to be "
        "wrong, confirm the frames (--confirm)"
    )
