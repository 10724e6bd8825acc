"""Which part of the maps a photo may show: voting for images, then clusters of images that see the same."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import IncompatibleExtractorError
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.index.area import Area, build_area
from featuredb.index.descriptor_index import DescriptorCodes, DescriptorIndex, squared_distances
from featuredb.index.segment_index import SegmentIndex
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from reloc.localise.options import CandidateOptions

# Neighbours that codes propose for each that is wanted; the descriptors choose. Of a million points ten codes
# hold the nearest point of 62 % of features, forty of 71 %, exact codes in the same lists of 76 %.
_PROPOSED = 4
# Where at least this share of an index is in reach, it is searched as it is.
_MOST = 0.5
# A place this far under the frame's horizon is more than 1,100 km away.
_FAR_BELOW_M = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class IndexedArea:
    """An area and an index over its descriptors, and maybe those of other areas.

    Attributes:
        first: row of the index where the area's points begin.
    """

    area: Area
    index: SegmentIndex
    first: int = 0

    @classmethod
    def of(cls, maps: Sequence[FeatureMap]) -> "IndexedArea":
        """Maps of one extractor and height datum, laid out in one frame and ready to be asked."""
        area = build_area(maps)
        return cls(area=area, index=SegmentIndex.of(area.segments))

    def only(self, map_ids: Collection[str]) -> "IndexedArea":
        """The same area and index, of which only these maps are searched."""
        return replace(self, area=self.area.only(map_ids))


def indexed_together(areas: Sequence[Area], previous: Sequence[IndexedArea] = ()) -> list[IndexedArea]:
    """The areas with one index for all of each extractor: a photo is looked for in all of them at once.

    Args:
        previous: taken over where all areas of an extractor are the same; else of their index what it has.
    """
    indexed: dict[int, IndexedArea] = {}
    for fingerprint in {area.extractor_fingerprint for area in areas}:
        mine = [k for k, area in enumerate(areas) if area.extractor_fingerprint == fingerprint]
        had = [one for one in previous if one.area.extractor_fingerprint == fingerprint]
        if [id(one.area) for one in had] == [id(areas[k]) for k in mine]:
            indexed |= dict(zip(mine, had, strict=True))
            continue
        segments = [segment for k in mine for segment in areas[k].segments]
        index = SegmentIndex.of(segments, had[0].index if had else None)
        first = 0
        for k in mine:
            indexed[k] = IndexedArea(area=areas[k], index=index, first=first)
            first += len(areas[k].points)
    return [indexed[k] for k in range(len(areas))]


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
    reach: list[_Reach] = []
    most = options.single_cluster_points
    for indexed in areas:
        allowed = images_in_reach(indexed.area, prior, options)
        if beyond is not None:
            allowed &= ~images_in_reach(indexed.area, beyond, options)
        if allowed.any():
            reach.append(_Reach.of(indexed, allowed))
    if sum(map(len, reach)) <= most and len(reach) <= options.max_clusters:
        return [Cluster(area=r.area, images=r.images, points=r.points, score=np.inf) for r in reach]
    small = [len(r) <= most for r in reach]
    votes = _vote(reach, features, options)
    share = sum(float(given.sum()) for _, given in votes) / max(sum(map(len, reach)), 1)
    found: list[Cluster] = []
    for i, r in enumerate(reach):
        if small[i]:
            score = float(_above_chance(votes[i][1].sum(), share * len(r)))
            found.append(Cluster(area=r.area, images=r.images, points=r.points, score=score))
        else:
            found.extend(_grow_clusters(r.area, _image_scores(r, votes[i], share), options))
    found.sort(key=lambda cluster: -cluster.score)
    return found[: options.shortlist]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Reach:
    """The part of an area that is searched.

    Attributes:
        images: (i,) rows of its images.
        some: (p,) rows of the points that they see; None: all, which need no list.
    """

    indexed: IndexedArea
    images: NDArray[np.intp]
    some: NDArray[np.int32] | None

    def __len__(self) -> int:
        return len(self.area.points) if self.some is None else len(self.some)

    @property
    def points(self) -> NDArray[np.int32]:
        """Rows of the points in reach."""
        return np.arange(len(self), dtype=np.int32) if self.some is None else self.some

    @property
    def area(self) -> Area:
        return self.indexed.area

    def has(self, points: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(k,) which of the area's points (k,) are in reach."""
        if self.some is None:
            return np.ones(len(points), dtype=np.bool_)
        place = np.minimum(np.searchsorted(self.some, points), max(len(self) - 1, 0))
        return np.asarray(self.some[place] == points, dtype=np.bool_)

    @classmethod
    def of(cls, indexed: IndexedArea, allowed: NDArray[np.bool_]) -> "_Reach":
        images = np.flatnonzero(allowed)
        some = None if len(images) == len(allowed) else indexed.area.points_of_images(images)
        return cls(indexed=indexed, images=images, some=some)


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


_Votes = tuple[NDArray[np.int64], FloatArray]


