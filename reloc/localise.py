"""One photo against indexed maps: a pose, or a reason why there is none.

The steps, in order: features; clusters of map images that may show the same; 2D-3D matches inside each
cluster; robust pose; matches guided by it; refinement; uncertainty; acceptance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IncompatibleExtractorError, InvalidValueError
from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap
from reloc.acceptance import agreement, confidence, coverage, independent_inliers, log_nfa, verdict
from reloc.answer import make_answer, placement_covariance
from reloc.candidates import Cluster, IndexedArea, find_clusters
from reloc.matching import Matches, guided_matches, match_cluster, visible_points
from reloc.options import LocaliseOptions
from reloc.pose import (
    CameraSource,
    PoseHypothesis,
    estimate_pose,
    pose_uncertainty,
    refine_pose,
    reprojection_errors,
)
from reloc.prior import contradicts_prior
from reloc.result import Evidence, LocaliseRequest, LocaliseResult, Reason, RunnerUp
from reloc.stopwatch import Stopwatch


def localise(
    gray: NDArray[np.uint8],
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions | None = None,
    snapshot: int = 0,
) -> LocaliseResult:
    """Pose of a photo.

    Args:
        gray: (h, w) uint8, pixels as stored in the file.
        areas: the indexed maps to search.
        snapshot: version of the database that the areas come from, passed through.

    Raises:
        IncompatibleExtractorError: an area's descriptors are of another extractor than the options'.
        ImageError: the image is not (h, w) uint8 or tiny.
        InvalidValueError: the request's camera is of another image size.
    """
    options = options or LocaliseOptions()
    check_extractor(areas, options)
    watch = Stopwatch()
    features = extract(gray, options.extractor)
    watch.split("features")
    found = _search(features, request, areas, options, watch)
    result = _decide(found, features, request, options, snapshot, watch)
    watch.split("answer")
    return result


def check_extractor(areas: Sequence[IndexedArea], options: LocaliseOptions) -> None:
    """Raise IncompatibleExtractorError where descriptors could not be compared."""
    for indexed in areas:
        if indexed.area.extractor_fingerprint != options.extractor.fingerprint:
            raise IncompatibleExtractorError(
                f"the maps were made by extractor {indexed.area.extractor_fingerprint}, this query uses "
                f"{options.extractor.fingerprint}: their descriptors cannot be compared; use the same "
                "extractor options (upright or not) as the ingest"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
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
        return self.area.maps[int(np.bincount(self.area.point_map[self.matches.point[rows]]).argmax())]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Search:
    """What the search found: candidates, best first, and how far it came."""

    candidates: list[Candidate]
    matches: int
    reason: Reason | None
    detail: str


def _search(
    features: Features,
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions,
    watch: Stopwatch,
) -> _Search:
    if len(features) < options.acceptance.min_inliers:
        return _nothing(
            "TOO_FEW_FEATURES", f"{len(features)} keypoints in the photo; it shows too little texture"
        )
    clusters = find_clusters(areas, features, request.prior, options.candidates)
    watch.split("candidates")
    if not clusters:
        return _nothing("NO_COVERAGE", "no map lies within reach of the prior")
    candidates: list[Candidate] = []
    most = 0
    for tried, cluster in enumerate(clusters, start=1):
        found, count = _try_cluster(features, cluster, request, options, watch)
        most = max(most, count)
        candidates.extend(found)
        if candidates and _settled(candidates, cluster, clusters[tried:], options):
            break
    candidates.sort(key=lambda c: (-c.evidence.log_nfa, -c.evidence.inliers))
    if not candidates and most < options.pose.min_matches:
        return _nothing("TOO_FEW_MATCHES", f"{most} matches between the photo and the maps", most)
    return _Search(candidates=candidates, matches=most, reason=None, detail="")


def _try_cluster(
    features: Features,
    cluster: Cluster,
    request: LocaliseRequest,
    options: LocaliseOptions,
    watch: Stopwatch,
) -> tuple[list[Candidate], int]:
    """Poses of one cluster and the number of matches behind them.

    The first features, which are the best spread, are matched alone; all of them only where that does not
    settle it. Guided matching uses all of them in any case.
    """
    first = options.matching.first_features
    for count in (first, len(features)) if first < len(features) else (len(features),):
        matches = match_cluster(features.take(np.arange(count)), cluster, options.matching)
        watch.split("matching")
        found = _poses(features, cluster, matches, request, options, watch)
        if any(c.evidence.log_nfa > options.acceptance.settled_log_nfa for c in found):
            break
    return found, len(matches)


def _settled(
    candidates: list[Candidate], cluster: Cluster, rest: list[Cluster], options: LocaliseOptions
) -> bool:
    """Whether the remaining clusters need not be tried.

    So it is when a pose is sure and each of them has far fewer votes or lies around that very pose: its
    images got their votes for seeing the same place, which the pose's own cluster holds already.
    """
    best = max(candidates, key=lambda c: c.evidence.log_nfa)
    sure = best.evidence.log_nfa > options.acceptance.settled_log_nfa
    return sure and all(other.score < 0.5 * cluster.score or _around(best, other) for other in rest)


def _around(candidate: Candidate, cluster: Cluster) -> bool:
    """Whether the cluster's images look at what a camera at the candidate's pose may see."""
    if cluster.area is not candidate.area:
        return False
    offset = cluster.area.image_scene[cluster.images] - candidate.pose.cam_from_local.center
    reach = float(np.median(cluster.area.image_reach[cluster.images]))
    return bool(np.median(np.linalg.norm(offset, axis=1)) <= 2.0 * reach)


def _poses(
    features: Features,
    cluster: Cluster,
    matches: Matches,
    request: LocaliseRequest,
    options: LocaliseOptions,
    watch: Stopwatch,
) -> list[Candidate]:
    """The cluster's best pose, and the best one among the matches that it leaves over."""
    pose = _best_pose(
        features, cluster.area, matches, camera_hypotheses(features, cluster.area, request), options
    )
    watch.split("pose")
    if pose is None or pose.count < 4:
        return []
    best = _refined(features, cluster, matches, pose, options)
    watch.split("guided")
    taken = np.isin(matches.point, best.matches.point[best.rows]) | pose.inliers
    left = Matches(
        feature=matches.feature[~taken], point=matches.point[~taken], distance=matches.distance[~taken]
    )
    # A photo has one lens, which the first pose has estimated.
    rival = _best_pose(features, cluster.area, left, [(best.pose.camera, "request")], options)
    watch.split("pose")
    if rival is None or rival.count < 4:
        return [best]
    second = _refined(features, cluster, left, rival, options)
    watch.split("guided")
    source, focal_px = best.pose.camera_source, best.pose.prior_focal_px
    return [
        best,
        replace(second, pose=replace(second.pose, camera_source=source, prior_focal_px=focal_px)),
    ]


