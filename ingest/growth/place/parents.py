"""What existing maps are to a map that they hold: where each alone would place it, what they say together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lineage import GROWTH
from featuredb.maps.move import covariance_in_frame
from ingest.colmap.bridge import Model
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.place.similarity_fit import FittedSimilarity, SimilarityFitOptions, fit_similarity
from ingest.growth.values import Edge, MapAgreement, MapsPlacement


@dataclass(frozen=True, slots=True, kw_only=True)
class ParentOptions:
    """When an existing map is a parent.

    Attributes:
        min_points, min_photos: an existing map with fewer shared points, or seen by fewer new photos, is not
            a parent: alone it would not hold the new one.
    """

    min_points: int = 30
    min_photos: int = 2


def edges_of(
    model: Model,
    fit: FittedSimilarity,
    correspondences: Correspondences,
    used: NDArray[np.bool_],
    options: ParentOptions,
    fitting: SimilarityFitOptions,
) -> tuple[Edge, ...]:
    """How each existing map holds the model, by its own points alone where they suffice."""
    found: list[Edge] = []
    for m, map_id in enumerate(correspondences.map_ids):
        mine = used & (correspondences.map_of == m)
        points = len(np.unique(correspondences.point_of[mine]))
        photos = len(np.unique(correspondences.photo_of[mine]))
        if points < options.min_points or photos < options.min_photos:
            continue
        alone = fit_similarity(model, fit.local_from_sfm, correspondences, mine, fitting)
        found.append(
            Edge(
                map_id=map_id,
                parent_from_new=alone.local_from_sfm @ fit.local_from_sfm.inverse(),
                covariance=alone.covariance,
                shared_points=points,
                photos=photos,
            )
        )
    return tuple(sorted(found, key=lambda e: (-e.shared_points, e.map_id)))


def parents_covariance(parents: Sequence[tuple[FeatureMap, int]], frame: LocalFrame) -> FloatArray:
    """(7, 7) of the parents' placements on Earth in `frame`, weighted by shared points.

    The mean of covariances bounds that of a mean from above however the parents' errors are correlated:
    parents that came of one anchor err alike.
    """
    total = sum(weight for _, weight in parents)
    covariance = np.zeros((7, 7))
    for feature_map, weight in parents:
        moved = covariance_in_frame(feature_map.placement.covariance, feature_map.frame, frame)
        covariance += weight / total * moved
    return covariance


def map_agreements(placement: MapsPlacement, held: Correspondences) -> tuple[MapAgreement, ...]:
    """How well each pair of parents agrees, as the new map that overlaps both sees it.

    Args:
        held: correspondences that agree with the placement.
    """
    found: list[MapAgreement] = []
    edges = placement.edges
    for i, a in enumerate(edges):
        for b in edges[i + 1 :]:
            a_from_b = a.parent_from_new @ b.parent_from_new.inverse()
            adjoint = a_from_b.adjoint()
            covariance = a.covariance + adjoint @ b.covariance @ adjoint.T
            both = np.isin(held.map_of, [held.map_ids.index(a.map_id), held.map_ids.index(b.map_id)])
            middle = held.points[both].mean(axis=0)
            offset = a_from_b.act(middle) - middle
            distance = float(np.linalg.norm(offset))
            jacobian = point_jacobian(middle)
            spread = jacobian @ covariance @ jacobian.T
            axis = offset / distance if distance > 0 else np.array([1.0, 0.0, 0.0])
            sigma = float(np.sqrt(axis @ spread @ axis))
            found.append(
                MapAgreement(
                    map_a=a.map_id,
                    map_b=b.map_id,
                    a_from_b=a_from_b,
                    covariance=np.asarray((covariance + covariance.T) / 2),
                    distance_m=distance,
                    sigma_m=sigma,
                    sigmas=float(np.sqrt(offset @ np.linalg.solve(spread, offset))),
                    photos=(a.photos, b.photos),
                )
            )
    return tuple(found)


def drift_covariance(parents: Sequence[tuple[FeatureMap, int]], frame: LocalFrame) -> FloatArray:
    """(7, 7) of the parents relative to their anchors, weighted by shared points; nothing for anchors.

    As for `parents_covariance`, the mean of covariances is a bound from above.
    """
    total = sum(weight for _, weight in parents)
    covariance = np.zeros((7, 7))
    for feature_map, weight in parents:
        flat = feature_map.placement.evidence.get(GROWTH, {}).get("covariance_relative")
        if flat is not None:
            own: FloatArray = np.asarray(flat, dtype=np.float64).reshape(7, 7)
            covariance += weight / total * covariance_in_frame(own, feature_map.frame, frame)
    return covariance
