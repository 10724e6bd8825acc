"""Which part of the maps a photo may show: voting for images, then clusters of images that see the same."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import IncompatibleExtractorError
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.index.area import Area, build_area
from featuredb.index.descriptor_index import DescriptorIndex, build_index
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from reloc.localise.options import CandidateOptions

# A place this far under the frame's horizon is more than 1,100 km away.
_FAR_BELOW_M = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class IndexedArea:
    """An area and the index over its descriptors."""

    area: Area
    index: DescriptorIndex

    @classmethod
    def of(cls, maps: Sequence[FeatureMap]) -> "IndexedArea":
        """Maps of one extractor and height datum, laid out in one frame and ready to be asked."""
        area = build_area(maps)
        return cls(area=area, index=build_index(area.descriptors))

    def only(self, map_ids: Collection[str]) -> "IndexedArea":
        """The same area and index, of which only these maps are searched."""
        return IndexedArea(area=self.area.only(map_ids), index=self.index)


def usable_areas(areas: Sequence[IndexedArea], fingerprint: str) -> list[IndexedArea]:
    """Those whose descriptors can be compared with those of this extractor.

    Raises:
        IncompatibleExtractorError: there are areas, and none of them is.
    """
    usable = [a for a in areas if a.area.extractor_fingerprint == fingerprint]
    if areas and not usable:
        raise IncompatibleExtractorError(
            f"the maps were made by extractor {areas[0].area.extractor_fingerprint}, photos and frames here "
            f"use {fingerprint}: their descriptors cannot be compared; ingest the photos of these maps "
            "again with this version"
        )
    return usable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cluster:
    """Images of one area that see the same place.

    Attributes:
        area: where they are.
        images: (i,) rows of the area's images.
        points: (p,) rows of the area's points that they see.
        score: votes above expectation, in standard deviations; infinity where all areas are tried anyway.
    """

    area: Area
    images: NDArray[np.intp]
    points: NDArray[np.int32]
    score: float


def find_clusters(
    areas: Sequence[IndexedArea],
    features: Features,
    prior: GeoPrior | None,
    options: CandidateOptions,
    beyond: GeoPrior | None = None,
) -> list[Cluster]:
    """Clusters to try, best first; empty where the prior lies outside all maps or nothing got votes.

    Args:
        beyond: images that may see what a camera within this prior sees are left out: they were tried.
    """
    reach = [(indexed, images_in_reach(indexed.area, prior, options)) for indexed in areas]
    if beyond is not None:
        reach = [(a, allowed & ~images_in_reach(a.area, beyond, options)) for a, allowed in reach]
    reach = [(indexed, allowed) for indexed, allowed in reach if allowed.any()]
    images = [np.flatnonzero(allowed) for _, allowed in reach]
    points = [indexed.area.points_of_images(rows) for (indexed, _), rows in zip(reach, images, strict=True)]
    small = [len(rows) <= options.single_cluster_points for rows in points]
    if all(small) and len(reach) <= options.max_clusters:
        return [
            Cluster(area=indexed.area, images=images[i], points=points[i], score=np.inf)
            for i, (indexed, _) in enumerate(reach)
        ]
    votes = _vote([indexed for indexed, _ in reach], features, options)
    searched = sum(int(np.count_nonzero(a.area.searched[a.area.point_map])) for a, _ in reach)
    share = sum(float(v.sum()) for v in votes) / max(searched, 1)
    found: list[Cluster] = []
    for i, (indexed, allowed) in enumerate(reach):
        if small[i]:
            score = float(_above_chance(votes[i][points[i]].sum(), share * len(points[i])))
            found.append(Cluster(area=indexed.area, images=images[i], points=points[i], score=score))
        else:
            scores = np.where(allowed, _image_scores(indexed.area, votes[i], share), -np.inf)
            found.extend(_grow_clusters(indexed.area, scores, options))
    found.sort(key=lambda cluster: -cluster.score)
    return found[: options.shortlist]


def images_in_reach(area: Area, prior: GeoPrior | None, options: CandidateOptions) -> NDArray[np.bool_]:
    """(i,) which images may see what a camera within the prior sees. Only horizontal distances count."""
    if prior is None:
        return area.searched_images()
    height = prior.height_m if prior.height_m is not None else area.frame.height_m
    place = area.frame.enu_from_geodetic(np.array([prior.latitude_deg, prior.longitude_deg, height]))
    if place[2] < -_FAR_BELOW_M:  # the far side of the Earth: its horizontal distances come back to zero
        return np.zeros(len(area.image_center), dtype=np.bool_)
    margin = options.prior_sigmas * prior.sigma_horizontal_m + options.prior_reach * area.image_reach
    to_camera = np.linalg.norm(area.image_center[:, :2] - place[:2], axis=1)
    to_scene = np.linalg.norm(area.image_scene[:, :2] - place[:2], axis=1)
    return np.asarray(area.searched_images() & (np.minimum(to_camera, to_scene) <= margin), dtype=np.bool_)


def _vote(areas: Sequence[IndexedArea], features: Features, options: CandidateOptions) -> list[FloatArray]:
    """For each area the votes (p,) of its points: a feature votes for its nearest point of all areas.

    By as much as that point is nearer than the `vote_background`-th, in squares: what looks like everything
    else says nothing (McCann and Lowe, Local Naive Bayes Nearest Neighbor, 2012). Points as near as the
    nearest get the same vote: other maps' points of the same place, and look-alikes. A vote counts one on
    average.
    """
    asked = features.descriptors[: options.vote_features]
    found = [
        indexed.index.search(
            asked,
            options.vote_background,
            None if indexed.area.searched.all() else indexed.area.searched[indexed.area.point_map],
        )
        for indexed in areas
    ]
    rows = np.concatenate([r for _, r in found], axis=1)
    squared = np.concatenate([d for d, _ in found], axis=1).astype(np.float64)
    squared[rows < 0] = np.inf
    ranked = np.sort(squared, axis=1)[:, : options.vote_background]
    background = np.max(ranked, axis=1, where=np.isfinite(ranked), initial=1.0)[:, None]
    weight = np.maximum(1.0 - squared / background, 0.0)
    weight[squared > (1.0 + options.vote_tie) ** 2 * ranked[:, :1]] = 0.0
    weight /= max(float(weight[weight > 0.0].mean()) if (weight > 0.0).any() else 0.0, 1e-9)
    votes: list[FloatArray] = []
    for indexed, part in zip(areas, np.split(np.arange(rows.shape[1]), len(areas)), strict=True):
        given = weight[:, part] > 0.0
        chosen, weights = rows[:, part][given], weight[:, part][given]
        counted = np.bincount(chosen, weights=weights, minlength=len(indexed.area.points))
        votes.append(counted.astype(np.float64))
    return votes


def _image_scores(area: Area, votes_of_point: FloatArray, share: float) -> FloatArray:
    """(i,) votes of each image above what chance gives it, in standard deviations.

    Args:
        share: votes per point over all areas. An image that sees many points gets many votes by chance:
            p points get p times this, with about that variance.
    """
    votes = np.add.reduceat(
        np.append(votes_of_point[area.see_point], 0.0), np.minimum(area.image_start[:-1], len(area.see_point))
    )
    seen = np.diff(area.image_start)
    votes[seen == 0] = 0.0
    return np.asarray(_above_chance(votes, share * seen), dtype=np.float64)


def _above_chance(votes: ArrayLike, expected: ArrayLike) -> FloatArray:
    return np.asarray((np.subtract(votes, expected)) / np.sqrt(np.add(expected, 1.0)), dtype=np.float64)


def _grow_clusters(area: Area, scores: FloatArray, options: CandidateOptions) -> list[Cluster]:
    """Around each image with most votes left, the images that share most points with it."""
    free = np.isfinite(scores)
    clusters: list[Cluster] = []
    for _ in range(options.shortlist):
        if not free.any():
            break
        seed = int(np.argmax(np.where(free, scores, -np.inf)))
        row = area.covisible[[seed], :].tocoo()
        neighbours, shared = row.coords[1], row.data
        usable = np.isfinite(scores[neighbours])
        neighbours, shared = neighbours[usable], shared[usable]
        # Shared points decide which images belong together, votes which of them matter.
        weight = np.sqrt(shared) * np.maximum(scores[neighbours], 0.0) + 1e-3 * shared
        weight[neighbours == seed] = np.inf
        images = np.union1d(
            [seed], neighbours[np.argsort(-weight, kind="stable")[: options.max_cluster_images]]
        )
        free[images] = False
        clusters.append(
            Cluster(area=area, images=images, points=area.points_of_images(images), score=float(scores[seed]))
        )
    return clusters
