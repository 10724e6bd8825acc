"""Photos of a map registered to a scan together, from about where the map is."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.anchor.start.ortho import picture_of_map
from ingest.register.anchor.together.evidence import JointEvidence, evidence_of
from ingest.register.anchor.together.fit import fitted_together
from ingest.register.anchor.together.start import Starts, starts_from_above
from ingest.register.frame.register import fit_vouched_for
from ingest.register.frame.sources import searched_sources
from ingest.register.frame_registration import FramePrior, FrameRegistration, RenderSource

_LOG = logging.getLogger(__name__)

TOGETHER = "together"  # in the evidence of frames that were registered so
_LOG_RATE = 3.0  # of a thousand maps that lie elsewhere one is placed wrongly
_LEAST_SHARE = 0.18  # of the places, as of the pieces of one photo (`ConfirmOptions`)
# So many photos are asked and fitted as show so many places of the scan, by what one of them shows.
_LEAST_PHOTOS, _MOST_PHOTOS, _ENOUGH_PLACES = 4, 12, 150
# What a photo's own pose may differ from the similarity's by, as a map is bent: of the viewing distance, and
# as an angle. Structure projection takes maps that are bent by as much.
_BENT = 0.003


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TogetherFrames:
    """Photos that one similarity registers.

    Attributes:
        new_from_old: of the map's frame. source: of the scan.
        registrations: by image id.
    """

    new_from_old: Sim3
    source: RenderSource
    registrations: Mapping[int, FrameRegistration]


def register_together(
    feature_map: FeatureMap,
    images: Sequence[MapImage],
    cloud: PointCloud,
    read_gray: PhotoReader,
    wanted: int,
) -> TogetherFrames | None:
    """The place of a map by all its photos, and the first of them registered there; None where none is sure.

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
        starts = starts_from_above(feature_map, picture, cloud, source)
        found = _placed(feature_map, starts, asked, grays, cloud, source, len(sources))
        if found is not None:
            new_from_old, figures = found
            return TogetherFrames(
                new_from_old=new_from_old,
                source=source,
                registrations=_registered(
                    feature_map, new_from_old, asked, grays, cloud, source, wanted, figures
                ),
            )
    return None


def _placed(
    feature_map: FeatureMap,
    starts: Starts,
    images: Sequence[MapImage],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
    sources: int,
) -> tuple[Sim3, dict[str, Any]] | None:
    """The fitted place that wrong places do not explain, and its evidence as figures."""
    cameras = feature_map.cameras
    one = [evidence_of(start, images[:1], cameras, grays, cloud, source).places for start in starts.there]
    images = images[: max(_LEAST_PHOTOS, _ENOUGH_PLACES // max([1, *one]))]

    def evidence(similarity: Sim3) -> JointEvidence:
        return evidence_of(similarity, images, cameras, grays, cloud, source)

    asked = [(start, evidence(start)) for start in starts.there]
    if not asked:
        return None
    # All as they are found: fitted to its pieces a wrong place agrees more, too.
    start, found = max(asked, key=lambda one: one[1].agreeing)
    wrong = [one for other, one in asked if other is not start] + [evidence(one) for one in starts.wrong]
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
    images: Sequence[MapImage],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
    wanted: int,
    figures: dict[str, Any],
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
