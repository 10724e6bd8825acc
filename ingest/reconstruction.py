"""From usable photos to reconstructions: extract, pair, match, cluster, reconstruct.

Each step leaves its result in the work folder, under a key of what it was made of; a step that finds
its result there does nothing. What is in memory at a time does not grow with the photos but for tables of
a few hundred bytes each: features and models are read when they are needed.
"""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from featuredb.features.extractor import ExtractorOptions
from featuredb.index.vocabulary import shipped_vocabulary
from featuredb.stage_clock import StageClock
from ingest.clusters.graph import ClusterOptions, find_clusters
from ingest.clusters.reconstruct import Reconstruction, reconstruct_clusters
from ingest.executor import Executor, Progress, no_progress
from ingest.fingerprint import options_fingerprint
from ingest.map_builder import MapOptions
from ingest.photos.duplicates import copies_of
from ingest.photos.photo import CameraSharing, Photo, gps_priors, local_frame_of, photo_cameras
from ingest.sfm.extract import FeatureFiles, extract_photos, features_key, read_keypoints
from ingest.sfm.far_pairs import far_pairs
from ingest.sfm.mapper import SfmOptions, SfmView
from ingest.sfm.matching import Matched, PhotoView, match_pairs
from ingest.sfm.pair_geometry import MatchOptions
from ingest.sfm.pairs import Pair, PairOptions, aggregate_photos, choose_pairs, more_pairs
from ingest.sfm.zoomed_lenses import zoomed_keys
from ingest.workspace import Workspace

logger = logging.getLogger(__name__)

