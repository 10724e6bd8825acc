"""Photos of a map registered to a scan together, from about where the map is.

The similarity is fitted as one photo's pose is (`ingest.register.frame.dense.fit`), round by round: renders
are made at the poses that it gives, each piece takes its best place near by, and it is fitted to all of them
with a robust loss, and held near its start where they tell little.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.anchor.start.ortho import picture_of_map
from ingest.register.anchor.together.start import starts_from_above
from ingest.register.frame.dense.confirmation import JointEvidence, evidence_of
from ingest.register.frame.dense.fit import MAX_SIDE_PX, near_places
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
    grays: dict[int, NDArray[np.uint8]] = {}
    for image in images:
        if len(grays) == _MOST_PHOTOS:
            break
        try:
            grays[image.image_id] = read_gray(image)
        except ImageError:
            continue
    asked = [image for image in images if image.image_id in grays]
    if not asked:
        return None
    points = feature_map.points_local(cloud.frame)
    picture = picture_of_map(points, images, feature_map.cameras, read_gray)
    if picture is None:
        return None
    sources = [source for source in searched_sources(cloud) if source != "shaded"]  # which shows no ground
    for source in sources:
        there, wrong = starts_from_above(feature_map, picture, cloud, source)
        found = _placed(feature_map, there, wrong, asked, grays, cloud, source, len(sources))
        if found is not None:
            return _registered(feature_map, *found, asked, grays, cloud, source, wanted)
    return None


def _placed(
    feature_map: FeatureMap,
    there: Sequence[Sim3],
    elsewhere: Sequence[Sim3],
    images: Sequence[MapImage],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
    sources: int,
) -> tuple[Sim3, dict[str, Any]] | None:
    """The fitted place that wrong places do not explain, and its evidence as figures."""
    cameras = feature_map.cameras
    one = [evidence_of(start, images[:1], cameras, grays, cloud, source).places for start in there]
    images = images[: max(_LEAST_PHOTOS, _ENOUGH_PLACES // max([1, *one]))]

    def evidence(similarity: Sim3) -> JointEvidence:
        return evidence_of(similarity, images, cameras, grays, cloud, source)

    asked = [(start, evidence(start)) for start in there]
    if not asked:
        return None
    # All as they are found: fitted to its pieces a wrong place agrees more, too.
    start, found = max(asked, key=lambda one: one[1].agreeing)
    wrong = [one for other, one in asked if other is not start] + [evidence(one) for one in elsewhere]
    log_nfa = found.log_nfa(wrong, sources * len(asked))
    _LOG.info("together by %s: %s, 10^-%.1f, elsewhere %s", source, found, log_nfa, wrong)
    if log_nfa < _LOG_RATE or found.agreeing < _LEAST_SHARE * found.places:
        return None
    similarity = fitted_together(start, images, cameras, grays, cloud, source)
    if similarity is None:
        return None
    return similarity, {TOGETHER: asdict(found) | {"log_nfa": log_nfa}}


def _registered(
    feature_map: FeatureMap,
    new_from_old: Sim3,
    figures: dict[str, Any],
    images: Sequence[MapImage],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
    wanted: int,
) -> dict[int, FrameRegistration]:
    """The first photos that have correspondences of their own."""
    registrations: dict[int, FrameRegistration] = {}
    placed = new_from_old.act(feature_map.points_local(cloud.frame))
    for image in images:
        if len(registrations) == wanted:
            break
        points = feature_map.observations.point_index[feature_map.observations.image_id == image.image_id]
        if not len(points):
            continue
        prior = prior_by_others(new_from_old.act_on_pose(image.cam_from_local), placed[points])
        camera = feature_map.cameras[image.camera_id]
        found = fit_vouched_for(grays[image.image_id], camera, prior, cloud, source, figures)
        if found.accepted:
            registrations[image.image_id] = found
    return registrations


def prior_by_others(pose: Rigid3, seen: FloatArray) -> FramePrior:
    """Of a photo whose map is placed.

    Args:
        seen: (n, 3) what it shows of the map.
    """
    distance_m = float(np.median(np.linalg.norm(seen - pose.center, axis=1)))
    return FramePrior.around(pose, _BENT * distance_m, float(np.degrees(_BENT)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """A photo's pieces: pixels (n, 2) of the full photo and points (n, 3) of the scan; pixels of the render
    for one of the photo."""

    camera: Camera
    cam_from_old: Rigid3
    pixels: FloatArray
    points: FloatArray
    shrunk: float


def fitted_together(
    start: Sim3,
    images: Sequence[MapImage],
    cameras: Sequence[Camera],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
) -> Sim3 | None:
    """The similarity of the map's frame under which the pieces of all photos fit best; None with too few.

    Args:
        start: within the deviations above. grays: (h, w) of each image, by id.
    """
    new_from_old = start
    for spacing_px, piece_px, near_px in _ROUNDS:
        seen = []
        for image in images:
            camera = cameras[image.camera_id]
            pose = new_from_old.act_on_pose(image.cam_from_local)
            look = first_look(cloud, camera, pose)
            if look is None:
                continue
            views = FrameViews(grays[image.image_id], camera, cloud, look, FrameOptions(threads=1))
            side_px = views.side_px(spacing_px, MAX_SIDE_PX)
            for rendering in views.renders([pose], side_px):
                found = near_places(views.gray, camera, rendering, source, piece_px, near_px)
                seen.append(
                    _Seen(
                        camera=camera,
                        cam_from_old=image.cam_from_local,
                        pixels=found.pixels,
                        points=found.points,
                        shrunk=side_px / max(camera.width, camera.height),
                    )
                )
        if sum(len(one.points) for one in seen) < _LEAST_PIECES:
            return None
        new_from_old = _moved(new_from_old, start, seen)
    return new_from_old


def _moved(new_from_old: Sim3, start: Sim3, seen: Sequence[_Seen]) -> Sim3:
    """The similarity fitted to the pieces' places, from one near it."""
    middle = np.median(np.vstack([one.points for one in seen]), axis=0)
    about = Sim3(scale=1.0, rotation=np.eye(3), translation=middle)

    def at(step: FloatArray) -> Sim3:
        return about @ Sim3.exp(step * _SIGMAS) @ about.inverse() @ new_from_old

    def off(step: FloatArray) -> FloatArray:
        similarity = at(step)
        parts = [
            one.shrunk
            * (one.camera.project(similarity.act_on_pose(one.cam_from_old).act(one.points)) - one.pixels)
            for one in seen
        ]
        pixels = np.nan_to_num(np.vstack(parts), nan=_FAR_PX).ravel() / _LOSS_PX
        moved = (about.inverse() @ similarity @ start.inverse() @ about).log() / _SIGMAS
        return np.concatenate([pixels, moved])

    return at(np.asarray(least_squares(off, np.zeros(7), loss="cauchy").x))
