"""The poses that clusters of map images give a photo, each with its matches and the evidence for it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from featuredb.errors import InvalidValueError
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.stage_clock import StageClock
from reloc.localise.acceptance import (
    agreement,
    coverage,
    expected_cells,
    independent_inliers,
    log_nfa,
    spread,
)
from reloc.localise.candidates import Cluster, IndexedArea, find_clusters
from reloc.localise.lens_prior import is_lens_of_a_map, lens_for, seen_by_a_map
from reloc.localise.matching import (
    EXPECTED_DEG,
    POSSIBLE_DEG,
    ClusterMatcher,
    Matches,
    guided_matches,
    visible_points,
)
from reloc.localise.options import LocaliseOptions
from reloc.localise.pose import (
    PoseHypothesis,
    estimate_pose,
    refine_pose,
    reprojection_errors,
    with_any_lens,
)
from reloc.localise.result import Evidence, LocaliseRequest
from reloc.wire.query import CameraSource, Reason

_MORE_BY_REFINING = 2  # times RANSAC's inliers
_OTHER_LENS_RATE = 1e-3  # of whole photos that are taken for parts, if neither lens was fitted to the matches
_FEWEST_CELLS = 10  # of a hundred in which a photo should show the map; fewer say little of its agreement


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseCandidate:
    """The best pose that one cluster gives, with its matches and the evidence for it."""

    area: Area
    pose: PoseHypothesis
    matches: Matches
    evidence: Evidence
    rows: NDArray[np.intp]  # matches that are independent inliers

    @property
    def main_map(self) -> FeatureMap:
        """The map with most inliers."""
        rows = self.rows if len(self.rows) else slice(None)
        return self.area.maps[int(np.bincount(self.area.map_of(self.matches.point[rows])).argmax())]


def search(
    features: Features,
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions,
    clock: StageClock,
) -> tuple[list[PoseCandidate], int, tuple[Reason, str] | None]:
    """Candidates, best first; matches of the best cluster; where there is nothing to decide on, why."""
    if len(features) < options.acceptance.min_inliers:
        text = f"{len(features)} keypoints in the photo; it shows too little texture"
        return [], 0, ("TOO_FEW_FEATURES", text)
    clusters = find_clusters(areas, features, request.prior, options.candidates, request.beyond)
    clock.lap("candidates")
    if not clusters:
        return [], 0, ("NO_COVERAGE", _nothing_to_ask(areas, request))
    tries = [ClusterMatcher(features, cluster, options.matching) for cluster in clusters]
    candidates: list[PoseCandidate] = []
    most = 0
    while tries:
        matcher, *tries = tries
        found, count = _ClusterSearch(
            features=features, matcher=matcher, request=request, options=options, clock=clock
        ).poses()
        most = max(most, count)
        candidates.extend(found)
        if candidates and _settled(candidates, matcher.cluster, [t.cluster for t in tries], options):
            break
        tries = most_matched(tries, options)
        clock.lap("matching")
    candidates.sort(key=lambda c: (-c.evidence.log_nfa, -c.evidence.inliers))
    if candidates:
        return candidates, most, None
    if most < options.pose.min_matches:
        return [], most, ("TOO_FEW_MATCHES", f"{most} matches between the photo and the maps")
    return [], most, ("TOO_FEW_INLIERS", f"no pose agrees with the {most} matches")


def _nothing_to_ask(areas: Sequence[IndexedArea], request: LocaliseRequest) -> str:
    """Why no map was asked."""
    if not areas:
        return "no map is active"
    return (
        "no map sees what the photo shows"
        if request.prior is None
        else "no map lies within reach of the prior"
    )


def most_matched(tries: list[ClusterMatcher], options: LocaliseOptions) -> list[ClusterMatcher]:
    """Of more clusters than may still be tried, those that match best, best first."""
    take = options.candidates.max_clusters - 1
    if len(tries) <= take:
        return tries
    matches = [len(matcher.matches(options.candidates.shortlist_features)) for matcher in tries]
    order = np.argsort(-np.array(matches), kind="stable")
    return [tries[i] for i in order[:take]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ClusterSearch:
    """What the steps within one cluster share."""

    features: Features
    matcher: ClusterMatcher
    request: LocaliseRequest
    options: LocaliseOptions
    clock: StageClock

    @property
    def area(self) -> Area:
        return self.matcher.cluster.area

    def poses(self) -> tuple[list[PoseCandidate], int]:
        """Poses of the cluster and the number of matches behind them.

        The first features, which are the best spread, are matched alone; all of them only where that does not
        settle it. Guided matching uses all of them in any case.
        """
        first, count = self.options.matching.first_features, len(self.features)
        for most in (first, count) if first < count else (count,):
            matches = self.matcher.matches(most)
            self.clock.lap("matching")
            found = self._poses(matches)
            if any(c.evidence.log_nfa > self.options.acceptance.settled_log_nfa for c in found):
                break
        return found, len(matches)

    def _poses(self, matches: Matches) -> list[PoseCandidate]:
        """The cluster's best pose, and the best one among the matches that it leaves over."""
        pose = self._best_pose(matches, camera_hypotheses(self.features, self.area, self.request))
        if pose is not None:
            pose = _with_lens_prior(pose, self.area, matches, self.request)
        self.clock.lap("pose")
        if pose is None or pose.count < 4:
            return []
        if _is_hopeless(len(matches), pose, self.options):
            return [self._with_evidence(pose, matches, matches)]
        pose = self._unless_part(pose, matches)
        best = self._refined(matches, pose)
        taken = np.isin(matches.point, best.matches.point[best.rows]) | pose.inliers
        left = Matches(feature=matches.feature[~taken], point=matches.point[~taken])
        # A photo has one lens, which the first pose has estimated.
        rival = self._best_pose(left, [(best.pose.camera, "request")])
        self.clock.lap("pose")
        if rival is None or rival.count < 4:
            return [best]
        second = self._refined(left, rival)
        source, prior = best.pose.camera_source, best.pose.lens_prior  # as free as the first pose's lens is
        return [best, replace(second, pose=replace(second.pose, camera_source=source, lens_prior=prior))]

    def _best_pose(
        self, matches: Matches, cameras: list[tuple[Camera, CameraSource]]
    ) -> PoseHypothesis | None:
        points = pairs(self.features, self.area, matches)
        found = [estimate_pose(*points, camera, source, self.options.pose) for camera, source in cameras]
        return max((pose for pose in found if pose is not None), key=lambda pose: pose.count, default=None)

    def _unless_part(self, pose: PoseHypothesis, matches: Matches) -> PoseHypothesis:
        """The pose, or that of a picture cut out of a larger one or zoomed, where more matches agree with it.

        Programs cut and phones zoom, and leave EXIF as it was. Contradiction: of the matches that agree with
        one of both lenses alone, far more than half do with the other one (sign test). A lens that a map has
        lent, and with which most matches agree, is not asked: over flat ground others fit as well.
        """
        source, options = pose.camera_source, self.options.pose
        if source == "request" or self.request.film or (source == "map" and 2 * pose.count > len(matches)):
            return pose
        points = pairs(self.features, self.area, matches)
        if source != "map":
            pose = refine_pose(*points, pose, options)
        freed = with_any_lens(*points, pose, options)
        self.clock.lap("pose")
        if freed is None:
            return pose
        gained = int((freed.inliers & ~pose.inliers).sum())
        lost = int((pose.inliers & ~freed.inliers).sum())
        return freed if bdtrc(gained - 1, gained + lost, 0.5) < _OTHER_LENS_RATE else pose

    def _refined(self, matches: Matches, pose: PoseHypothesis) -> PoseCandidate:
        """Refine on matches looked for where the pose has them; keep that only if it agrees with more."""
        features, area, options = self.features, self.area, self.options
        best = refine_pose(*pairs(features, area, matches), pose, options.pose, rounds=1)
        kept, points = matches, self.matcher.cluster.points
        guided = guided_matches(features, area, points, best.camera, best.cam_from_local, options.matching)
        if len(guided) >= 4:
            again = refine_pose(*pairs(features, area, guided), best, options.pose)
            if again.count >= best.count:
                best, kept = again, guided
        candidate = self._with_evidence(best, kept, matches)
        self.clock.lap("guided")
        return candidate

    def _with_evidence(self, pose: PoseHypothesis, matches: Matches, unguided: Matches) -> PoseCandidate:
        """The number of false alarms is that of the unguided matches: guided ones look where they are wanted.

        Of those, only independent ones count, or a few places that match many times over would be believed.
        """
        features, area, size = self.features, self.area, (pose.camera.width, pose.camera.height)
        own = self._independent(pose, matches, pose.inliers)
        error = reprojection_errors(*pairs(features, area, unguided), pose.camera, pose.cam_from_local)
        tolerance_px = self.options.pose.tolerance_px(pose.camera)
        blind = self._independent(pose, unguided, error < tolerance_px)
        inlier_pixels = features.xy[matches.feature[own]]
        expected_pixels = _expected(area, self.matcher.cluster.points.astype(np.int64), pose)
        evidence = Evidence(
            inliers=len(own),
            log_nfa=_log_nfa(len(unguided), len(blind), pose, self.options),
            coverage=coverage(inlier_pixels, *size),
            agreement=agreement(inlier_pixels, expected_pixels, *size),
            spread=spread(inlier_pixels, expected_pixels, *size),
        )
        return PoseCandidate(area=area, pose=pose, matches=matches, evidence=evidence, rows=own)

    def _independent(
        self, pose: PoseHypothesis, matches: Matches, inlier: NDArray[np.bool_]
    ) -> NDArray[np.intp]:
        """Rows of the inliers that the pose can see, each a measurement of its own.

        A flat place fits a mirrored photo if one looks at it from under the ground: these do not count.
        """
        rows, area = np.flatnonzero(inlier), self.area
        seen = visible_points(area, matches.point[rows], pose.camera, pose.cam_from_local, POSSIBLE_DEG)
        rows = rows[np.isin(matches.point[rows], seen)]
        pixels, points = pairs(self.features, area, matches)
        gap_px = 0.002 * max(pose.camera.width, pose.camera.height)
        return rows[independent_inliers(pixels[rows], points[rows], gap_px)]


