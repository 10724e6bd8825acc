"""Maps that overlap, adjusted together, and committed in one commit.

Growth holds fixed what it stands on: a first map of six photos that is bent stays so, and what grew on it
bends along. Once more photos are there they know better. Here all of them have a say: points that are the
same in several maps are joined, and one bundle adjustment moves poses, points and lenses of all maps, but
those that are held. Ids, parents, overlaps and the uncertainty of every map stay, and so does the place of
the anchors among them, as a whole.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database, MapSummary, Snapshot
from ingest.colmap.anchored import AnchoredOptions, FixedPoints, Lenses, adjust_anchored
from ingest.colmap.bridge import Model
from ingest.growth.gates import SIGMAS
from ingest.growth.graph.joint.adjusted_map import (
    AdjustedMap,
    adjusted_maps,
    describe,
    placement_sigma_m,
    refusal,
)
from ingest.growth.graph.joint.joined import JoinedMaps, find_links, join_maps
from ingest.growth.graph.map_graph import place_of
from ingest.growth.graph.replacing import ask_persons_canaries
from ingest.growth.map_places import growth_of, with_growth
from ingest.growth.place.refine import in_metres
from ingest.growth.values import LEAST_SHARED_POINTS, Edge, tied_together

_MEASURED = ("lidar", "gcp")  # their places were measured by more than photos
_AS_SURE = 2.0  # anchors up to so many times as uncertain as the surest hold the place of all


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointAdjustment:
    """Adjusted maps, or why there are none.

    Attributes:
        reason: None, or UNCONNECTED, PHOTO_LOST, RESIDUALS, OBSERVATIONS_LOST, ANCHOR_MOVED, CANARY; nothing
            was committed where there is one. `message` for people.
        maps: those that moved, new; empty where the adjustment itself is refused.
        reports: of all maps, as far as it came.
        shared_points: points that more than one map has.
        elsewhere: photos that other maps have elsewhere than their own; they were not heard.
        version: of the database since; -1 where nothing was committed.
        descendants: maps that joined because they hang on those that were named.
        flagged: maps that are quarantined now, because they hang on a moved one and could not join.
    """

    reason: str | None
    message: str
    maps: tuple[FeatureMap, ...] = ()
    reports: tuple[AdjustedMap, ...] = ()
    shared_points: int = 0
    elsewhere: tuple[str, ...] = ()
    version: int = -1
    descendants: tuple[str, ...] = ()
    flagged: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        told = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "reports"}
        return {**told, "maps": [report.as_json() for report in self.reports]}


def adjust_maps(
    database: Database, named: Sequence[str], *, free: Collection[str] = (), dry_run: bool = False
) -> JointAdjustment:
    """Adjust active maps together, with all active maps that hang on them, held by the parents of them all.

    Args:
        named: ids or their first letters.
        free: anchors, likewise, that may move although LiDAR or control points placed them; others are held.

    Raises:
        InvalidValueError: fewer than two maps, one that is not active, several extractors or datums.
        ConflictError: someone else changed one of the maps meanwhile; nothing has changed.
        MapNotFoundError: no live map of that id, or several that begin so.
        StoreError
    """
    snapshot = database.snapshot()
    live = {m.map_id: m for m in snapshot.maps()}
    active = {name: m for name, m in live.items() if m.status == "active"}
    chosen = [_active(snapshot, name) for name in named]
    wanted = [m for m in _with_descendants(live, chosen) if m in active]
    free_ids = {_active(snapshot, name) for name in free}
    held = {m for m in wanted if active[m].method in _MEASURED and not active[m].parents} - free_ids
    # Parents that are not named hold their children, too: else these would drift away from them.
    parents = sorted({p for m in wanted for p in active[m].parents if p in active} - set(wanted))
    held |= set(parents)
    maps = [snapshot.load_map(m) for m in (*parents, *wanted)]
    found = adjust_together(maps, held, free=free_ids)
    found = replace(found, descendants=tuple(m for m in wanted if m not in chosen))
    if found.reason is not None:
        return found
    new = _with_overlaps(found.maps, [m for m in maps if m.map_id in held])
    canaries = ask_persons_canaries(database, {m.map_id: m for m in new})
    if canaries.regressions:
        return replace(found, reason="CANARY", message=f"nothing is moved: {canaries.message}")
    if dry_run:
        return found
    ids = [m.map_id for m in new]
    results = database.commit_maps(new, replaces=ids, based_on={m: active[m].write_id for m in ids})
    flagged = tuple(sorted({m for result in results for m in result.flagged}))
    return replace(found, version=max(result.version for result in results), flagged=flagged)


def _active(snapshot: Snapshot, name: str) -> str:
    found = snapshot.find(name)
    if found.status != "active":
        raise InvalidValueError(f"expected an active map, found {found.map_id}, which is {found.status}")
    return found.map_id


def _with_descendants(live: Mapping[str, MapSummary], chosen: Sequence[str]) -> list[str]:
    """The maps and what hangs on them, by generation: a child left behind would hang where nothing is."""
    wanted = set(chosen)
    while more := {m for m, e in live.items() if m not in wanted and wanted & set(e.parents)}:
        wanted |= more
    return sorted(wanted, key=lambda m: (live[m].generation, -live[m].images, m))


def _with_overlaps(maps: Sequence[FeatureMap], held: Sequence[FeatureMap]) -> list[FeatureMap]:
    """The maps with what growth has measured between them and the held ones as it is now: they agree.

    Overlaps with others are forgotten, until they are measured again.
    """
    places = {m.map_id: place_of(m) for m in (*maps, *held)}
    new = []
    for feature_map in maps:
        known = growth_of(feature_map.placement.evidence).get("edges")
        if known is None:
            new.append(feature_map)
            continue
        edges = [
            replace(e, place=places[e.map_id], other_from_map=Sim3.identity())
            if e.map_id in places
            else replace(e, place="")
            for e in map(Edge.from_json, known)
        ]
        new.append(with_growth(feature_map, edges=[e.as_json() for e in edges]))
    return new


def adjust_together(
    maps: Sequence[FeatureMap], held: Collection[str] = (), *, free: Collection[str] = ()
) -> JointAdjustment:
    """Adjust maps that overlap, all at once; nothing is committed.

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
    links = find_links(maps)
    joined = join_maps(maps, links)
    told = JointAdjustment(
        reason="UNCONNECTED",
        message="",
        shared_points=int(np.triu(joined.shared, 1).sum()),
        elsewhere=links.elsewhere,
    )
    alone = _unconnected(maps, joined.shared)
    if alone:
        text = (
            f"maps {', '.join(alone)} have fewer than {LEAST_SHARED_POINTS} points in common "
            f"with the others; {links.heard} photos were found in other maps"
        )
        if links.elsewhere:
            text += (
                f", {len(links.elsewhere)} others {links.elsewhere_m:,.0f} m from where their own map has "
                "them: the positions of one of the maps are wrong, or the places look alike"
            )
        return replace(told, message=text)
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
    reports = describe(maps, held, joined, result)
    reason, message = refusal(maps, free, joined, result.model, reports)
    told = replace(told, reason=reason, message=message, reports=tuple(reports))
    if reason is not None:
        return told
    return replace(told, maps=adjusted_maps(maps, joined, result, reports))


def _photos_of(joined: JoinedMaps, maps: Sequence[int]) -> NDArray[np.int64]:
    """Rows of the photos of some maps."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(joined.maps[a].photos for a in maps)]))


def _check(maps: Sequence[FeatureMap], held: Collection[str]) -> None:
    if len(maps) < 2:
        raise InvalidValueError(f"adjust_together: expected at least two maps, found {len(maps)}")
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
