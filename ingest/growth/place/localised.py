"""Step: every new photo is localised by the existing maps, by itself."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.index.descriptor_index import use_threads
from ingest.growth.values import FeaturesOf, LocalisedPhoto
from ingest.photos.photo import Photo
from reloc.localise.acceptance import AcceptanceOptions, agreement
from reloc.localise.candidates import IndexedArea
from reloc.localise.lens_prior import LensPriors
from reloc.localise.localise import Localised, localise_features
from reloc.localise.matching import POSSIBLE_DEG, Matches, guided_matches, visible_points
from reloc.localise.options import LocaliseOptions, PoseOptions
from reloc.localise.pose import PoseHypothesis, estimate_pose, pose_uncertainty, refine_pose
from reloc.localise.result import LocaliseRequest
from reloc.localise.search import pairs

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocaliseEachOptions:
    """How new photos are localised.

    Attributes:
        localise: as for queries, but for the gate of `spread`: where a query stands alone, photos that
            are taken into a map must agree with others in any case (a tenth of ten strangers' photos of
            a church was lost to it). The extractor named there is not used, features exist.
        max_features: so many of a photo's features, strongest and best spread first, look for the pose; a
            query has 3,000. All of them take part in the guided matching that follows.
        retry_without_geotag: a photo that its geotag does not lead to a map is tried without it: a tenth
            of the positions of community photos are wrong by kilometres.
        least_agreement_against_geotag: share of the parts of the photo where the map should be seen that must
            show it if the photo is found without its geotag. Nine in ten geotags are right, so most of what
            is found elsewhere is a look-alike. In a town of look-alikes wrong ones had 0.41 to 0.49, photos
            whose geotags were wrong 0.83 and more.
        least_inliers_of_map: a map counts among a photo's maps from so many inliers on; the number that a
            pose itself needs at least.
        threads: photos that are localised at a time; the work is done outside of Python's lock, two threads
            take half the time. Results are the same.
    """

    localise: LocaliseOptions = field(
        default_factory=lambda: LocaliseOptions(
            pose=PoseOptions(lens=LensPriors(whole_lens=False)), acceptance=AcceptanceOptions(min_spread=0.0)
        )
    )
    max_features: int = 4000
    retry_without_geotag: bool = True
    least_agreement_against_geotag: float = 0.7
    least_inliers_of_map: int = 15
    threads: int = 1


def localise_photos(
    photos: Sequence[Photo],
    rows: Sequence[int],
    features_of: FeaturesOf,
    areas: Sequence[IndexedArea],
    options: LocaliseEachOptions | None = None,
) -> tuple[dict[int, LocalisedPhoto], dict[int, str]]:
    """Localise photos in the areas of the active maps, each for itself.

    Args:
        photos: all new photos. rows: those to be localised.
        areas: of a reloc.localiser.Localiser; those of another extractor than a photo's are left out.

    Returns:
        What was localised by row, and for the others the reason by row.
    """
    options = options or LocaliseEachOptions()
    found: dict[int, LocalisedPhoto] = {}
    reasons: dict[int, str] = {}
    for row, outcome in localise_each(photos, rows, features_of, areas, options):
        if isinstance(outcome, LocalisedPhoto):
            found[row] = outcome
        else:
            reasons[row] = outcome
    _LOG.info("%d of %d photos localised in %d areas", len(found), len(rows), len(areas))
    return found, reasons


def localise_each(
    photos: Sequence[Photo],
    rows: Sequence[int],
    features_of: FeaturesOf,
    areas: Sequence[IndexedArea],
    options: LocaliseEachOptions,
) -> Iterator[tuple[int, LocalisedPhoto | str]]:
    """Each row with what `localise_photo` says of it, in their order."""

    def one(row: int) -> tuple[int, LocalisedPhoto | str]:
        return row, localise_photo(photos[row], row, features_of(row).features, areas, options)

    if options.threads <= 1 or len(rows) < 2:
        yield from map(one, rows)
        return
    with ThreadPoolExecutor(options.threads, initializer=use_threads, initargs=(1,)) as pool:
        yield from pool.map(one, rows)


def localise_photo(
    photo: Photo,
    row: int,
    features: Features,
    areas: Sequence[IndexedArea],
    options: LocaliseEachOptions,
    camera: Camera | None = None,
) -> LocalisedPhoto | str:
    """One photo, or the reason why it is not localised.

    Args:
        camera: known intrinsics, of an image that a map holds for example; None: as the photo tells.
    """
    settings = replace(
        options.localise, extractor=replace(options.localise.extractor, upright=_is_upright(features))
    )
    usable = [a for a in areas if a.area.extractor_fingerprint == features.fingerprint]
    if not usable or features.fingerprint != settings.extractor.fingerprint:
        return "NO_COVERAGE: no active map has descriptors of this photo's extractor"
    few = features.take(np.arange(min(options.max_features, len(features))))
    request = LocaliseRequest(
        camera=camera, camera_key=photo.camera_key or None, exif_focal_px=photo.focal_px, prior=photo.gps
    )
    outcome = localise_features(few, request, usable, settings)
    by_prior = photo.gps is not None and outcome.best is not None
    if outcome.best is None and photo.gps is not None and options.retry_without_geotag:
        again = _elsewhere(few, request, outcome, usable, settings)
        outcome = again if again.best is not None else outcome
    if outcome.best is None:
        return f"{outcome.result.reason}: {outcome.result.detail}"
    found = _densified(row, features, outcome, by_prior, options)
    if photo.gps is not None and not by_prior:
        share = share_shown(found, outcome.best.area)
        if share < options.least_agreement_against_geotag:
            return (
                f"CONTRADICTS_GEOTAG: away from its geotag the photo shows {share:.0%} of the parts that the "
                f"map should show there, {options.least_agreement_against_geotag:.0%} needed"
            )
    return found


def _elsewhere(
    features: Features,
    request: LocaliseRequest,
    first: Localised,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions,
) -> Localised:
    """A photo that was not found within its geotag's reach, looked for beyond it.

    Where something was found there that cannot be believed (a pose that contradicts the geotag, two poses),
    all places compete once more; and what was found in vain near the geotag stays a rival.
    """
    tried = None if first.result.reason in ("CONTRADICTS_PRIOR", "AMBIGUOUS") else request.prior
    found = localise_features(features, replace(request, prior=None, beyond=tried), areas, options)
    rival = options.acceptance.rival_share * found.result.inliers
    return first if tried is not None and first.result.inliers >= rival else found


def share_shown(photo: LocalisedPhoto, area: Area) -> float:
    """Share of the parts of a photo where the area's points should be seen that hold inliers."""
    rows = visible_points(area, area.searched_points(), photo.camera, photo.cam_from_local)
    expected = photo.camera.project(photo.cam_from_local.act(area.points[rows]))
    return agreement(photo.pixels, expected, photo.camera.width, photo.camera.height)


