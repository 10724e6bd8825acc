"""Step: every new photo is localised by the existing maps, by itself."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.index.area import Area
from featuredb.index.descriptor_index import use_threads
from ingest.growth.values import QUERY, GrowthPhotos, LocalisedPhoto
from ingest.photos.photo import Photo
from reloc.localise.acceptance import agreement
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import Localised, localise_features
from reloc.localise.matching import POSSIBLE_DEG, guided_matches, visible_points
from reloc.localise.pose import (
    PoseHypothesis,
    estimate_pose,
    pose_uncertainty,
    refine_pose,
    reprojection_errors,
)
from reloc.localise.result import LocaliseRequest
from reloc.localise.search import pairs

_LOG = logging.getLogger(__name__)

# Of a photo's features, strongest and best spread first, that look for the pose; all of them take part in the
# guided matching that follows. By a query's 3,000 three of twenty photos of a simulated town were lost.
_MOST_FEATURES = 4000
# Share of the parts of the photo where the map should be seen that must show it if the photo is found without
# its geotag. Nine in ten geotags are right, so most of what is found elsewhere is a look-alike. In a town of
# look-alikes wrong ones had 0.41 to 0.49, photos whose geotags were wrong 0.83 and more.
_SHOWN_AGAINST_GEOTAG = 0.7
_MOST_LENSES = 5  # that are tried for one camera; those of the photos with most matches


def localise_photos(
    new: GrowthPhotos, rows: Sequence[int], areas: Sequence[IndexedArea], threads: int = 1
) -> tuple[dict[int, LocalisedPhoto], dict[int, str]]:
    """By row the photos that the active maps' areas localise, each by itself, and why the others are not.

    Args:
        threads: photos at a time; the work is done outside of Python's lock, and results are the same.
    """

    def one(row: int) -> LocalisedPhoto | str:
        return localise_photo(new.photos[row], new.features_of(row).features, areas)

    with ThreadPoolExecutor(threads, initializer=use_threads, initargs=(1,)) as pool:
        outcomes = dict(zip(rows, pool.map(one, rows), strict=True))
    found = {row: outcome for row, outcome in outcomes.items() if isinstance(outcome, LocalisedPhoto)}
    _LOG.info("%d of %d photos localised in %d areas", len(found), len(rows), len(areas))
    return found, {row: outcome for row, outcome in outcomes.items() if isinstance(outcome, str)}


def localise_photo(
    photo: Photo, features: Features, areas: Sequence[IndexedArea], camera: Camera | None = None
) -> LocalisedPhoto | str:
    """One photo, or the reason why it is not localised.

    A photo that its geotag does not lead to a map is tried without it: a tenth of the positions of community
    photos are wrong by kilometres.

    Args:
        camera: known intrinsics; None: as the photo tells.
    """
    usable = [a for a in areas if a.area.extractor_fingerprint == features.fingerprint]
    if not usable or features.fingerprint != QUERY.extractor.fingerprint:
        return "NO_COVERAGE: no active map has descriptors of this photo's extractor"
    few = features.take(np.arange(min(_MOST_FEATURES, len(features))))
    request = LocaliseRequest(
        camera=camera, camera_key=photo.camera_key or None, exif_focal_px=photo.focal_px, prior=photo.gps
    )
    outcome = localise_features(few, request, usable, QUERY)
    by_prior = outcome.best is not None
    if not by_prior and photo.gps is not None:
        # Where something was found there that cannot be believed (a pose that contradicts the geotag, two
        # poses), all places compete once more; and what was found in vain near the geotag stays a rival.
        all_places = outcome.result.reason in ("CONTRADICTS_PRIOR", "AMBIGUOUS")
        beyond = None if all_places else photo.gps
        again = localise_features(few, replace(request, prior=None, beyond=beyond), usable, QUERY)
        rival = QUERY.acceptance.rival_share * again.result.inliers
        if again.best is not None and (all_places or outcome.result.inliers < rival):
            outcome = again
    if outcome.best is None:
        return f"{outcome.result.reason}: {outcome.result.detail}"
    if outcome.best.pose.part:  # an adjustment would take its lens for a whole photo's
        return "PART_OF_PHOTO: the picture was cropped or zoomed; contribute the whole photo, as it was taken"
    found = _densified(features, outcome)
    if photo.gps is not None and not by_prior:
        share = share_shown(found, outcome.best.area)
        if share < _SHOWN_AGAINST_GEOTAG:
            return (
                f"CONTRADICTS_GEOTAG: away from its geotag the photo shows {share:.0%} of the parts that the "
                f"map should show there, {_SHOWN_AGAINST_GEOTAG:.0%} needed"
            )
    return found


def share_shown(photo: LocalisedPhoto, area: Area) -> float:
    """Share of the parts of a photo where the area's points should be seen that hold inliers."""
    rows = visible_points(area, area.searched_points(), photo.camera, photo.cam_from_local)
    expected = photo.camera.project(photo.cam_from_local.act(area.points[rows]))
    return agreement(photo.pixels, expected, photo.camera.width, photo.camera.height)


