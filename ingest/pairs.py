"""Stage: which photos to match with which. The number of pairs grows linearly with that of photos."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.index.codebook import kmeans
from featuredb.index.nearest import nearest
from ingest.photo import Photo

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """How pairs are chosen.

    Attributes:
        exhaustive_max_photos: up to this many photos all pairs are matched. 24 photos have 276 pairs; the
            neighbourhoods below would choose about 24 * 12 of them anyway, and may miss one that matters.
        gps_neighbours: nearest photos by GPS, each photo. A block flight sees a point from some nine
            photos at 70 % overlap; twelve leaves room for GPS errors.
        gps_radius_m: no pair is chosen by GPS beyond this distance; oblique photos still overlap there.
        time_neighbours: following photos by capture time, each photo.
        retrieval_neighbours: most similar photos by aggregated descriptor, for photos without GPS.
        codebook_size: visual words of the aggregated descriptor.
        codebook_samples: descriptors that train it.
        features_per_photo: strongest features aggregated per photo.
        seed: of sampling and k-means.
    """

    exhaustive_max_photos: int = 24
    gps_neighbours: int = 12
    gps_radius_m: float = 300.0
    time_neighbours: int = 2
    retrieval_neighbours: int = 12
    codebook_size: int = 64
    codebook_samples: int = 100_000
    features_per_photo: int = 1000
    seed: int = 0


def choose_pairs(
    photos: Sequence[Photo], descriptors: Sequence[NDArray[np.uint8]], options: PairOptions
) -> list[Pair]:
    """Pairs (i, j), i < j, of rows of `photos`, sorted.

    Args:
        photos: usable photos.
        descriptors: of each photo, (n, 128) uint8, strongest first.
    """
    if len(photos) <= options.exhaustive_max_photos:
        return list(itertools.combinations(range(len(photos)), 2))
    pairs = set(_gps_pairs(photos, options)) | set(_time_pairs(photos, options))
    without_gps = [i for i, photo in enumerate(photos) if photo.gps is None]
    if without_gps:
        pairs |= set(_retrieval_pairs(without_gps, descriptors, options))
    return sorted(pairs)


def aggregate(descriptors: Sequence[NDArray[np.uint8]], options: PairOptions) -> FloatArray:
    """One vector of unit length per photo, (n, codebook_size * 128).

    VLAD with intra-normalisation (Jegou et al. 2010, Arandjelovic and Zisserman 2013) over a codebook
    trained on these very photos.
    """
    strongest = [d[: options.features_per_photo].astype(np.float32) for d in descriptors]
    everything = np.concatenate(strongest)
    generator = np.random.default_rng(options.seed)
    count = min(len(everything), options.codebook_samples)
    words = min(options.codebook_size, max(1, count // 40))  # k-means wants tens of samples a cluster
    samples = everything[np.sort(generator.choice(len(everything), count, replace=False))]
    codebook = kmeans(samples, words, options.seed)
    vectors = np.zeros((len(strongest), words * everything.shape[1]))
    half_norm = 0.5 * (codebook**2).sum(axis=1)
    for row, photo in enumerate(strongest):
        word = np.argmax(photo @ codebook.T - half_norm, axis=1) if len(photo) else np.zeros(0, int)
        residuals = np.zeros_like(codebook)
        np.add.at(residuals, word, photo - codebook[word])
        residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-12)
        vectors[row] = residuals.ravel() / max(float(np.linalg.norm(residuals)), 1e-12)
    return vectors


def _gps_pairs(photos: Sequence[Photo], options: PairOptions) -> Iterable[Pair]:
    """Each photo with its nearest ones on the ground plan, within the radius."""
    rows = [i for i, photo in enumerate(photos) if photo.gps is not None]
    if len(rows) < 2:
        return
    plan = gps_positions([photos[i] for i in rows])[:, :2]
    distances, neighbours = cKDTree(plan).query(
        plan, k=min(options.gps_neighbours + 1, len(rows)), distance_upper_bound=options.gps_radius_m
    )
    for i, (found, near) in enumerate(zip(np.atleast_2d(distances), np.atleast_2d(neighbours), strict=True)):
        for distance, j in zip(found, near, strict=True):
            if np.isfinite(distance) and j != i:
                yield _ordered(rows[i], rows[int(j)])


def gps_positions(photos: Sequence[Photo], frame: LocalFrame | None = None) -> FloatArray:
    """East, north, up (n, 3) in metres of photos with GPS; height 0 where the photo has none."""
    geodetic = np.array(
        [
            [p.gps.latitude_deg, p.gps.longitude_deg, p.gps.height_m or 0.0]
            for p in photos
            if p.gps is not None
        ]
    )
    if frame is None:
        frame = LocalFrame(latitude_deg=geodetic[0, 0], longitude_deg=geodetic[0, 1], height_m=0.0)
    return frame.enu_from_geodetic(geodetic)


def _time_pairs(photos: Sequence[Photo], options: PairOptions) -> Iterable[Pair]:
    """Each photo with those taken next. Without any time, by name: cameras number their files."""
    # Times with and without offset do not compare; the camera's own clock is what orders photos.
    timed = [
        (p.camera_key, p.capture_time.replace(tzinfo=None), p.name, i)
        for i, p in enumerate(photos)
        if p.capture_time is not None
    ]
    order = [i for *_, i in sorted(timed)]
    for place, i in enumerate(order):
        for j in order[place + 1 : place + 1 + options.time_neighbours]:
            yield _ordered(i, j)


def _retrieval_pairs(
    rows: Sequence[int], descriptors: Sequence[NDArray[np.uint8]], options: PairOptions
) -> Iterable[Pair]:
    """Each of the given photos with those whose aggregated descriptor is nearest."""
    vectors = aggregate(descriptors, options)
    count = min(options.retrieval_neighbours + 1, len(vectors))
    _, neighbours = nearest(vectors[list(rows)], vectors, count)
    for i, near in zip(rows, neighbours, strict=True):
        for j in near:
            if int(j) not in (i, -1):
                yield _ordered(i, int(j))


def _ordered(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)
