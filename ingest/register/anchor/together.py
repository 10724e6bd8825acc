"""Photos of a map registered to a scan together, from about where the map is: one similarity, one evidence.

The photos as one picture from straight above (`ingest.register.anchor.start.ortho`) tell where to start. From
there the similarity is fitted as one photo's pose is (`ingest.register.frame.dense.fit`), and held near its
start where the pieces tell little. Steps: docs/measurements/registration.md, "All photos together".
"""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3, place_covariance
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.anchor.start.from_ortho import PlanTry, ScanSearch, first_apart
from ingest.register.anchor.start.ortho import OrthoPicture, picture_of_map, picture_of_scan
from ingest.register.frame.dense.confirmation import AskedPhoto, evidence_of
from ingest.register.frame.dense.fit import MAX_SIDE_PX, near_places
from ingest.register.frame.dense.pictures import plan_spacing_m
from ingest.register.frame.features.matching import FrameMatches
from ingest.register.frame.register import fit_vouched_for
from ingest.register.frame.views import FrameOptions, FrameViews, first_look, searched_sources
from ingest.register.frame_registration import FramePrior, FrameRegistration, RenderSource

_LOG = logging.getLogger(__name__)

TOGETHER = "together"  # in the evidence of frames that were registered so
_LOG_RATE = 3.0  # of a thousand maps that lie elsewhere one is placed wrongly
_LEAST_SHARE = 0.18  # of the places, as of the pieces of one photo (`FrameOptions`)
# So many photos are asked and fitted as show so many places of the scan, by what one of them shows.
_LEAST_PHOTOS, _MOST_PHOTOS, _ENOUGH_PLACES = 4, 12, 150
# What a photo's own pose may differ from the similarity's by, as a map is bent: of the viewing distance, and
# as an angle. Structure projection takes maps that are bent by as much.
_BENT = 0.003
# Spacing of the scan's points and side of a piece, pixels of the render; how near a place is looked for.
_ROUNDS = ((2.4, 28, 12), (2.4, 28, 10), (3.75, 40, 6), (3.75, 40, 6), (3.75, 40, 6))
_LOSS_PX = 2.0  # Cauchy's; a piece is off by a pixel or two where laser and photo show an edge differently
_LEAST_PIECES = 14  # twice what seven parameters need
# Of the start, which the picture from above and the surface give: logarithm of the size, radians, metres.
_SIGMAS = np.array([0.02, *[np.radians(2.0)] * 3, *[1.5] * 3])
_FAR_PX = 50.0  # of a point behind the camera

_REACH = 2.5  # standard deviations of the placement
_MOST_REACH_M = 100.0  # the scan is loaded to some 60 m around the map
_LEAST_REACH_M, _LEAST_TURN, _LEAST_SIZE = 5.0, np.radians(4.0), 0.02
_TURN_STEP, _SIZE_STEP = np.radians(2.0), 0.02  # three cells at the rim of the picture
_MOST_TRIES = 1000  # of sizes and headings
_MOST_CELLS = 700  # along the longer side of the part of the scan that is searched
_CELL = 0.7  # of the spacing of its points
_APART = 0.1  # of the picture: another place
_PLACES = 4
_WRONG_PLACES = 3  # of each right angle
_COVER = 0.3  # of the picture that the scan shows
_QUARTERS = (0.5 * np.pi, np.pi, 1.5 * np.pi)
_LEVEL_ROUNDS, _WEIGHT_ROUNDS = 2, 20  # of tilting the points, and of Cauchy's weights
_LEAST_POINTS = 30
_LEAST_M = 1e-3


def register_together(
    feature_map: FeatureMap,
    images: Sequence[MapImage],
    cloud: PointCloud,
    read_gray: PhotoReader,
    wanted: int,
) -> dict[int, FrameRegistration] | None:
    """The first photos of a map, by image id, registered where all together lie; None where that is not sure.

    Args:
        images: whose photos are there, the most promising first.
        cloud: the scan around the map, in the map's frame.
        wanted: photos to register.
    """
    photos: list[AskedPhoto] = []
    for image in images:
        if len(photos) == _MOST_PHOTOS:
            break
        with suppress(ImageError):
            camera = feature_map.cameras[image.camera_id]
            photos.append(AskedPhoto(image=image, camera=camera, gray=read_gray(image)))
    points = feature_map.points_local(cloud.frame)
    picture = picture_of_map(points, images, feature_map.cameras, read_gray)
    if picture is None:
        return None
    sources = [source for source in searched_sources(cloud) if source != "shaded"]  # which shows no ground
    for source in sources:
        there, wrong = starts_from_above(feature_map, picture, cloud, source)
        found = _placed(there, wrong, photos, cloud, source, len(sources))
        if found is not None:
            return _registered(feature_map, *found, photos, cloud, source, wanted)
    return None


