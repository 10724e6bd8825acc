"""Anchoring: frames registered to a scan place the whole map on Earth (paper, figure 2).

Frames start from the map's present placement (or from a person's), are registered each on its own, must
agree with each other on where the map goes, and then place it together. Nothing is written here: the result
is a new map, or a reason.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from ingest.executor import Progress, no_progress
from ingest.register.anchor.agreement import AgreementOptions, FrameAgreement, LoneFrame, frames_that_agree
from ingest.register.anchor.frames import FramesOptions, TriedFrame, TriedFrames, register_again, try_frames
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.frame_registration import FramePrior
from ingest.register.structure.adjustment import (
    AdjustLidarOptions,
    LidarAdjustment,
    adjust_to_scan,
    adjusted_map,
)
from ingest.register.structure.map_move import (
    MapMove,
    MapResidual,
    map_move,
    map_residuals,
    viewing_distance_m,
)
from ingest.register.structure.pairs import RegisteredImage
from ingest.register.structure.projection import (
    StructureOptions,
    StructurePlacement,
    placed_map,
    project_structure,
)

_LOG = logging.getLogger(__name__)

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
        fuller_lens_gain: share by which tangential terms must lower the median error of the frames'
            correspondences with the scan, so that the map's lens gets them. Photos alone trade them against
            tilt over flat ground (decision 0004); the scan knows the tilt. Thousands of correspondences gain
            less than a percent by four parameters that are not there.
        fuller_lens_frames: with fewer frames the lens stays as it is.
        min_agreeing: so many frames must agree before a map is moved without a person's word. One frame's
            verdict is good, but two that were found independently and agree cannot both be wrong.
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
    fuller_lens_gain: float = 0.05
    fuller_lens_frames: int = 2
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


def anchor_map(
    feature_map: FeatureMap,
    cloud: PointCloud,
    read_gray: PhotoReader,
    options: AnchorOptions | None = None,
    *,
    starts: Mapping[int, FramePrior] | None = None,
    readable: Sequence[int] | None = None,
    progress: Progress = no_progress,
) -> tuple[TriedFrames, AnchorResult]:
    """Register frames and place the map by them, without a person's word.

    Args:
        cloud: the scan around the map, in the map's local frame.
        read_gray: grey pixels (h, w) uint8 of an image of the map.
        starts: priors by a person, by image id.
        readable: ids of images whose photos are there; None for all.
    """
    options = options or AnchorOptions()
    tried = try_frames(
        feature_map,
        cloud,
        read_gray,
        options.frames,
        starts=starts,
        readable=readable,
        progress=progress,
    )
    result = place_map(
        feature_map, cloud, tried, read_gray, options, supervised=bool(starts), progress=progress
    )
    return tried, result


def place_map(
    feature_map: FeatureMap,
    cloud: PointCloud,
    tried: TriedFrames,
    read_gray: PhotoReader,
    options: AnchorOptions,
    *,
    confirmed: bool = False,
    supervised: bool = False,
    progress: Progress = no_progress,
) -> AnchorResult:
    """Place the map by the frames that were registered, if they agree and all gates are passed.

    Args:
        confirmed: a person has looked at these frames: one is enough.
        supervised: a person has said where the photos are: the map's placement may be wrong by any distance.
    """
    frames = tried.accepted
    if not frames:
        return _nothing_registered(tried)
    started = time.perf_counter()
    lone, refusals = _alone(feature_map, frames, cloud, options)
    agreement = frames_that_agree(lone, options.agreement)
    needed = 1 if confirmed else options.min_agreeing
    refusal = _too_little(frames, lone, refusals, agreement, needed)
    if refusal is not None:
        return replace(refusal, agreement=agreement if lone else None)
    used = [frame for frame in frames if frame.image.image_id in agreement.agreeing]
    seconds = {"agreement": time.perf_counter() - started}
    placed, rounds, words = _place(feature_map, used, cloud, read_gray, options, progress)
    seconds |= {
        "structure projection": sum(r.structure_s for r in rounds),
        "adjustment": sum(r.adjust_s for r in rounds),
        "frames again": sum(f.seconds for r in rounds[1:] for f in r.frames),
    }
    found = AnchorResult(
        reason="STRUCTURE",
        message=words,
        feature_map=None,
        agreement=agreement,
        used=agreement.agreeing,
        rounds=tuple(rounds),
        seconds=seconds,
    )
    if placed is None:
        return found
    return _judged(feature_map, placed, cloud, found, options, supervised=supervised or confirmed)


def _nothing_registered(tried: TriedFrames) -> AnchorResult:
    if not tried.tried:
        return AnchorResult(
            reason="NO_SCAN",
            message="no frame of the map sees enough of the scan from where the map is placed now; "
            "is it the scan of this place? A rough pose (--pose) or picks (--picks) can start elsewhere",
            feature_map=None,
        )
    reasons = "; ".join(
        f"{f.image.name}: {f.registration.reason}: {f.registration.message}" for f in tried.tried
    )
    return AnchorResult(
        reason="NO_FRAME",
        message=f"none of {len(tried.tried)} frames was registered to the scan: {reasons}",
        feature_map=None,
    )


def _alone(
    feature_map: FeatureMap, frames: Sequence[TriedFrame], cloud: PointCloud, options: AnchorOptions
) -> tuple[list[LoneFrame], dict[str, str]]:
    """Where each frame alone sends the map; and why not, by image name, of those that send it nowhere."""
    points = feature_map.points_local(cloud.frame)
    observations = feature_map.observations
    lone: list[LoneFrame] = []
    refused: dict[str, str] = {}
    for frame in frames:
        image = frame.image
        structure = project_structure(
            feature_map, [_registered(frame, feature_map.cameras)], cloud, options.structure
        )
        if not structure.accepted or structure.new_from_old is None:
            refused[image.name] = f"{structure.reason}: {structure.message}"
            continue
        seen = points[np.unique(observations.point_index[observations.image_id == image.image_id])]
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


def _registered(frame: TriedFrame, lens: Sequence[Camera]) -> RegisteredImage:
    """The frame with the lens that it was registered with."""
    return RegisteredImage(
        image_id=frame.image.image_id,
        registration=frame.registration,
        camera=lens[frame.image.camera_id],
    )


def _too_little(
    frames: Sequence[TriedFrame],
    lone: Sequence[LoneFrame],
    refusals: Mapping[str, str],
    agreement: FrameAgreement,
    needed: int,
) -> AnchorResult | None:
    """The refusal where the frames do not carry a placement, or None."""
    names = {frame.image.image_id: frame.image.name for frame in frames}
    if not lone:
        words = "; ".join(f"{name}: {why}" for name, why in refusals.items())
        return AnchorResult(
            reason="STRUCTURE",
            message=f"the map's points do not fit the scan through any registered frame: {words}",
            feature_map=None,
        )
    if not agreement.agreeing or (len(agreement.agreeing) < needed and len(lone) >= 2):
        apart = "; ".join(
            f"{names[a]} and {names[b]}: {m:.2f} m apart, {agreement.allowed_m[a, b]:.2f} m allowed"
            for (a, b), m in agreement.apart_m.items()
        )
        return AnchorResult(
            reason="FRAMES_DISAGREE",
            message=f"the frames send the map to different places ({apart}); look at their overlays and "
            "confirm the right one (--confirm)",
            feature_map=None,
        )
    if len(agreement.agreeing) < needed:
        return AnchorResult(
            reason="TOO_FEW_FRAMES",
            message=f"{len(agreement.agreeing)} frame was registered ({names[agreement.agreeing[0]]}), "
            f"{needed} that agree are needed without a person; look at its overlay and confirm it "
            "(--confirm), or accept one frame (--frames 1)",
            feature_map=None,
        )
    return None


def _place(
    feature_map: FeatureMap,
    frames: Sequence[TriedFrame],
    cloud: PointCloud,
    read_gray: PhotoReader,
    options: AnchorOptions,
    progress: Progress,
) -> tuple[FeatureMap | None, list[PlaceRound], str]:
    """The map by structure projection and adjustment, again with a better lens while that changes.

    A frame registered with a wrong lens finds matches that fit the wrong lens: the adjustment moves it part
    of the way, and the next registration finds others. Each round places the map as it was.
    """
    placed: FeatureMap | None = None
    rounds: list[PlaceRound] = []
    base = feature_map
    for number in range(options.lens_rounds):
        lens = (placed or feature_map).cameras
        registered = [_registered(frame, lens) for frame in frames]
        start, cpu = time.perf_counter(), time.process_time()
        structure = project_structure(feature_map, registered, cloud, options.structure)
        structure_s, structure_cpu_s = time.perf_counter() - start, time.process_time() - cpu
        if not structure.accepted:
            return placed, rounds, f"{structure.reason}: {structure.message}"
        start = time.perf_counter()
        base, adjustment = _adjusted(base, structure, registered, cloud, options, choose=number == 0)
        adjust_s = time.perf_counter() - start
        if adjustment.accepted:
            placed = adjusted_map(base, adjustment, cloud)
        elif placed is None:
            placed = placed_map(feature_map, structure, cloud)
        rounds.append(
            PlaceRound(
                frames=tuple(frames),
                structure_s=structure_s,
                structure_cpu_s=structure_cpu_s,
                adjust_s=adjust_s,
                focal_px=tuple(camera.focal_px for camera in placed.cameras),
                figures={
                    "structure": structure.figures,
                    "adjustment": adjustment.figures | {"reason": adjustment.reason},
                },
            )
        )
        progress("place", number + 1, options.lens_rounds)
        change = max(
            abs(new.focal_px / old.focal_px - 1.0) for new, old in zip(placed.cameras, lens, strict=True)
        )
        if change < options.lens_settled or number + 1 == options.lens_rounds:
            break
        again = register_again(
            placed,
            cloud,
            frames,
            read_gray,
            (options.again_sigma_m, options.again_sigma_deg),
            options.frames.frame,
        )
        kept = [frame for frame in again if frame.registration.accepted]
        if len(kept) < len(frames):
            lost = [f.image.name for f in again if not f.registration.accepted]
            _LOG.warning("not registered again with the adjusted lens: %s", ", ".join(lost))
        if not kept:
            break
        frames = kept
    return placed, rounds, ""


def _adjusted(
    base: FeatureMap,
    structure: StructurePlacement,
    registered: Sequence[RegisteredImage],
    cloud: PointCloud,
    options: AnchorOptions,
    *,
    choose: bool,
) -> tuple[FeatureMap, LidarAdjustment]:
    """The adjustment, and the map that it belongs to: with `choose` one with a fuller lens, if that pays."""
    plain = adjust_to_scan(base, structure, registered, cloud, options.adjust)
    richer = with_fuller_lens(base)
    if not choose or richer is base or len(registered) < options.fuller_lens_frames:
        return base, plain
    fuller = adjust_to_scan(richer, structure, registered, cloud, options.adjust)
    if not fuller.accepted:
        return base, plain
    if plain.accepted:
        before, after = (a.figures["after"]["control_median_px"] for a in (plain, fuller))
        if after > (1.0 - options.fuller_lens_gain) * before:
            return base, plain
    return richer, fuller


def with_fuller_lens(feature_map: FeatureMap) -> FeatureMap:
    """The same map whose radial cameras have tangential terms and two focal lengths, as yet without effect.

    The map itself where no camera is radial.
    """
    cameras = tuple(_fuller(camera) for camera in feature_map.cameras)
    return feature_map if cameras == feature_map.cameras else replace(feature_map, cameras=cameras)


def _fuller(camera: Camera) -> Camera:
    if camera.model not in ("SIMPLE_RADIAL", "RADIAL"):
        return camera
    f, cx, cy, *radial = camera.params
    k1, k2 = (*radial, 0.0)[:2]
    return replace(camera, model="OPENCV", params=(f, f, cx, cy, k1, k2, 0.0, 0.0))


def _judged(
    old: FeatureMap,
    new: FeatureMap,
    cloud: PointCloud,
    found: AnchorResult,
    options: AnchorOptions,
    *,
    supervised: bool,
) -> AnchorResult:
    """The gates on the placed map as a whole."""
    before, after = map_residuals(old, new, cloud)
    move = map_move(old, new)
    distance = viewing_distance_m(new)
    apart = found.agreement.apart_m if found.agreement else {}
    allowed = found.agreement.allowed_m if found.agreement else {}
    checks: dict[str, Any] = {
        "before": before.as_figures(),
        "after": after.as_figures(),
        "move": move.as_figures(),
        "viewing_distance_m": distance,
        "frames_apart_m": [
            {"frames": list(pair), "apart_m": metres, "allowed_m": allowed[pair]}
            for pair, metres in apart.items()
        ],
    }
    found = replace(found, before=before, after=after, checks=checks, message="")
    if not len(after.distance_m) or after.median_m > max(options.max_residual_share * distance, 0.05):
        return replace(
            found,
            reason="NOT_BETTER",
            message=f"the map's points would lie {after.median_m:.2f} m (median) from the scan, "
            f"{max(options.max_residual_share * distance, 0.05):.2f} m allowed",
        )
    if after.median_m > max(before.median_m, 0.05):
        return replace(
            found,
            reason="NOT_BETTER",
            message=f"the map's points lie {before.median_m:.2f} m (median) from the scan now and would lie "
            f"{after.median_m:.2f} m from it",
        )
    words = None if supervised else _contradiction(move, options)
    if words is not None:
        return replace(found, reason="CONTRADICTS_PLACEMENT", message=words)
    evidence = new.placement.evidence | {
        "anchor": checks
        | {
            "frames": _names(old, found.used),
            "rounds": [
                {"focal_px": list(r.focal_px), "structure_s": r.structure_s, "adjust_s": r.adjust_s}
                for r in found.rounds
            ],
            "supervised": supervised,
        }
    }
    placement = replace(new.placement, evidence=evidence)
    placed = replace(new, placement=placement, generation=0, parents=(), status="active")
    return replace(found, reason=None, feature_map=placed)


def _contradiction(move: MapMove, options: AnchorOptions) -> str | None:
    """Why the map cannot be there by its placement, or None. Heights are not judged, see AnchorOptions."""
    far = options.max_placement_sigmas
    if move.horizontal_m > options.min_move_m and move.horizontal_sigmas > far:
        what = f"move by {move.horizontal_m:.1f} m in plan, {move.horizontal_sigmas:.1f} sigmas"
    elif abs(move.heading_deg) > options.min_turn_deg and move.heading_sigmas > far:
        what = f"turn by {move.heading_deg:.1f} degrees, {move.heading_sigmas:.1f} sigmas"
    elif move.tilt_deg > options.min_turn_deg and move.tilt_sigmas > far:
        what = f"tilt by {move.tilt_deg:.1f} degrees, {move.tilt_sigmas:.1f} sigmas"
    elif abs(move.scale - 1.0) > options.max_scale_change and move.scale_sigmas > far:
        what = f"change its scale by {100 * (move.scale - 1.0):+.1f} %, {move.scale_sigmas:.1f} sigmas"
    else:
        return None
    return (
        f"the map would {what} of its present placement, {far:.0f} allowed; if that placement is known to be "
        "wrong, confirm the frames (--confirm)"
    )


def _names(feature_map: FeatureMap, ids: Sequence[int]) -> list[str]:
    return [image.name for image in feature_map.images if image.image_id in ids]
