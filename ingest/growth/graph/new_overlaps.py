"""Which overlaps of grown maps have to be measured anew, and their measurements, kept in the work folder."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Snapshot
from featuredb.store.commits import write_time
from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.graph.map_graph import PlacedMap, StoredEdge
from ingest.growth.place.overlaps import Overlap, OverlapOptions, measure_overlap
from ingest.workspace import read_json, write_json

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewOverlaps:
    """New overlaps, by the grown map whose evidence will have them."""

    edges: dict[str, list[StoredEdge]]
    notes: tuple[str, ...]


def overlaps_to_measure(maps: Mapping[str, PlacedMap], gap_m: float) -> list[tuple[str, str]]:
    """Pairs of a grown map and a map that may hold it: parents placed anew, and anchors that came later."""
    pairs: set[tuple[str, str]] = set()
    anchors = [m for m in maps.values() if m.is_anchor and m.status == "active"]
    for me in maps.values():
        if me.is_anchor:
            continue
        places = {edge.map_id: edge.place for edge in me.edges}
        pairs |= {(me.map_id, m) for m, place in places.items() if m in maps and maps[m].place != place}
        for anchor in anchors:
            later = write_time(anchor.write_id) > write_time(me.write_id)
            if anchor.map_id not in places and later and _touch(me, anchor, gap_m):
                pairs.add((me.map_id, anchor.map_id))
    return sorted(pairs)


def _touch(a: PlacedMap, b: PlacedMap, gap_m: float) -> bool:
    if not len(a.corners) or not len(b.corners):
        return False
    other = a.frame.enu_from(b.frame).act(b.corners)
    low, high = a.corners.min(axis=0)[:2] - gap_m, a.corners.max(axis=0)[:2] + gap_m
    return bool((other.min(axis=0)[:2] <= high).all() and (low <= other.max(axis=0)[:2]).all())


def measure_new(
    snapshot: Snapshot,
    maps: Mapping[str, PlacedMap],
    wanted: list[tuple[str, str]],
    work: Path,
    options: OverlapOptions,
) -> NewOverlaps:
    loaded: dict[str, FeatureMap] = {}
    edges: dict[str, list[StoredEdge]] = {}
    notes: list[str] = []
    for map_id, other_id in wanted:
        key = digest(map_id, maps[map_id].place, other_id, maps[other_id].place, options_fingerprint(options))
        cache = work / "overlaps" / f"{key[:24]}.json"
        if cache.is_file():
            edge, note = _from_json(read_json(cache))
        else:
            for m in (map_id, other_id):
                loaded[m] = loaded.get(m) or snapshot.load_map(m)
            overlap = measure_overlap(loaded[map_id], loaded[other_id], options)
            edge, note = _edge(overlap, other_id, maps[other_id].place), overlap.message
            write_json(cache, {"edge": None if edge is None else edge.as_json(), "note": note})
        notes.append(f"{map_id} - {other_id}: {note}")
        if edge is not None:
            edges.setdefault(map_id, []).append(edge)
    _LOG.info("overlaps: %s", "; ".join(notes))
    return NewOverlaps(edges=edges, notes=tuple(notes))


def _edge(overlap: Overlap, other_id: str, place: str) -> StoredEdge | None:
    if overlap.other_from_map is None or overlap.covariance is None:
        return None
    return StoredEdge(
        map_id=other_id,
        place=place,
        other_from_map=overlap.other_from_map,
        covariance=overlap.covariance,
        shared_points=overlap.shared_points,
        photos=overlap.photos,
    )


def _from_json(value: Mapping[str, Any]) -> tuple[StoredEdge | None, str]:
    edge = value.get("edge")
    return None if edge is None else StoredEdge.from_json(edge), str(value.get("note", ""))