def _placed(
    there: Sequence[Sim3],
    elsewhere: Sequence[Sim3],
    photos: Sequence[AskedPhoto],
    cloud: PointCloud,
    source: RenderSource,
    sources: int,
) -> tuple[Sim3, dict[str, Any]] | None:
    """The fitted place that wrong places do not explain, and its evidence as figures."""
    one = [evidence_of(start, photos[:1], cloud, source).places for start in there]
    photos = photos[: max(_LEAST_PHOTOS, _ENOUGH_PLACES // max([1, *one]))]
    asked = [(start, evidence_of(start, photos, cloud, source)) for start in there]
    if not asked:
        return None
    # All as they are found: fitted to its pieces a wrong place agrees more, too.
    start, found = max(asked, key=lambda one: one[1].agreeing)
    wrong = [one for other, one in asked if other is not start]
    wrong += [evidence_of(other, photos, cloud, source) for other in elsewhere]
    log_nfa = found.log_nfa(wrong, sources * len(asked))
    _LOG.info("together by %s: %s, 10^-%.1f, elsewhere %s", source, found, log_nfa, wrong)
    if log_nfa < _LOG_RATE or found.agreeing < _LEAST_SHARE * found.places:
        return None
    similarity = fitted_together(start, photos, cloud, source)
    if similarity is None:
        return None
    return similarity, {TOGETHER: asdict(found) | {"log_nfa": log_nfa}}


def _registered(
    feature_map: FeatureMap,
    new_from_old: Sim3,
    figures: dict[str, Any],
    photos: Sequence[AskedPhoto],
    cloud: PointCloud,
    source: RenderSource,
    wanted: int,
) -> dict[int, FrameRegistration]:
    """The first photos that have correspondences of their own."""
    registrations: dict[int, FrameRegistration] = {}
    placed = new_from_old.act(feature_map.points_local(cloud.frame))
    for photo in photos:
        if len(registrations) == wanted:
            break
        seen = placed[feature_map.points_in(photo.image)]
        if not len(seen):
            continue
        prior = prior_by_others(new_from_old.act_on_pose(photo.image.cam_from_local), seen)
        found = fit_vouched_for(photo.gray, photo.camera, prior, cloud, source, figures)
        if found.accepted:
            registrations[photo.image.image_id] = found
    return registrations


def prior_by_others(pose: Rigid3, seen: FloatArray) -> FramePrior:
    """Of a photo whose map is placed and that sees points (n, 3) of it."""
    distance_m = float(np.median(np.linalg.norm(seen - pose.center, axis=1)))
    return FramePrior.around(pose, _BENT * distance_m, float(np.degrees(_BENT)))


class _Seen(NamedTuple):
    """A photo, pieces of it with their points of the scan, and pixels of the render for one of the photo."""

    photo: AskedPhoto
    pieces: FrameMatches
    shrunk: float


def fitted_together(
    start: Sim3, photos: Sequence[AskedPhoto], cloud: PointCloud, source: RenderSource
) -> Sim3 | None:
    """The similarity within `_SIGMAS` of a start under which the pieces of all photos fit best, if enough."""
    new_from_old = start
    for spacing_px, piece_px, near_px in _ROUNDS:
        seen: list[_Seen] = []
        for photo in photos:
            camera, pose = photo.camera, new_from_old.act_on_pose(photo.image.cam_from_local)
            look = first_look(cloud, camera, pose)
            if look is None:
                continue
            views = FrameViews(photo.gray, camera, cloud, look, FrameOptions(threads=1))
            side_px = views.side_px(spacing_px, MAX_SIDE_PX)
            for rendering in views.renders([pose], side_px):
                pieces = near_places(views, rendering, source, piece_px, near_px)
                seen.append(_Seen(photo, pieces, side_px / max(camera.width, camera.height)))
        if sum(len(one.pieces) for one in seen) < _LEAST_PIECES:
            return None
        new_from_old = _moved(new_from_old, start, seen)
    return new_from_old


def _moved(new_from_old: Sim3, start: Sim3, seen: Sequence[_Seen]) -> Sim3:
    """The similarity fitted to the pieces' places, from one near it."""
    middle = np.median(np.vstack([one.pieces.points for one in seen]), axis=0)
    about = Sim3.shift(middle)

    def at(step: FloatArray) -> Sim3:
        return Sim3.exp(step * _SIGMAS).about(middle) @ new_from_old

    def off(step: FloatArray) -> FloatArray:
        similarity, parts = at(step), []
        for photo, pieces, shrunk in seen:
            pose = similarity.act_on_pose(photo.image.cam_from_local)
            parts.append(shrunk * (photo.camera.project(pose.act(pieces.points)) - pieces.pixels))
        pixels = np.nan_to_num(np.vstack(parts), nan=_FAR_PX).ravel() / _LOSS_PX
        moved = (about.inverse() @ similarity @ start.inverse() @ about).log() / _SIGMAS
        return np.concatenate([pixels, moved])

    return at(np.asarray(least_squares(off, np.zeros(7), loss="cauchy").x))


def starts_from_above(
    feature_map: FeatureMap, picture: OrthoPicture, cloud: PointCloud, source: RenderSource
) -> tuple[list[Sim3], list[Sim3]]:
    """Similarities of a map's frame under which it looks like the scan from above.

    Args:
        picture: of the map, in its frame.
        cloud: the scan around the map, in the map's frame.

    Returns:
        The places within what the placement leaves open, apart from each other, best first; none where that
        is too much. And the best few of those that are turned by one, two and three right angles: streets of
        most towns are square to each other, so these agree as wrong places do.
    """
    points = feature_map.points_local(cloud.frame)
    reach_m, turn, size = _left_open(feature_map, picture)
    low, high = _around(picture, reach_m)
    cell_m = max(float((high - low).max()) / _MOST_CELLS, _CELL * plan_spacing_m(cloud))
    drawn = picture_of_scan(cloud, source, cell_m, (low, high))
    sizes = picture.cell * np.exp(_steps(size, _SIZE_STEP))
    turns = _steps(turn, _TURN_STEP).tolist()
    if not drawn.valid.any() or len(sizes) * len(turns) > _MOST_TRIES:
        return [], []
    search = ScanSearch(drawn, _COVER)
    height = float(np.median(picture.height[picture.valid]))  # about as it is
    apart = _APART * picture.cell * max(picture.gray.shape)

    def same(one: PlanTry, other: PlanTry) -> bool:
        return bool(one.apart(other)[0] <= apart)

    def best(around: float) -> list[Sim3]:
        """Similarities, best first, with headings about one."""
        found = [search.best(picture, one, around + angle) for one in sizes.tolist() for angle in turns]
        tries = sorted((one for one in found if one is not None), key=lambda one: -one.agreeing)
        distinct = first_apart(tries, same, _PLACES)
        return [_levelled(one.similarity(picture, height), points, drawn) for one in distinct]

    quarters = _QUARTERS if turn < 0.5 * _QUARTERS[0] else ()
    return best(0.0), [one for quarter in quarters for one in best(quarter)[:_WRONG_PLACES]]


def _left_open(feature_map: FeatureMap, picture: OrthoPicture) -> tuple[float, float, float]:
    """How far the map may be off: metres in plan, radians of heading, logarithm of its size."""
    covariance = feature_map.placement.covariance
    middle = np.array([*picture.middle, float(np.median(picture.height[picture.valid]))])
    plan = place_covariance(covariance, middle)[:2, :2]
    sigmas = np.sqrt([np.linalg.eigvalsh(plan)[-1], covariance[3, 3], covariance[0, 0]])
    reach, turn, size = np.maximum(_REACH * sigmas, [_LEAST_REACH_M, _LEAST_TURN, _LEAST_SIZE]).tolist()
    return min(reach, _MOST_REACH_M), min(turn, float(np.pi)), size


def _steps(reach: float, step: float) -> FloatArray:
    count = int(np.ceil(reach / step))
    return np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)


def _around(picture: OrthoPicture, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """Least and largest x and y of where the map may lie, however it is turned."""
    rows, columns = np.nonzero(picture.valid)
    corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    middle = picture.corner + picture.cell * corners.mean(axis=0)
    half = 0.5 * picture.cell * float(np.linalg.norm(corners[1] - corners[0])) + reach_m
    return np.asarray(middle - half, np.float64), np.asarray(middle + half, np.float64)


def _levelled(new_from_old: Sim3, points: FloatArray, scan: OrthoPicture) -> Sim3:
    """Tilted and lifted until the points (n, 3) lie on the scan's surface, most of them."""
    for _ in range(_LEVEL_ROUNDS):
        placed = new_from_old.act(points)
        lack = _surface(scan, placed[:, :2]) - placed[:, 2]
        there = np.isfinite(lack)
        if there.sum() < _LEAST_POINTS:
            break
        placed, lack = placed[there], lack[there]
        middle = np.median(placed, axis=0)
        rows = np.column_stack([np.ones(len(lack)), placed[:, :2] - middle[:2]])
        plane = np.array([float(np.median(lack)), 0.0, 0.0])
        for _ in range(_WEIGHT_ROUNDS):
            off = lack - rows @ plane
            weight = 1.0 / (1.0 + (off / (1.4826 * np.median(np.abs(off)) + _LEAST_M)) ** 2)
            root = np.sqrt(weight)
            plane = np.linalg.lstsq(rows * root[:, None], root * lack)[0]
        turn = so3_exp([plane[2], -plane[1], 0.0])
        lifted = middle + np.array([0.0, 0.0, plane[0]])
        new_from_old = Sim3(scale=1.0, rotation=turn, translation=lifted - turn @ middle) @ new_from_old
    return new_from_old


def _surface(scan: OrthoPicture, plan: FloatArray) -> FloatArray:
    """Heights (n,) of the scan at places (n, 2); NaN where it shows nothing."""
    cells = np.floor((plan - scan.corner) / scan.cell).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < scan.gray.shape[::-1])).all(axis=1))
    columns, rows = np.where(inside[:, None], cells, 0).T
    known = inside & scan.valid[rows, columns]
    return np.asarray(np.where(known, scan.height[rows, columns], np.nan))