def _settled(
    candidates: list[PoseCandidate], cluster: Cluster, rest: list[Cluster], options: LocaliseOptions
) -> bool:
    """Whether the remaining clusters need not be tried.

    So it is when a pose is sure and each of them has far fewer votes or lies around that very pose: its
    images got their votes for seeing the same place, which the pose's own cluster holds already.
    """
    best = max(candidates, key=lambda c: c.evidence.log_nfa)
    lines = options.acceptance
    sure = best.evidence.log_nfa > lines.settled_log_nfa and best.evidence.spread >= lines.min_spread
    return sure and all(other.score < 0.5 * cluster.score or _around(best, other) for other in rest)


def _around(candidate: PoseCandidate, cluster: Cluster) -> bool:
    """Whether the cluster's images look at what a camera at the candidate's pose may see."""
    if cluster.area is not candidate.area:
        return False
    offset = cluster.area.image_scene[cluster.images] - candidate.pose.cam_from_local.center
    reach = float(np.median(cluster.area.image_reach[cluster.images]))
    return bool(np.median(np.linalg.norm(offset, axis=1)) <= 2.0 * reach)


def _with_lens_prior(
    pose: PoseHypothesis, area: Area, matches: Matches, request: LocaliseRequest
) -> PoseHypothesis:
    """What is known of the lens: as the request says; of one that is known exactly, as the map shows it.

    The map's own estimate of the same camera fits its points, which are bent by what that is off.
    """
    if not request.camera_is_exact:
        return replace(pose, lens_prior=request.camera_prior or pose.lens_prior)
    counts = np.bincount(area.map_of(matches.point[pose.inliers]), minlength=len(area.maps))
    uncertainty = LensUncertainty.of_provenance(area.maps[int(np.argmax(counts))].provenance)
    if uncertainty is None:
        return pose
    own = None if request.camera_key is None else area.camera_for_key(request.camera_key)
    own = None if own is None else lens_for(own, pose.camera.width, pose.camera.height)
    if own is not None and is_lens_of_a_map(pose.camera, own, uncertainty):
        return replace(pose, camera=own)
    seen = seen_by_a_map(pose.camera, uncertainty)
    return pose if seen is None else replace(pose, camera=seen[0], lens_prior=seen[1])