def camera_hypotheses(
    features: Features, area: Area, request: LocaliseRequest
) -> list[tuple[Camera, CameraSource]]:
    """Intrinsics to try: the request's; else a map camera with the same EXIF key; else the focal is free.

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
        camera = area.camera_for_key(request.camera_key)
        if camera is not None and (camera.width, camera.height) == (features.width, features.height):
            return [(camera, "map")]
    longer = max(features.width, features.height)
    if request.exif_focal_px:
        return [(Camera.from_focal(features.width, features.height, request.exif_focal_px), "exif")]
    # 1.2 times the longer side (a 45-degree lens) only starts the estimate.
    return [(Camera.from_focal(features.width, features.height, 1.2 * longer), "estimated")]


def _best_pose(
    features: Features,
    area: Area,
    matches: Matches,
    cameras: list[tuple[Camera, CameraSource]],
    options: LocaliseOptions,
) -> PoseHypothesis | None:
    pixels, points = _pairs(features, area, matches)
    found = [estimate_pose(pixels, points, camera, source, options.pose) for camera, source in cameras]
    poses = [pose for pose in found if pose is not None]
    return max(poses, key=lambda pose: pose.count) if poses else None


def _refined(
    features: Features, cluster: Cluster, matches: Matches, pose: PoseHypothesis, options: LocaliseOptions
) -> Candidate:
    """Refine on matches looked for where the pose says they are; keep that only if it agrees with more."""
    area = cluster.area
    pixels, points = _pairs(features, area, matches)
    best, kept = refine_pose(pixels, points, pose, options.pose, rounds=1), matches
    guided = guided_matches(
        features, area, cluster.points, best.camera, best.cam_from_local, options.matching
    )
    if len(guided) >= 4:
        pixels, points = _pairs(features, area, guided)
        again = refine_pose(pixels, points, best, options.pose)
        if again.count >= best.count:
            best, kept = again, guided
    return _with_evidence(features, cluster, best, kept, matches, options)


def _with_evidence(
    features: Features,
    cluster: Cluster,
    pose: PoseHypothesis,
    matches: Matches,
    unguided: Matches,
    options: LocaliseOptions,
) -> Candidate:
    """The number of false alarms is that of the unguided matches: guided ones look where they are wanted.

    Of those, only independent ones count, or a few places that match several times over would be believed.
    """
    area, width, height = cluster.area, pose.camera.width, pose.camera.height
    tolerance_px = options.pose.tolerance_rel * max(width, height)
    own = _independent(features, area, pose, matches, pose.inliers)
    error = reprojection_errors(*_pairs(features, area, unguided), pose.camera, pose.cam_from_local)
    blind = _independent(features, area, pose, unguided, error < tolerance_px)
    inlier_pixels = features.xy[matches.feature[own]]
    visible = visible_points(area, cluster.points.astype(np.int64), pose.camera, pose.cam_from_local)
    expected_pixels = pose.camera.project(pose.cam_from_local.act(area.points[visible]))
    evidence = Evidence(
        inliers=len(own),
        log_nfa=log_nfa(
            len(unguided),
            len(blind),
            tolerance_px,
            width,
            height,
            sample=4 if pose.focal_is_free else 3,
        ),
        coverage=coverage(inlier_pixels, width, height),
        visible_share=len(own) / max(len(visible), 1),
        agreement=agreement(inlier_pixels, expected_pixels, width, height),
    )
    return Candidate(area=area, pose=pose, matches=matches, evidence=evidence, rows=own)


def _independent(
    features: Features, area: Area, pose: PoseHypothesis, matches: Matches, inlier: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Rows of the inliers that the pose can see, each a measurement of its own.

    A flat place fits a mirrored photo if one looks at it from under the ground: such inliers do not count.
    """
    rows = np.flatnonzero(inlier)
    seen = visible_points(area, matches.point[rows], pose.camera, pose.cam_from_local)
    rows = rows[np.isin(matches.point[rows], seen)]
    pixels, points = _pairs(features, area, matches)
    gap_px = 0.002 * max(pose.camera.width, pose.camera.height)
    return rows[independent_inliers(pixels[rows], points[rows], gap_px)]


