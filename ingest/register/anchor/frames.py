"""The first half of anchoring: frames of a map, ranked and registered to a scan, together or one by one."""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.executor import Progress, no_progress
from ingest.register.anchor.proposals import FrameProposal, PhotoReader, propose_frames
from ingest.register.anchor.start.priors import HeightShift, height_shift, prior_from_map
from ingest.register.anchor.together import TOGETHER, prior_by_others, register_together
from ingest.register.frame.register import fit_vouched_for, register_frame
from ingest.register.frame_registration import FramePrior, FrameRegistration

_LOG = logging.getLogger(__name__)

FRAMES = 3  # accepted ones that are wanted; three spread ones show most of a map's bend
# Frames tried until the first is registered, at most: more than are wanted. A wrong scan costs all of them.
_LEAST_TRIES, _SPARE_TRIES = 6, 3
# Frames tried at most once one is registered. Where one of three registers, as low films over a scan without
# colours, 18 leave fewer than two registered once in 150 maps.
_MORE_TRIES = 18
_LEAST_TOGETHER = 2  # as many as must agree without a person
# How far a placed map's frames may be off that are registered again.
_AGAIN_SIGMA_M = 2.0
_AGAIN_SIGMA_DEG = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriedFrame:
    """A frame that was tried from its proposal's prior: `seconds` are wall time, `cpu_s` the processor's."""

    proposal: FrameProposal
    registration: FrameRegistration
    seconds: float
    cpu_s: float

    @property
    def image(self) -> MapImage:
        return self.proposal.image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriedFrames:
    """What came of the first half.

    Attributes:
        shift: heights of the scan less those of the map; None where they hardly lie above each other.
        ranking: all frames that see the scan, most promising first.
        tried: the frames that were tried, in order.
        unreadable: why photos could not be opened, by image name.
    """

    shift: HeightShift | None
    ranking: tuple[FrameProposal, ...]
    tried: tuple[TriedFrame, ...]
    unreadable: Mapping[str, str] = field(default_factory=dict)

    @property
    def accepted(self) -> list[TriedFrame]:
        return [frame for frame in self.tried if frame.registration.accepted]

    @classmethod
    def of_registrations(
        cls, feature_map: FeatureMap, registrations: Mapping[int, FrameRegistration]
    ) -> "TriedFrames":
        """Frames that were registered earlier, as they were; their ranks and priors are no longer known."""
        images = {image.image_id: image for image in feature_map.images}
        tried = []
        for image_id, found in registrations.items():
            assert found.cam_from_local is not None
            proposal = _unranked(images[image_id], FramePrior.around(found.cam_from_local, 1.0, 1.0))
            seconds, nan = sum(found.seconds.values()), float("nan")
            tried.append(TriedFrame(proposal=proposal, registration=found, seconds=seconds, cpu_s=nan))
        return cls(shift=None, ranking=(), tried=tuple(tried))


def try_frames(
    feature_map: FeatureMap,
    cloud: PointCloud,
    read_gray: PhotoReader,
    wanted: int,
    *,
    starts: Mapping[int, FramePrior] | None = None,
    readable: Sequence[int] | None = None,
    together: bool = True,
    progress: Progress = no_progress,
) -> TriedFrames:
    """Rank the map's frames and register the best until enough are accepted.

    Each frame starts from its own prior and knows nothing of the others, so that their agreement is evidence.
    Where the scan has no colours, or one frame is refused, all photos together are asked where the map is,
    and register the frames if they tell; not where a person says where single photos are.

    Args:
        cloud: the scan around the map, in the map's local frame.
        read_gray: grey pixels (h, w) of an image of the map.
        wanted: accepted frames.
        starts: priors by a person, by image id; these frames are tried first.
        readable: ids of images whose photos are there; None for all.
        together: ask all photos together. Not where the map was put where it looks most like the scan: the
            evidence of all photos would be that look once more.
    """
    starts = starts or {}
    shift = height_shift(feature_map, cloud)
    ids = {i.image_id for i in feature_map.images} if readable is None else set(readable)
    priors = {
        image.image_id: starts.get(image.image_id, prior_from_map(feature_map, image, shift))
        for image in feature_map.images
        if image.image_id in ids
    }
    unreadable: dict[str, str] = {}
    ranking = propose_frames(feature_map, cloud, priors)
    ranked = {p.image.image_id: p for p in ranking}
    images = {image.image_id: image for image in feature_map.images}
    # A frame that a person chose is tried whether it sees much of the scan or not.
    order = [ranked.get(i) or _unranked(images[i], prior) for i, prior in starts.items()]
    order += [p for p in ranking if p.image.image_id not in starts]
    tried: list[TriedFrame] = []
    vouched: list[TriedFrame] = []
    least = max(_LEAST_TRIES, wanted + _SPARE_TRIES, len(starts))
    ask = together and not starts
    if ask and cloud.rgb is None:
        ask, vouched = False, _tried_together(feature_map, cloud, ranking, read_gray, wanted)
    for proposal in order:
        accepted = sum(frame.registration.accepted for frame in tried)
        most = max(least, _MORE_TRIES) if accepted else least
        if vouched or accepted >= wanted or len(tried) >= most:
            break
        frame = _try(feature_map, cloud, proposal, read_gray, unreadable)
        if frame is None:
            continue
        tried.append(frame)
        progress("register", accepted + frame.registration.accepted, wanted)
        if ask and not frame.registration.accepted:
            ask, vouched = False, _tried_together(feature_map, cloud, ranking, read_gray, wanted)
    by_others = {frame.image.image_id for frame in vouched}
    tried = [frame for frame in tried if frame.image.image_id not in by_others] + vouched
    return TriedFrames(shift=shift, ranking=tuple(ranking), tried=tuple(tried), unreadable=unreadable)


