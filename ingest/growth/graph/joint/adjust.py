"""Maps that overlap, adjusted together.

Growth holds fixed what it stands on: a first map of six photos that is bent stays so, and what grew on it
bends along. Once more photos are there they know better. Here all of them have a say: points that are the
same in several maps are joined, and one bundle adjustment moves poses, points and lenses of all maps, but
those that are held. Ids, parents, overlaps and the uncertainty of every map stay, and so does the place of
the anchors among them, as a whole.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.anchored import AnchoredOptions, FixedPoints, Lenses, adjust_anchored
from ingest.colmap.bridge import Model
from ingest.growth.gates import SIGMAS
from ingest.growth.graph.joint.adjusted_map import AdjustedMap, adjusted_map, precision_of
from ingest.growth.graph.joint.joined import JoinedMaps, join_maps
from ingest.growth.graph.joint.judge import describe, placement_sigma_m, refusal
from ingest.growth.graph.joint.links import find_links
from ingest.growth.place.refine import in_metres
from ingest.growth.values import LEAST_SHARED_POINTS, tied_together

_AS_SURE = 2.0  # anchors up to so many times as uncertain as the surest hold the place of all


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointAdjustment:
    """Adjusted maps, or why there are none.

    Attributes:
        reason: None, or UNCONNECTED, PHOTO_LOST, RESIDUALS, OBSERVATIONS_LOST, ANCHOR_MOVED; `message` for
            people.
        maps: those that moved, new; empty where there is a reason. reports: of all, as far as it came.
        shared_points: points that more than one map has.
        elsewhere: photos that other maps have elsewhere than their own; they were not heard.
    """

    reason: str | None
    message: str
    maps: tuple[FeatureMap, ...] = ()
    reports: tuple[AdjustedMap, ...] = ()
    shared_points: int = 0
    elsewhere: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "reason": self.reason,
            "message": self.message,
            "maps": [report.as_json() for report in self.reports],
            "shared_points": self.shared_points,
            "elsewhere": list(self.elsewhere),
        }


def adjust_together(
    maps: Sequence[FeatureMap], held: Collection[str] = (), *, free: Collection[str] = ()
) -> JointAdjustment:
    """Adjust maps that overlap, all at once.

    Args:
        maps: of one extractor and height datum.
        held: ids of those whose photos, points and lenses stay; they are not among the new ones.
        free: anchors that may move further than their placement's uncertainty explains.

    Raises:
        InvalidValueError: fewer than two maps, or of different extractors or datums.
    """
    _check(maps, held)
    # What comes first lends the others its photos' poses, its lenses and points.
    maps = sorted(maps, key=lambda m: (m.map_id not in held, m.generation, -len(m.images), m.map_id))
    frame = maps[0].frame
    links = find_links(maps)
    joined = join_maps(maps, links, frame)
    shared = int(np.triu(joined.shared, 1).sum())
    alone = _unconnected(maps, joined.shared)
    if alone:
        return JointAdjustment(
            reason="UNCONNECTED",
            message=f"maps {', '.join(alone)} have fewer than {LEAST_SHARED_POINTS} points in common "
            f"with the others; {links.heard} photos were found in other maps"
            + (
                f", {len(links.elsewhere)} others {links.elsewhere_m:,.0f} m from where their own map has "
                "them: the positions of one of the maps are wrong, or the places look alike"
                if links.elsewhere
                else ""
            ),
            shared_points=shared,
            elsewhere=links.elsewhere,
        )
    kept = [a for a, m in enumerate(maps) if m.map_id in held]
    constant = _photos_of(joined, kept)
    result = adjust_anchored(
        joined.model,
        joined.keypoints,
        FixedPoints.none(),
        Lenses(held=np.unique(joined.model.camera_of[constant]).tolist(), focal_px=joined.known_focal_px),
        AnchoredOptions(),
        held_photos=constant.tolist(),
        held_points=np.unique(
            np.concatenate([np.zeros(0, np.int64), *(joined.maps[a].point_of for a in kept)])
        ).tolist(),
    )
    if not len(constant):
        result = replace(result, model=in_metres(result.model, _back(maps, joined, result.model)))
    reports = describe(maps, held, joined, result, frame)
    reason, message = refusal(maps, free, joined, result.model, reports)
    adjusted: list[FeatureMap] = []
    if reason is None:
        precision = precision_of(joined, result.model)
        adjusted = [
            adjusted_map(feature_map, joined.maps[a], result, precision, frame, maps, reports[a])
            for a, feature_map in enumerate(maps)
            if feature_map.map_id not in held
        ]
    return JointAdjustment(
        reason=reason,
        message=message,
        maps=tuple(adjusted),
        reports=tuple(reports),
        shared_points=shared,
        elsewhere=links.elsewhere,
    )


def _photos_of(joined: JoinedMaps, maps: Sequence[int]) -> NDArray[np.int64]:
    """Rows of the photos of some maps."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(joined.maps[a].photos for a in maps)]))


def _check(maps: Sequence[FeatureMap], held: Collection[str]) -> None:
    if len(maps) < 2:
        raise InvalidValueError(f"adjust_together: expected at least two maps, found {len(maps)}")
    if len({m.map_id for m in maps}) != len(maps):
        raise InvalidValueError("adjust_together: a map is named twice")
    for what, values in (
        ("extractor", {m.extractor_fingerprint for m in maps}),
        ("height datum", {m.height_datum for m in maps}),
    ):
        if len(values) > 1:
            raise InvalidValueError(f"adjust_together: expected one {what}, found {sorted(values)}")
    if all(m.map_id in held for m in maps):
        raise InvalidValueError("adjust_together: all maps are held, nothing could move")


def _unconnected(maps: Sequence[FeatureMap], shared: NDArray[np.int64]) -> list[str]:
    """Maps outside the largest group of maps with enough points in common."""
    groups = tied_together(range(len(maps)), zip(*np.nonzero(shared >= LEAST_SHARED_POINTS), strict=True))
    largest = int(np.argmax(np.bincount(groups)))
    return [m.map_id for m, group in zip(maps, groups, strict=True) if group != largest]


def _back(maps: Sequence[FeatureMap], joined: JoinedMaps, adjusted: Model) -> Sim3:
    """The similarity that takes the photos of the surest anchors back to their places as a whole.

    Robust: the photo that the adjustment moved against the others is not what should hold them.
    """
    lowest = min(m.generation for m in maps)
    sigma = [placement_sigma_m(m) if m.generation == lowest else np.inf for m in maps]
    rows = _photos_of(joined, [a for a in range(len(maps)) if sigma[a] <= _AS_SURE * min(sigma)])
    source, target = _reach(adjusted, rows), _reach(joined.model, rows)
    weights = np.ones(len(source), dtype=np.bool_)
    best = Sim3.identity()
    for _ in range(5):
        found = similarity_closed_form(source[weights], target[weights])
        if found is None:
            break
        best = found
        off = np.linalg.norm(best.act(source) - target, axis=1)
        weights = off <= SIGMAS * max(float(np.median(off)), 1e-9)
    return best


def _reach(model: Model, rows: NDArray[np.int64]) -> FloatArray:
    """Centres of photos and points one median viewing distance before them: a place and a direction each."""
    distance = 0.0
    if len(model.xyz):
        offsets = model.xyz[model.point_of] - model.centers()[model.photo_of]
        distance = float(np.median(np.linalg.norm(offsets, axis=1)))
    centers = model.centers()[rows]
    axes = np.array([model.cam_from_sfm[r].rotation for r in rows.tolist()])
    return np.concatenate([centers, *(centers + distance * axes[:, k] for k in range(3))])