def _decide(
    found: _Search,
    features: Features,
    request: LocaliseRequest,
    options: LocaliseOptions,
    snapshot: int,
    watch: Stopwatch,
) -> LocaliseResult:
    def refuse(
        reason: Reason, detail: str, inliers: int = 0, rival: RunnerUp | None = None
    ) -> LocaliseResult:
        return LocaliseResult(
            reason=reason,
            detail=detail,
            pose=None,
            confidence=0.0,
            features=len(features),
            matches=found.matches,
            inliers=inliers,
            runner_up=rival,
            snapshot=snapshot,
            evidence=found.candidates[0].evidence if found.candidates else None,
            timings_ms=watch.timings_ms,
        )

    if found.reason is not None:
        return refuse(found.reason, found.detail)
    if not found.candidates:
        return refuse("TOO_FEW_INLIERS", f"no pose agrees with the {found.matches} matches")
    best = found.candidates[0]
    rival = _runner_up(best, found.candidates[1:])
    refusal = verdict(best.evidence, rival.inliers if rival else 0, options.acceptance)
    if refusal is not None:
        return refuse(refusal[0], refusal[1], best.evidence.inliers, rival)
    pixels, points = _pairs(features, best.area, best.matches)
    rows = best.matches.point[best.rows]
    uncertainty = pose_uncertainty(
        pixels[best.rows], points[best.rows], best.area.point_covariance[rows], best.pose, options.pose
    )
    answer = make_answer(best.area, best.pose, uncertainty, pixels[best.rows], rows, request.want_inliers)
    against = contradicts_prior(answer, request.prior)
    if against is not None:
        return refuse("CONTRADICTS_PRIOR", against, best.evidence.inliers, rival)
    return LocaliseResult(
        reason=None,
        detail=f"{best.evidence.inliers} inliers of {found.matches} matches",
        pose=answer,
        confidence=confidence(best.evidence, rival.inliers if rival else 0),
        features=len(features),
        matches=found.matches,
        inliers=best.evidence.inliers,
        runner_up=rival,
        snapshot=snapshot,
        evidence=best.evidence,
        timings_ms=watch.timings_ms,
    )