Stage = Literal["scan", "extract", "match", "reconstruct", "build", "commit"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMakingOptions:
    """Options of every step between photos and maps.

    Attributes:
        cameras: which photos share intrinsics (ingest.photos.photo).
        min_tie: points that two photos have in common if they tie the map together; what hangs on others by
            fewer is a map of its own, or in none. In a simulated community of 5,000 photos 58 of 70 that hung
            by fewer than 30 were wrong, 44 of 126 that hung by 30 to 49, and 324 of 4,261 others.
    """

    extractor: ExtractorOptions = field(default_factory=ExtractorOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    clusters: ClusterOptions = field(default_factory=ClusterOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    maps: MapOptions = field(default_factory=MapOptions)
    cameras: CameraSharing = "shared"
    min_tie: int = 30

    @property
    def fingerprint(self) -> str:
        """Digest of everything that a map depends on besides the photos."""
        return options_fingerprint(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstructed:
    """What came of the photos.

    Attributes:
        usable: photos whose features are there; all rows below are theirs.
        features: of each of them, read when asked for.
        reconstruction: models on disk.
        unreadable: photos by name whose pixels could not be read, with the reason.
        lost: photos by name whose tasks ended every worker that ran them, with the reason.
        copies: photos by name that show the picture of another owner's, with that one's name.
        features_per_photo: number of features by photo name.
        matched: pairs of rows, tried and verified; those of lost tasks count as not overlapping.
        matches_per_photo: verified matches by photo name, summed over its pairs.
    """

    usable: tuple[Photo, ...] = ()
    features: FeatureFiles = field(default_factory=lambda: FeatureFiles(()))
    reconstruction: Reconstruction = field(default_factory=Reconstruction)
    unreadable: dict[str, str] = field(default_factory=dict)
    lost: dict[str, str] = field(default_factory=dict)
    copies: dict[str, str] = field(default_factory=dict)
    features_per_photo: dict[str, int] = field(default_factory=dict)
    matched: Matched = field(default_factory=lambda: Matched(inliers={}, files={}))
    matches_per_photo: dict[str, int] = field(default_factory=dict)


def reconstruct_photos(
    photos: Sequence[Photo],
    workspace: Workspace,
    options: MapMakingOptions,
    executor: Executor,
    *,
    progress: Progress = no_progress,
    clock: StageClock | None = None,
    stop_after: Stage | None = None,
) -> Reconstructed:
    """Features, pairs, matches, clusters and models of photos.

    Args:
        photos: usable ones, in a fixed order.
        stop_after: end there; what is done is kept for the next run.
    """
    clock = clock or StageClock()
    with clock.stage("extract") as counts:
        unreadable, reused = extract_photos(list(photos), workspace, options.extractor, executor, progress)
        counts |= {"reused": reused, "total": len(photos)}
    usable = tuple(p for p in photos if p.name not in unreadable)
    fingerprint = features_key(options.extractor)
    features = FeatureFiles([workspace.features(fingerprint, p.sha256) for p in usable])
    done = Reconstructed(usable=usable, features=features, unreadable=unreadable)
    if stop_after == "extract":
        return done

    cameras, camera_rows = photo_cameras(usable, options.cameras, options.sfm.camera_model)
    views = [
        PhotoView(
            name=p.name, sha256=p.sha256, features=f, camera=cameras[row][0], focal_known=cameras[row][1]
        )
        for p, f, row in zip(usable, features.paths, camera_rows, strict=True)
    ]
    words = shipped_vocabulary()
    with clock.stage("pairs"):
        vectors = None
        if options.pairs.needs_vectors(len(usable)):
            most = options.pairs.features_per_photo
            vectors = aggregate_photos(features.paths, words, most, workspace, executor, progress)
        pairs = choose_pairs(usable, vectors, options.pairs)
    with clock.stage("match") as counts:
        matched = match_pairs(views, pairs, workspace, options.matching, executor, progress)
        more = more_pairs(len(usable), matched.inliers, pairs, options.pairs)
        if more:
            matched |= match_pairs(views, more, workspace, options.matching, executor, progress)
        counts |= {"reused": matched.reused, "total": len(matched.files)}
    copies = copies_of(usable, matched)
    matched = matched.without(copies.keys())
    far = far_pairs(usable, matched.inliers)
    if far:
        logger.info("%d pairs look alike and are too far apart by their positions", len(far))
        matched = matched.without(pairs=far)
    done = replace(
        done,
        copies={usable[row].name: usable[kept].name for row, kept in copies.items()},
        features_per_photo={
            p.name: len(read_keypoints(f)) for p, f in zip(usable, features.paths, strict=True)
        },
        matched=matched,
        matches_per_photo=_matches_per_photo(usable, matched.inliers),
    )
    if stop_after == "match":
        return done

    with clock.stage("reconstruct") as counts:
        made = _reconstruct(done, workspace, options, executor, progress)
        keys = zoomed_keys(made.models(), usable, features)
        if keys:
            logger.info("%d photos of shots whose lens zooms: they are reconstructed again", len(keys))
            usable = tuple(replace(p, camera_key=keys.get(p.name, p.camera_key)) for p in usable)
            done = replace(done, usable=usable)
            made = _reconstruct(done, workspace, options, executor, progress)
        counts |= {"reused": made.reused, "total": made.blocks}
    lost = {usable[row].name: reason for row, reason in made.lost.items()}
    return replace(done, reconstruction=made, lost=lost)


def _reconstruct(
    done: Reconstructed,
    workspace: Workspace,
    options: MapMakingOptions,
    executor: Executor,
    progress: Progress,
) -> Reconstruction:
    photos, matched, smallest = done.usable, done.matched, options.sfm.min_model_photos
    cameras, camera_rows = photo_cameras(photos, options.cameras, options.sfm.camera_model)
    clusters = find_clusters(len(photos), matched.inliers, smallest, options.clusters)
    views: list[SfmView] = [
        SfmView(name=photo.name, camera_row=row, features=path)
        for photo, row, path in zip(photos, camera_rows, done.features.paths, strict=True)
    ]
    for cluster in clusters:  # a frame for each: they may lie in different towns
        chosen = [photos[row] for row in cluster.rows]
        positions, sigmas = gps_priors(chosen, local_frame_of(chosen))
        for row, position, sigma in zip(cluster.rows, positions.tolist(), sigmas.tolist(), strict=True):
            if np.isfinite(sigma).all() and not photos[row].gps_is_hint:
                views[row] = replace(views[row], prior_position=tuple(position), prior_sigma_m=tuple(sigma))
    return reconstruct_clusters(
        clusters,
        cameras,
        views,
        {pair: matched.files[pair] for pair in matched.inliers},
        workspace,
        options.sfm,
        executor,
        progress,
    )


def _matches_per_photo(photos: Sequence[Photo], inliers: Mapping[Pair, int]) -> dict[str, int]:
    totals: Counter[str] = Counter(dict.fromkeys((p.name for p in photos), 0))
    for (i, j), count in inliers.items():
        totals[photos[i].name] += count
        totals[photos[j].name] += count
    return dict(totals)