def _is_upright(features: Features) -> bool:
    return "-upright-" in features.fingerprint


def _densified(
    row: int, features: Features, outcome: Localised, by_prior: bool, options: LocaliseEachOptions
) -> LocalisedPhoto:
    """The pose refined on matches of all features with every map that it should see."""
    assert outcome.best is not None
    assert outcome.uncertainty is not None
    area, pose = outcome.best.area, outcome.best.pose
    settings = options.localise
    matches = match_each_map(features, area, pose, options)
    uncertainty = outcome.uncertainty
    if len(matches) >= 4:
        pixels, points = pairs(features, area, matches)
        better = refine_pose(pixels, points, pose, settings.pose)
        matches = _take(matches, better.inliers)
        pixels, points = pairs(features, area, matches)
        if len(matches) >= outcome.best.evidence.inliers:
            pose = better
            uncertainty = pose_uncertainty(
                pixels, points, area.point_covariance[matches.point], better, settings.pose
            )
    of_map = area.point_map[matches.point]
    counts = np.bincount(of_map, minlength=len(area.maps))
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i] > 0]
    place = np.full(len(area.maps), -1)
    place[order] = np.arange(len(order))
    return LocalisedPhoto(
        row=row,
        frame=area.frame,
        cam_from_local=pose.cam_from_local,
        covariance=uncertainty.covariance,
        camera=pose.camera,
        feature_rows=matches.feature,
        pixels=features.xy[matches.feature].astype(np.float64),
        map_ids=tuple(area.maps[i].map_id for i in order),
        map_of=place[of_map],
        point_of=area.point_row[matches.point],
        points=area.points[matches.point],
        point_covariance=area.point_covariance[matches.point],
        by_prior=by_prior,
        result=outcome.result,
    )


def match_each_map(
    features: Features, area: Area, pose: PoseHypothesis, options: LocaliseEachOptions
) -> Matches:
    """Guided matches of all features with the points that each map should show, map by map.

    Two maps of one place have the same points twice; each may have its match. Maps with fewer matches
    within the tolerance than a pose needs are left out: chance alone gives a few.
    """
    everything = np.arange(len(area.points), dtype=np.int64)
    visible = visible_points(area, everything, pose.camera, pose.cam_from_local, POSSIBLE_DEG)
    parts = []
    tolerance_px = options.localise.pose.tolerance_rel * max(pose.camera.width, pose.camera.height)
    for map_row in np.unique(area.point_map[visible]):
        points = visible[area.point_map[visible] == map_row].astype(np.int32)
        matches = guided_matches(
            features, area, points, pose.camera, pose.cam_from_local, options.localise.matching
        )
        if len(matches) == 0:
            continue
        pixels, places = pairs(features, area, matches)
        error = pose.camera.project(pose.cam_from_local.act(places)) - pixels
        near = np.linalg.norm(error, axis=1) < 2.0 * tolerance_px
        if near.sum() >= options.least_inliers_of_map:
            parts.append(_take(matches, near))
    return Matches(
        feature=np.concatenate([p.feature for p in parts] or [np.zeros(0, np.int64)]),
        point=np.concatenate([p.point for p in parts] or [np.zeros(0, np.int64)]),
        distance=np.concatenate([p.distance for p in parts] or [np.zeros(0, np.float32)]),
    )


