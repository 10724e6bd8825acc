"""Anchoring: frames registered to a scan place the whole map on Earth (paper, figure 2).

Frames start from the map's present placement (or from a person's), are registered each on its own, must
agree with each other on where the map goes, and then place it together. Nothing is written here: the result
is a new map, or a reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from featuredb.stage_clock import StageClock
from ingest.executor import Progress, no_progress
from ingest.register.anchor.agreement import FrameAgreement, LoneFrame, frames_that_agree
from ingest.register.anchor.frames import TriedFrame, TriedFrames
from ingest.register.anchor.gates import judged
from ingest.register.anchor.placing import place_in_rounds, with_lens
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.anchor.values import AnchorOptions, AnchorResult
from ingest.register.structure.projection import (
    project_structure,
)


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
    clock = StageClock()
    lone, refusals = _alone(feature_map, frames, cloud, options)
    agreement = frames_that_agree(lone, options.agreement)
    needed = 1 if confirmed else options.min_agreeing
    refusal = _too_little(frames, lone, refusals, agreement, needed)
    if refusal is not None:
        return replace(refusal, agreement=agreement if lone else None)
    used = [frame for frame in frames if frame.image.image_id in agreement.agreeing]
    clock.lap("agreement")
    placed, rounds, words = place_in_rounds(feature_map, used, cloud, read_gray, options, progress)
    seconds = clock.seconds | {
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
    return judged(feature_map, placed, cloud, found, options, supervised=supervised or confirmed)


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
            feature_map, [with_lens(frame, feature_map.cameras)], cloud, options.structure
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
        others = "".join(f"; {name}: {why}" for name, why in refusals.items())
        return AnchorResult(
            reason="TOO_FEW_FRAMES",
            message=f"{len(agreement.agreeing)} frame places the map, {names[agreement.agreeing[0]]}{others}"
            f"; {needed} that agree are needed without a person; look at its overlay and confirm it "
            "(--confirm), or accept one frame (--frames 1)",
            feature_map=None,
        )
    return None