def _is_hopeless(matches: int, pose: PoseHypothesis, options: LocaliseOptions) -> bool:
    """Whether the pose would be refused with twice its inliers, too: refining and rivals would be idle.

    What is refused costs most, since RANSAC ends early only where there is something to be found. Refining
    adds a few to RANSAC's inliers; twice is out of reach.
    """
    twice = min(_MORE_BY_REFINING * pose.count, matches)
    return _log_nfa(matches, twice, pose, options) < options.acceptance.min_log_nfa


def _log_nfa(matches: int, inliers: int, pose: PoseHypothesis, options: LocaliseOptions) -> float:
    camera = pose.camera
    sample = 4 if pose.camera_source in ("exif", "estimated") else 3  # a free focal length takes one more
    return log_nfa(matches, inliers, options.pose.tolerance_px(camera), camera.width, camera.height, sample)


def camera_hypotheses(
    features: Features, area: Area, request: LocaliseRequest
) -> list[tuple[Camera, CameraSource]]:
    """Intrinsics to try: the request's; else map cameras of the same key, or film; else the focal is free.

    Raises:
        InvalidValueError: the request's camera is of another image size.
    """
    if request.camera is not None:
        if (request.camera.width, request.camera.height) != (features.width, features.height):
            raise InvalidValueError(
                f"LocaliseRequest.camera: expected intrinsics for {features.width}x{features.height} pixels, "
                f"found {request.camera.width}x{request.camera.height}; use Camera.scaled_to"
            )
        return [(request.camera, "request")]
    if request.camera_key:
        of_map = area.camera_for_key(request.camera_key)
        # Frames of films are made smaller.
        camera = None if of_map is None else lens_for(of_map, features.width, features.height)
        if camera is not None:
            return [(camera, "map")]
    if request.film:
        of_film = area.cameras_of_film(request.film)
        lent = [lens_for(camera, features.width, features.height) for camera in of_film]
        if any(camera is not None for camera in lent):
            return [(camera, "map") for camera in lent if camera is not None]
    if request.exif_focal_px:
        return [(Camera.from_focal(features.width, features.height, request.exif_focal_px), "exif")]
    # 1.2 times the longer side (a 45-degree lens) only starts the estimate.
    focal_px = 1.2 * max(features.width, features.height)
    return [(Camera.from_focal(features.width, features.height, focal_px), "estimated")]


def _expected(area: Area, points: NDArray[np.int64], pose: PoseHypothesis) -> FloatArray:
    """Pixels of points that the photo should show: as the map has seen them, or else farther from it.

    Where the map knows hardly anything from that side, what SIFT may still find is what there is to agree
    with.
    """
    pixels = np.zeros((0, 2))
    for beyond_deg in (EXPECTED_DEG, POSSIBLE_DEG):
        visible = visible_points(area, points, pose.camera, pose.cam_from_local, beyond_deg)
        pixels = pose.camera.project(pose.cam_from_local.act(area.points[visible]))
        if len(expected_cells(pixels, pose.camera.width, pose.camera.height)) >= _FEWEST_CELLS:
            break
    return pixels


def pairs(features: Features, area: Area, matches: Matches) -> tuple[FloatArray, FloatArray]:
    """Pixels (m, 2) and points (m, 3) of the matches, float64."""
    return features.xy[matches.feature].astype(np.float64), area.points[matches.point]