def _runner_up(best: Candidate, others: list[Candidate]) -> RunnerUp | None:
    """The pose of another place with most inliers.

    Another place is further than 2 m or 5 degrees from the winner. Where two maps gave the poses, three
    standard deviations of their placements come on top: two maps of one place, each placed by GPS, show it
    metres apart. Heights of different datums are not compared.
    """
    winner = best.pose.cam_from_local
    found: list[RunnerUp] = []
    for other in others:
        pose = _in_frame_of(best.area, other)
        offset = pose.center - winner.center
        if best.main_map.height_datum != other.main_map.height_datum:
            offset[2] = 0.0
        distance_m = float(np.linalg.norm(offset))
        angle_deg = pose.angle_to_deg(winner)
        apart_m, apart_deg = 2.0, 5.0
        if best.main_map.map_id != other.main_map.map_id:
            placed = placement_covariance(best.area, best.main_map, winner.center) + placement_covariance(
                other.area, other.main_map, other.pose.cam_from_local.center
            )
            apart_m += 3.0 * float(np.sqrt(np.linalg.eigvalsh(placed[3:, 3:])[-1]))
            apart_deg += 3.0 * float(np.degrees(np.sqrt(np.linalg.eigvalsh(placed[:3, :3])[-1])))
        inliers = _support_beside(best, other)
        if inliers and (distance_m > apart_m or angle_deg > apart_deg):
            lat, lon, _ = best.area.frame.geodetic_from_enu(pose.center)
            found.append(
                RunnerUp(
                    inliers=inliers,
                    distance_m=distance_m,
                    angle_deg=angle_deg,
                    latitude_deg=float(lat),
                    longitude_deg=float(lon),
                )
            )
    return max(found, key=lambda rival: rival.inliers, default=None)


def _support_beside(best: Candidate, other: Candidate) -> int:
    """Inliers of the other pose that are not inliers of the best one as well.

    Where a photo leaves the pose soft, as a flat place does with an unknown lens, a second estimate comes to
    lie metres away on the very same matches: it speaks of the covariance, not of another place.
    """
    if best.area is not other.area:
        return other.evidence.inliers
    shared = np.isin(_pair_numbers(other), _pair_numbers(best))
    return int(np.count_nonzero(~shared))


def _pair_numbers(candidate: Candidate) -> NDArray[np.int64]:
    """One number for each inlier's pair of feature and point."""
    matches, rows = candidate.matches, candidate.rows
    return matches.feature[rows] * len(candidate.area.points) + matches.point[rows]


def _in_frame_of(area: Area, candidate: Candidate) -> Rigid3:
    if candidate.area is area:
        return candidate.pose.cam_from_local
    return candidate.pose.cam_from_local @ candidate.area.frame.enu_from(area.frame)


def _pairs(features: Features, area: Area, matches: Matches) -> tuple[FloatArray, FloatArray]:
    """Pixels (m, 2) and points (m, 3) of the matches, float64."""
    return features.xy[matches.feature].astype(np.float64), area.points[matches.point]


def _nothing(reason: Reason, detail: str, matches: int = 0) -> _Search:
    return _Search(candidates=[], matches=matches, reason=reason, detail=detail)