def _tried_together(
    feature_map: FeatureMap,
    cloud: PointCloud,
    ranking: Sequence[FrameProposal],
    read_gray: PhotoReader,
    wanted: int,
) -> list[TriedFrame]:
    """The frames that all photos together register; none where these do not tell, or too few."""
    start, cpu = time.perf_counter(), time.process_time()
    found = register_together(feature_map, [p.image for p in ranking], cloud, read_gray, wanted)
    if found is None or len(found) < min(wanted, _LEAST_TOGETHER):
        return []
    each = {
        "seconds": (time.perf_counter() - start) / len(found),
        "cpu_s": (time.process_time() - cpu) / len(found),
    }
    proposals = {p.image.image_id: p for p in ranking}
    return [TriedFrame(proposal=proposals[i], registration=one, **each) for i, one in found.items()]


def _unranked(image: MapImage, prior: FramePrior) -> FrameProposal:
    unknown = dict.fromkeys(("score", "coverage", "downward", "spread"), float("nan"))
    return FrameProposal(image=image, prior=prior, points=0, **unknown)


def _try(
    feature_map: FeatureMap,
    cloud: PointCloud,
    proposal: FrameProposal,
    read_gray: PhotoReader,
    unreadable: dict[str, str],
    before: FrameRegistration | None = None,
) -> TriedFrame | None:
    """A frame by itself, or where others vouch for it, as they did `before` with another lens.

    None where its photo cannot be read: `unreadable` takes up why, by the image's name.
    """
    try:
        gray = read_gray(proposal.image)
    except ImageError as error:
        unreadable[proposal.image.name] = str(error)
        _LOG.warning("photo %s cannot be read: %s", proposal.image.name, error)
        return None
    camera = feature_map.cameras[proposal.image.camera_id]
    start, cpu = time.perf_counter(), time.process_time()
    if before is not None and before.source is not None and TOGETHER in before.evidence:
        evidence = {TOGETHER: before.evidence[TOGETHER]}
        registration = fit_vouched_for(gray, camera, proposal.prior, cloud, before.source, evidence)
    else:
        registration = register_frame(gray, camera, proposal.prior, cloud)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    outcome = registration.reason or f"registered by {registration.source}"
    _LOG.info("%s: %s in %.1f s", proposal.image.name, outcome, seconds)
    return TriedFrame(proposal=proposal, registration=registration, seconds=seconds, cpu_s=cpu_s)


def register_again(
    feature_map: FeatureMap, cloud: PointCloud, frames: Sequence[TriedFrame], read_gray: PhotoReader
) -> list[TriedFrame]:
    """Register frames anew from where a placed map has them, with its lens."""
    again = []
    images = {image.image_id: image for image in feature_map.images}
    points = feature_map.points_local(cloud.frame)
    for frame in frames:
        image = images[frame.image.image_id]
        prior = FramePrior.around(image.cam_from_local, _AGAIN_SIGMA_M, _AGAIN_SIGMA_DEG)
        if TOGETHER in frame.registration.evidence:
            prior = prior_by_others(image.cam_from_local, points[feature_map.points_in(image)])
        proposal = replace(frame.proposal, image=image, prior=prior)
        tried = _try(feature_map, cloud, proposal, read_gray, {}, frame.registration)
        if tried is not None:
            again.append(tried)
    return again


# Do frames that were registered one by one move the map to the same place? What both see is compared: far
# from both, small differences of tilt and the bend of the reconstruction grow without anyone being wrong.

# Median distance between the places of the same map points, as a share of the distance from which they are
# seen. Right frames are up to 0.27 m apart on brighton, from 40 to 50 m; this allows five times that.
_MAX_APART_SHARE = 0.03
_MIN_APART_M = 0.3  # and never less than this, for frames that are close to what they see


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoneFrame:
    """One frame and the similarity of the map's local frame that it alone gives.

    Attributes:
        points: (n, 3) map points that the frame sees, old local frame.
        distance_m: median distance from the camera to them.
    """

    image_id: int
    new_from_old: Sim3
    points: FloatArray
    distance_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAgreement:
    """Which frames belong together.

    Attributes:
        agreeing: ids of the largest set of frames that all agree pairwise; empty where two such sets are
            equally large and neither can be preferred.
        apart_m: median distance between the places of common points, and what is allowed, by pair of ids.
    """

    agreeing: tuple[int, ...]
    apart_m: Mapping[tuple[int, int], tuple[float, float]]


def frames_that_agree(frames: Sequence[LoneFrame]) -> FrameAgreement:
    """The largest set of frames whose similarities agree."""
    apart: dict[tuple[int, int], tuple[float, float]] = {}
    for a, b in combinations(frames, 2):
        points = np.vstack([a.points, b.points])
        difference = a.new_from_old.act(points) - b.new_from_old.act(points)
        allowed = max(_MAX_APART_SHARE * max(a.distance_m, b.distance_m), _MIN_APART_M)
        apart[a.image_id, b.image_id] = float(np.median(np.linalg.norm(difference, axis=1))), allowed
    agreeing = {pair for pair, (metres, allowed) in apart.items() if metres <= allowed}
    ids = [frame.image_id for frame in frames]
    for size in range(len(ids), 0, -1):
        sets = [chosen for chosen in combinations(ids, size) if agreeing.issuperset(combinations(chosen, 2))]
        if len(sets) == 1 or (sets and size > len(ids) / 2):
            best = min(sets, key=lambda s: sum((apart[pair][0] for pair in combinations(s, 2)), 0.0))
            return FrameAgreement(agreeing=best, apart_m=apart)
        if sets:
            break
    return FrameAgreement(agreeing=(), apart_m=apart)
