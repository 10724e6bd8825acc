"""Existing maps that show the scene of a new one at another place: one of both is misplaced.

An error that all positions of a flight share does not show in its photos. It shows where another map has the
same scene: images of the new map look like images of that one, are localised in it without any prior, and how
the maps then lie to each other is compared with what both placements allow.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from featuredb.errors import FeatureDbError
from featuredb.geo.words import way_words
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from featuredb.index.vocabulary import Vocabulary
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import MapSummary, Snapshot
from ingest.growth.place.map_images import features_and_points, measure_overlap
from ingest.growth.values import LEAST_PHOTOS, Edge
from ingest.positions.variance_components import NOISE_SPREAD
from ingest.workspace import read_array, write_arrays

logger = logging.getLogger(__name__)

_RATE = 0.001  # of right maps of one scene, that are said to contradict each other
_MAPS, _IMAGES = 3, 8  # that look most alike are asked; a scene's own map and images are nearly always first
_FAR_M = 10_000.0  # the Earth's curvature, not the height, is what is vertical at such distances


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneElsewhere:
    """An existing map that has the same scene at another place.

    Attributes:
        offset_m: (2,) east and north of the scene in that map from the scene in the new one.
        overlap: of the new map with it.
    """

    summary: MapSummary
    offset_m: FloatArray
    overlap: Edge

    @property
    def message(self) -> str:
        """For people, with what to do."""
        of = self.summary
        return (
            f"map {of.map_id} ({of.name}, placed by {of.method}) has the same scene "
            f"{way_words(*self.offset_m)}, by {self.overlap.photos} photos and "
            f"{self.overlap.shared_points} points in "
            "common: one of both is misplaced, or two places look alike. Retire that one if it is wrong "
            "(`featuredb retire`), then `featuredb promote` takes this one into service"
        )


def same_scene_elsewhere(
    feature_map: FeatureMap, snapshot: Snapshot, work: Path, vocabulary: Vocabulary
) -> SceneElsewhere | None:
    """The active map that most contradicts the place of a new one; None where none does, or one agrees.

    Args:
        work: work folder, where vectors of the maps' images are kept.
    """
    own = _vectors(feature_map, vocabulary)
    ranked: list[tuple[float, MapSummary, FloatArray]] = []
    for summary in snapshot.maps():
        if not _comparable(summary, feature_map):
            continue
        try:
            theirs = _vectors_of(summary, snapshot, work, vocabulary)
        except FeatureDbError as error:  # a damaged map is no reason to refuse a new one
            logger.warning("map %s is not compared with the new one: %s", summary.map_id, error)
            continue
        alike = (own @ theirs.T).max(axis=1, initial=-1.0)
        ranked.append((float(np.sort(alike)[-LEAST_PHOTOS:].sum()), summary, alike))
    ranked.sort(key=lambda entry: (-entry[0], entry[1].map_id))
    found: list[tuple[float, SceneElsewhere]] = []
    for _, summary, alike in ranked[:_MAPS]:
        images = [feature_map.images[k] for k in np.argsort(-alike, kind="stable")[:_IMAGES]]
        other = snapshot.load_map(summary.map_id)
        overlap = measure_overlap(feature_map, other, images=images)
        if not isinstance(overlap, Edge):
            continue
        offset_m, covariance = _offset(feature_map, other, overlap)
        chance = chance_of_offset(offset_m, covariance)
        if chance >= _RATE:
            return None
        found.append((chance, SceneElsewhere(summary=summary, offset_m=offset_m, overlap=overlap)))
    return min(found, key=lambda entry: entry[0])[1] if found else None


def chance_of_offset(offset_m: FloatArray, covariance: FloatArray) -> float:
    """How often two right placements of one scene are so far apart.

    Receivers are better and worse than they say by a factor of e (decision 0013).

    Args:
        offset_m: (2,) east, north. covariance: (2, 2) of both placements together, as they are stated.
    """
    squared = float(offset_m @ np.linalg.solve(covariance, offset_m))
    nodes, weights = np.polynomial.hermite_e.hermegauss(64)
    chances = chdtrc(2, squared / np.exp(2.0 * NOISE_SPREAD * nodes))
    return float(weights @ chances / weights.sum())


def _comparable(summary: MapSummary, feature_map: FeatureMap) -> bool:
    return (
        summary.status == "active"
        and summary.map_id != feature_map.map_id
        and summary.descriptors > 0
        and summary.extractor_fingerprint == feature_map.extractor_fingerprint
        and summary.height_datum == feature_map.height_datum
    )


def _offset(feature_map: FeatureMap, other: FeatureMap, overlap: Edge) -> tuple[FloatArray, FloatArray]:
    """Horizontal offset (2,) of the scene's middle in the other map, metres, and its covariance (2, 2)."""
    middle = np.median(feature_map.points_local(), axis=0)
    there = overlap.other_from_map.act(middle)
    away = there - middle
    if np.linalg.norm(away) > _FAR_M:
        away[:2] *= np.linalg.norm(away) / np.linalg.norm(away[:2])
    frame_from_other = feature_map.frame.enu_from(other.frame)
    spread = np.zeros((3, 3))
    for place, covariance, turn in (
        (middle, feature_map.placement.covariance, np.eye(3)),
        (there, overlap.covariance, np.eye(3)),
        (frame_from_other.inverse().act(there), other.placement.covariance, frame_from_other.rotation),
    ):
        jacobian = turn @ point_jacobian(place)
        spread += jacobian @ covariance @ jacobian.T
    return away[:2], spread[:2, :2]


def _vectors_of(
    summary: MapSummary, snapshot: Snapshot, work: Path, vocabulary: Vocabulary
) -> NDArray[np.float32]:
    """The vectors of an existing map, as they were kept or made of it."""
    file = work / "looks" / vocabulary.digest / f"{summary.write_id}.npz"
    if not file.is_file():
        vectors = _vectors(snapshot.load_map(summary.map_id), vocabulary).astype(np.float16)
        write_arrays(file, {"vectors": vectors})
    return np.asarray(read_array(file, "vectors"), dtype=np.float32)


def _vectors(feature_map: FeatureMap, vocabulary: Vocabulary) -> NDArray[np.float32]:
    """(images, vocabulary.size) of unit length, of what a map keeps of its images."""
    vectors: Sequence[NDArray[np.float32]] = [
        vocabulary.aggregate(features_and_points(feature_map, image)[0].descriptors)
        for image in feature_map.images
    ]
    return np.array(vectors, dtype=np.float32).reshape(-1, vocabulary.size)