def with_lens(photo: LocalisedPhoto, camera: Camera, options: LocaliseEachOptions) -> LocalisedPhoto:
    """The photo's pose by its own matches with a lens that is given; as it was where they do not fit it.

    Where the lens was estimated along, focal length and distance hardly differ: two poses of one photo can be
    compared with the same lens only.
    """
    if camera == photo.camera or (camera.width, camera.height) != (photo.camera.width, photo.camera.height):
        return photo
    settings = options.localise.pose
    start = PoseHypothesis(
        cam_from_local=photo.cam_from_local,
        camera=camera,
        camera_source="request",
        inliers=np.ones(len(photo.pixels), dtype=np.bool_),
        prior_focal_px=camera.focal_px,
    )
    # The camera goes back along its axis as the focal length grows, so that the scene keeps its size.
    center = photo.cam_from_local.center
    away = center - np.median(photo.points, axis=0)
    shift = away * (camera.focal_px / photo.camera.focal_px - 1.0)
    start = replace(start, cam_from_local=_moved(photo.cam_from_local, shift))
    best = estimate_pose(photo.pixels, photo.points, camera, "request", settings)
    again = max(
        (refine_pose(photo.pixels, photo.points, s, settings) for s in (start, best) if s is not None),
        key=lambda pose: pose.count,
    )
    if again.count < 0.5 * len(photo.pixels) or again.count < 4:
        return photo
    rows = np.flatnonzero(again.inliers)
    spread = pose_uncertainty(
        photo.pixels[rows], photo.points[rows], photo.point_covariance[rows], again, settings
    )
    return replace(photo, cam_from_local=again.cam_from_local, camera=camera, covariance=spread.covariance)


def _moved(pose: Rigid3, offset: FloatArray) -> Rigid3:
    return Rigid3(rotation=pose.rotation, translation=pose.translation - pose.rotation @ offset)


def in_frame(photo: LocalisedPhoto, frame: LocalFrame) -> LocalisedPhoto:
    """The same photo with everything metric in another local frame."""
    if photo.frame == frame:
        return photo
    frame_from_old = frame.enu_from(photo.frame)
    turn: FloatArray = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = frame_from_old.rotation
    return replace(
        photo,
        frame=frame,
        cam_from_local=photo.cam_from_local @ frame_from_old.inverse(),
        covariance=turn @ photo.covariance @ turn.T,
        points=frame_from_old.act(photo.points),
        point_covariance=frame_from_old.rotation @ photo.point_covariance @ frame_from_old.rotation.T,
    )


def _take(matches: Matches, rows: np.ndarray) -> Matches:
    return Matches(feature=matches.feature[rows], point=matches.point[rows], distance=matches.distance[rows])


_MOST_LENSES = 5  # that are tried; those of the photos with most matches


def with_shared_lenses(
    localised: Mapping[int, LocalisedPhoto], keys: Mapping[int, str], options: LocaliseEachOptions
) -> dict[int, LocalisedPhoto]:
    """The photos by row; those of one camera with the lens under which most of their matches fit.

    A photo that this lens does not fit keeps its own (`with_lens`).

    Args:
        keys: of the cameras, by row (`ingest.photos.cameras.shared_key`).
    """
    found = dict(localised)
    cameras: dict[str, list[int]] = {}
    for row in sorted(localised):
        cameras.setdefault(keys[row], []).append(row)
    for rows in cameras.values():
        by_matches = sorted(rows, key=lambda r: -len(localised[r].pixels))
        lenses = list(dict.fromkeys(localised[r].camera for r in by_matches))[:_MOST_LENSES]
        if len(lenses) < 2:
            continue
        tries = [{r: with_lens(localised[r], lens, options) for r in rows} for lens in lenses]
        fits = [
            sum(_fitting(photo, lens, options) for photo in posed.values())
            for posed, lens in zip(tries, lenses, strict=True)
        ]
        found.update(tries[int(np.argmax(fits))])
    return found


def _fitting(photo: LocalisedPhoto, lens: Camera, options: LocaliseEachOptions) -> int:
    """Matches of the photo that fit its pose, if it has that lens."""
    if photo.camera != lens:
        return 0
    tolerance_px = options.localise.pose.tolerance_rel * max(lens.width, lens.height)
    error = lens.project(photo.cam_from_local.act(photo.points)) - photo.pixels
    return int((np.linalg.norm(error, axis=1) < tolerance_px).sum())