def _densified(features: Features, outcome: Localised) -> LocalisedPhoto:
    """The pose refined on matches of all features with every map that it should see."""
    assert outcome.best is not None
    assert outcome.uncertainty is not None
    area, pose, uncertainty = outcome.best.area, outcome.best.pose, outcome.uncertainty
    feature, point = _match_each_map(features, area, pose)
    pixels, points = features.xy[feature].astype(np.float64), area.points[point]
    if len(feature) >= 4:
        better = refine_pose(pixels, points, pose, QUERY.pose)
        feature, point = feature[better.inliers], point[better.inliers]
        pixels, points = pixels[better.inliers], points[better.inliers]
        if len(feature) >= outcome.best.evidence.inliers:
            pose, spread = better, area.point_covariance(point)
            uncertainty = pose_uncertainty(pixels, points, spread, better, QUERY.pose)
    used, map_of = np.unique(area.map_of(point), return_inverse=True)
    return LocalisedPhoto(
        frame=area.frame,
        cam_from_local=pose.cam_from_local,
        covariance=uncertainty.covariance,
        camera=pose.camera,
        feature_rows=feature,
        pixels=pixels,
        map_ids=tuple(area.maps[i].map_id for i in used.tolist()),
        map_of=map_of.reshape(-1),
        point_of=area.point_row[point].astype(np.int64),
        points=points,
        point_covariance=area.point_covariance(point),
        result=outcome.result,
    )


def _match_each_map(
    features: Features, area: Area, pose: PoseHypothesis
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Guided matches of all features with the points that each map should show, map by map.

    Rows (m,) of the features, and of the area's points. Maps with fewer matches within the tolerance than a
    pose needs are left out: chance alone gives a few.
    """
    visible = visible_points(area, area.searched_points(), pose.camera, pose.cam_from_local, POSSIBLE_DEG)
    found = np.zeros((2, 0), dtype=np.int64)
    for map_row in np.unique(area.map_of(visible)):
        points = visible[area.map_of(visible) == map_row].astype(np.int32)
        matches = guided_matches(features, area, points, pose.camera, pose.cam_from_local, QUERY.matching)
        pixels, places = pairs(features, area, matches)
        errors = reprojection_errors(pixels, places, pose.camera, pose.cam_from_local)
        near = errors < 2.0 * QUERY.pose.tolerance_px(pose.camera)
        if near.sum() >= QUERY.acceptance.min_inliers:
            found = np.concatenate([found, np.stack([matches.feature[near], matches.point[near]])], axis=1)
    return found[0], found[1]


def with_lens(photo: LocalisedPhoto, camera: Camera) -> LocalisedPhoto:
    """The photo's pose by its own matches with a lens that is given; as it was where they do not fit it.

    Two poses can be compared with the same lens only: focal length and distance hardly differ.
    """
    if camera == photo.camera or (camera.width, camera.height) != (photo.camera.width, photo.camera.height):
        return photo
    start = estimate_pose(photo.pixels, photo.points, camera, "request", QUERY.pose)
    again = start and refine_pose(photo.pixels, photo.points, start, QUERY.pose)
    if again is None or again.count < max(4.0, 0.5 * len(photo.pixels)):
        return photo
    rows = np.flatnonzero(again.inliers)
    spread = pose_uncertainty(
        photo.pixels[rows], photo.points[rows], photo.point_covariance[rows], again, QUERY.pose
    )
    return replace(photo, cam_from_local=again.cam_from_local, camera=camera, covariance=spread.covariance)


def in_frame(photo: LocalisedPhoto, frame: LocalFrame) -> LocalisedPhoto:
    """The same photo with everything metric in another local frame."""
    if photo.frame == frame:
        return photo
    frame_from_old = frame.enu_from(photo.frame)
    turn = np.kron(np.eye(2), frame_from_old.rotation)
    return replace(
        photo,
        frame=frame,
        cam_from_local=photo.cam_from_local @ frame_from_old.inverse(),
        covariance=turn @ photo.covariance @ turn.T,
        points=frame_from_old.act(photo.points),
        point_covariance=frame_from_old.rotation @ photo.point_covariance @ frame_from_old.rotation.T,
    )


def with_shared_lenses(
    localised: Mapping[int, LocalisedPhoto], keys: Mapping[int, str]
) -> dict[int, LocalisedPhoto]:
    """The photos by row; those of one camera (by its key) with the lens under which most matches fit.

    A photo that this lens does not fit keeps its own.
    """
    found = dict(localised)
    cameras: dict[str, list[int]] = {}
    for row in sorted(localised):
        cameras.setdefault(keys[row], []).append(row)
    for rows in cameras.values():
        by_matches = sorted(rows, key=lambda r: -len(localised[r].pixels))
        lenses = list(dict.fromkeys(localised[r].camera for r in by_matches))[:_MOST_LENSES]
        if len(lenses) > 1:
            tries = {lens: [with_lens(localised[r], lens) for r in rows] for lens in lenses}
            best = max(tries, key=lambda lens: sum(_fitting(p) for p in tries[lens] if p.camera == lens))
            found.update(zip(rows, tries[best], strict=True))
    return found


def _fitting(photo: LocalisedPhoto) -> int:
    """Matches of the photo that fit its pose."""
    errors = reprojection_errors(photo.pixels, photo.points, photo.camera, photo.cam_from_local)
    return int((errors < QUERY.pose.tolerance_px(photo.camera)).sum())