def _vote(reach: Sequence[_Reach], features: Features, options: CandidateOptions) -> list[_Votes]:
    """For each area the points (v,) that got votes, ascending, and how many (v,).

    A feature votes for its nearest point in reach.

    By as much as that point is nearer than the `vote_background`-th, in squares: what looks like everything
    else says nothing (McCann and Lowe, Local Naive Bayes Nearest Neighbor, 2012). Points as near as the
    nearest get the same vote: other maps' points of the same place, and look-alikes. A vote counts one on
    average.
    """
    asked = features.descriptors[: options.vote_features]
    part, rows, squared = _nearest(reach, asked, options.vote_background)
    ranked = np.sort(squared, axis=1)[:, : options.vote_background]
    background = np.max(ranked, axis=1, where=np.isfinite(ranked), initial=1.0)[:, None]
    weight = np.maximum(1.0 - squared / background, 0.0)
    weight[squared > (1.0 + options.vote_tie) ** 2 * ranked[:, :1]] = 0.0
    weight /= max(float(weight[weight > 0.0].mean()) if (weight > 0.0).any() else 0.0, 1e-9)
    votes: list[_Votes] = []
    for i in range(len(reach)):
        given = (weight > 0.0) & (part == i)
        voted, vote = np.unique(rows[given], return_inverse=True)
        counted = np.zeros(len(voted))
        np.add.at(counted, vote, weight[given])
        votes.append((voted, counted))
    return votes


_Neighbours = tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]


def _nearest(reach: Sequence[_Reach], asked: NDArray[np.uint8], k: int) -> _Neighbours:
    """Of descriptors (n, 128) the k nearest points in reach of each index, best first.

    Areas of which most is in reach are searched by the index that they share. Of others, the points in reach
    get an index now: what lies elsewhere costs nothing.

    Returns:
        For each (n, m) where in `reach` it is, the row of the point in its area, and the squared distance;
        infinity where there are fewer.
    """
    groups: dict[int, list[int]] = {}
    for i, r in enumerate(reach):
        if len(r):
            groups.setdefault(id(r.indexed.index), []).append(i)
    if not groups:
        none = np.zeros((len(asked), 0), np.int64)
        return none, none, none.astype(np.float64)
    found = [_nearest_of(reach, np.array(group), asked, k) for group in groups.values()]
    part, row, squared = (np.concatenate([one[of] for one in found], axis=1) for of in range(3))
    return part, row, squared


def _nearest_of(
    reach: Sequence[_Reach], group: NDArray[np.int64], asked: NDArray[np.uint8], k: int
) -> _Neighbours:
    """As `_nearest`, for the areas (g,) that share an index and have points in reach."""
    index = reach[group[0]].indexed.index
    in_reach = sum(len(reach[i]) for i in group)
    shared = in_reach >= _MOST * len(index)
    if shared:
        first = np.array([reach[i].indexed.first for i in group])
        proposed = index.search(asked, _PROPOSED * k)
    else:
        codes = [reach[i].area.codes(reach[i].points) for i in group]
        first = np.cumsum([0, *(len(part) for part in codes[:-1])])
        proposed = DescriptorIndex.of(DescriptorCodes.joined(codes)).search(asked, _PROPOSED * k)
    order = np.argsort(first)
    place = order[np.maximum(np.searchsorted(first[order], proposed, side="right") - 1, 0)]
    row, squared = np.full(proposed.shape, -1, np.int64), np.full(proposed.shape, np.inf)
    # A shared index has areas, too, of which nothing is in reach: their rows are none of the one before.
    length = np.array([len(reach[i].area.points if shared else reach[i]) for i in group])
    own = proposed - first[place]
    asker, rank = np.nonzero((proposed >= 0) & (own >= 0) & (own < length[place]))
    by_area = np.argsort(place[asker, rank], kind="stable")
    asker, rank = asker[by_area], rank[by_area]
    ends = np.searchsorted(place[asker, rank], np.arange(len(group) + 1))
    for j in np.flatnonzero(np.diff(ends)):
        r = reach[group[j]]
        mine = slice(ends[j], ends[j + 1])
        at = asker[mine], rank[mine]
        points = own[at] if shared else r.points[own[at]].astype(np.int64)
        distance = squared_distances(asked, asker[mine], r.area.descriptors, points).astype(np.float64)
        if shared:
            distance[~r.has(points)] = np.inf
        row[at], squared[at] = points, distance
    best = np.argsort(squared, axis=1, kind="stable")[:, :k]
    return (
        group[np.take_along_axis(place, best, axis=1)],
        np.take_along_axis(row, best, axis=1),
        np.take_along_axis(squared, best, axis=1),
    )


def _image_scores(reach: _Reach, votes: _Votes, share: float) -> FloatArray:
    """(i,) votes of each of the area's images above what chance gives it, in standard deviations.

    Those out of reach have minus infinity.

    Args:
        share: votes per point over all that is in reach. An image that sees many points gets many votes by
            chance: p points get p times this, with about that variance.
    """
    area, images = reach.area, reach.images
    scores = np.full(len(area.image_map), -np.inf)
    of_image = area.sums_over_sights(*votes)[images]
    scores[images] = _above_chance(of_image, share * area.image_sights[images])
    return scores


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
