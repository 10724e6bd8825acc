"""Which part of the maps a photo may show: voting for images, then clusters of images that see the same."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.index.area import Area
from featuredb.index.descriptor_index import DescriptorIndex
from featuredb.maps.feature_map import GeoPrior
from reloc.options import CandidateOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexedArea:
    """An area and the index over its descriptors."""

    area: Area
    index: DescriptorIndex


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cluster:
    """Images of one area that see the same place.

    Attributes:
        area: where they are.
        images: (i,) rows of the area's images.
        points: (p,) rows of the area's points that they see.
        score: votes above expectation, in standard deviations; infinity for a whole area.
    """

    area: Area
    images: NDArray[np.intp]
    points: NDArray[np.int32]
    score: float


def find_clusters(
    areas: Sequence[IndexedArea], features: Features, prior: GeoPrior | None, options: CandidateOptions
) -> list[Cluster]:
    """Clusters to try, best first; empty where the prior lies outside all maps or nothing got votes."""
    found: list[Cluster] = []
    for indexed in areas:
        area = indexed.area
        allowed = images_in_reach(area, prior, options)
        if not allowed.any():
            continue
        images = np.flatnonzero(allowed)
        points = area.points_of_images(images)
        if len(points) <= options.single_cluster_points:
            found.append(Cluster(area=area, images=images, points=points, score=np.inf))
            continue
        scores = _vote(indexed, features, allowed, options)
        found.extend(_grow_clusters(area, scores, options))
    found.sort(key=lambda cluster: -cluster.score)
    return found[: options.max_clusters]


def images_in_reach(area: Area, prior: GeoPrior | None, options: CandidateOptions) -> NDArray[np.bool_]:
    """(i,) which images may see what a camera within the prior sees."""
    if prior is None:
        return np.ones(len(area.image_center), dtype=np.bool_)
    height = prior.height_m if prior.height_m is not None else area.frame.height_m
    place = area.frame.enu_from_geodetic(np.array([prior.latitude_deg, prior.longitude_deg, height]))
    margin = options.prior_sigmas * prior.sigma_horizontal_m + options.prior_reach * area.image_reach
    to_camera = np.linalg.norm(area.image_center[:, :2] - place[:2], axis=1)
    to_scene = np.linalg.norm(area.image_scene[:, :2] - place[:2], axis=1)
    return np.asarray(np.minimum(to_camera, to_scene) <= margin, dtype=np.bool_)


def _vote(
    indexed: IndexedArea, features: Features, allowed: NDArray[np.bool_], options: CandidateOptions
) -> FloatArray:
    """(i,) votes of each image above what chance gives it, in standard deviations; -inf where not allowed.

    An image that sees many points gets many votes by chance: n votes over P points give an image with p
    of them n p / P, with about that variance.
    """
    area = indexed.area
    _, rows = indexed.index.search(features.descriptors[: options.vote_features], options.vote_neighbours)
    votes_of_point = np.bincount(rows[rows >= 0], minlength=len(area.points))
    votes = np.add.reduceat(
        np.append(votes_of_point[area.see_point], 0), np.minimum(area.image_start[:-1], len(area.see_point))
    ).astype(np.float64)
    seen = np.diff(area.image_start)
    votes[seen == 0] = 0.0
    expected = votes_of_point.sum() * seen / max(len(area.points), 1)
    score = (votes - expected) / np.sqrt(expected + 1.0)
    score[~allowed] = -np.inf
    return np.asarray(score, dtype=np.float64)


def _grow_clusters(area: Area, scores: FloatArray, options: CandidateOptions) -> list[Cluster]:
    """Around each image with most votes left, the images that share most points with it."""
    free = np.isfinite(scores)
    clusters: list[Cluster] = []
    for _ in range(options.max_clusters):
        if not free.any():
            break
        seed = int(np.argmax(np.where(free, scores, -np.inf)))
        row = area.covisible[[seed], :].tocoo()
        neighbours, shared = row.coords[1], row.data
        usable = np.isfinite(scores[neighbours])
        neighbours, shared = neighbours[usable], shared[usable]
        # Shared points decide which images belong together, votes which of them matter.
        weight = np.sqrt(shared) * np.maximum(scores[neighbours], 0.0) + 1e-3 * shared
        images = np.union1d(
            [seed], neighbours[np.argsort(-weight, kind="stable")[: options.max_cluster_images]]
        )
        free[images] = False
        clusters.append(
            Cluster(area=area, images=images, points=area.points_of_images(images), score=float(scores[seed]))
        )
    return clusters
