"""Photos of a map registered to a scan together, from about where the map is."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.anchor.together.evidence import JointEvidence, evidence_of
from ingest.register.anchor.together.fit import fitted_together
from ingest.register.anchor.together.start import Starts, starts_from_above
from ingest.register.frame.register import fit_vouched_for
from ingest.register.frame.sources import searched_sources
from ingest.register.frame_registration import FramePrior, FrameRegistration, RenderSource

_LOG = logging.getLogger(__name__)

TOGETHER = "together"  # in the evidence of frames that were registered so
_LOG_RATE = 3.0  # of a thousand maps that lie elsewhere one is placed wrongly
_FITTED = 2  # of the places; the others tell how well wrong ones agree
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
    for source in searched_sources(cloud):
        starts = starts_from_above(feature_map, images, cloud, read_gray, source)
        found = _placed(feature_map, starts, asked, grays, cloud, source)
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
) -> tuple[Sim3, dict[str, Any]] | None:
    """The fitted place that wrong places do not explain, and its evidence as figures."""
    cameras = feature_map.cameras
    one = [evidence_of(start, images[:1], cameras, grays, cloud, source).places for start in starts.there]
    images = images[: max(_LEAST_PHOTOS, _ENOUGH_PLACES // max([1, *one]))]

    def evidence(similarity: Sim3) -> JointEvidence:
        return evidence_of(similarity, images, cameras, grays, cloud, source)

    asked = [(start, evidence(start)) for start in starts.there]
    asked.sort(key=lambda one: -one[1].agreeing)
    wrong = [evidence(one) for one in starts.wrong] if asked else []
    for number, (start, _) in enumerate(asked[:_FITTED]):
        similarity = fitted_together(start, images, cameras, grays, cloud, source)
        if similarity is None:
            continue
        found = evidence(similarity)
        log_nfa = found.log_nfa([*(other for k, (_, other) in enumerate(asked) if k != number), *wrong])
        _LOG.info("together by %s: %s, 10^-%.1f", source, found, log_nfa)
        if log_nfa >= _LOG_RATE:
            return similarity, {TOGETHER: asdict(found) | {"log_nfa": log_nfa}}
    return None


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
    for image in images:
        if len(registrations) == wanted:
            break
        pose = new_from_old.act_on_pose(image.cam_from_local)
        points = feature_map.observations.point_index[feature_map.observations.image_id == image.image_id]
        seen = new_from_old.act(feature_map.points_local(cloud.frame)[points])
        distance_m = float(np.median(np.linalg.norm(seen - pose.center, axis=1)))
        prior = FramePrior.around(pose, _BENT * distance_m, float(np.degrees(_BENT)))
        camera = feature_map.cameras[image.camera_id]
        found = fit_vouched_for(grays[image.image_id], camera, prior, cloud, source, figures)
        if found.accepted:
            registrations[image.image_id] = found
    return registrations
