"""`featuredb lineage`: which map stands on which, how far from its anchors, and why some do not count."""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import add_as_of_argument, add_command, open_database, write_json
from featuredb.maps.lineage import MapLineage, describe_lineage, family_of

if TYPE_CHECKING:
    from featuredb.store import MapSummary, Snapshot

_OF_SUMMARY = ("name", "status", "status_reason", "method", "generation", "parents")


def register(subparsers: Any) -> None:
    parser = add_command(
        subparsers,
        "lineage",
        run_lineage,
        "draw which map placed which",
        description="Draw the tree of maps: which one placed which, how many steps each is from its anchor, "
        "its drift and the drift budget (95 %), and why some are not active.",
    )
    parser.add_argument(
        "map_id", metavar="MAP", nargs="?", help="only this map, its ancestors and its descendants"
    )
    parser.add_argument("--all", action="store_true", help="retired maps, too (with MAP they always show)")
    add_as_of_argument(parser)
    parser.add_argument("--json", action="store_true", help="as JSON")


def run_lineage(args: argparse.Namespace) -> None:
    snapshot = open_database(args).snapshot(args.as_of)
    lineages = snapshot.lineages()
    named = None if args.map_id is None else snapshot.find(args.map_id, include_retired=True).map_id
    maps = _wanted(snapshot, named, include_retired=args.all)
    if args.json:
        told = [
            {name: getattr(summary, name) for name in _OF_SUMMARY}
            | {"steps": lineages[map_id].steps, **asdict(lineages[map_id])}
            for map_id, summary in maps.items()
        ]
        write_json({"snapshot": snapshot.version, "maps": told})
    else:
        sys.stdout.writelines(f"{line}\n" for line in draw_tree(maps, lineages, named))


def draw_tree(
    maps: Mapping[str, "MapSummary"], lineages: Mapping[str, MapLineage], marked: str | None = None
) -> Iterator[str]:
    """Lines of ASCII: each map once, under the parent on its shortest chain to an anchor.

    Args:
        lineages: of at least these maps.
        marked: a map that gets an asterisk.
    """
    # Chains lead to anchors, so nothing can be drawn under itself.
    chains = {map_id: lineages[map_id].chain for map_id in maps}
    parent_of = {m: chain[1] if len(chain) > 1 and chain[1] in maps else None for m, chain in chains.items()}
    children: dict[str, list[str]] = {}
    for map_id, parent in parent_of.items():
        if parent is not None:
            children.setdefault(parent, []).append(map_id)
    roots = [map_id for map_id, parent in parent_of.items() if parent is None]
    stack = [(map_id, "", "") for map_id in reversed(roots)]
    while stack:
        map_id, lead, under = stack.pop()
        star = "* " if map_id == marked else ""
        yield f"{lead}{star}{_line(maps[map_id], lineages[map_id], parent_of[map_id])}"
        below = children.get(map_id, [])
        for child in reversed(below):
            last = child == below[-1]
            stack.append((child, under + ("`- " if last else "|- "), under + ("   " if last else "|  ")))


def _wanted(snapshot: "Snapshot", map_id: str | None, *, include_retired: bool) -> "dict[str, MapSummary]":
    every = {m.map_id: m for m in snapshot.maps(include_retired=True)}
    if map_id is not None:
        family = family_of(snapshot.get(map_id).map_id, every)
        return {m: summary for m, summary in every.items() if m in family}
    return {m: summary for m, summary in every.items() if include_retired or summary.status != "retired"}


def _line(summary: "MapSummary", lineage: MapLineage, drawn_under: str | None) -> str:
    parts = [f"{summary.map_id}  {summary.name}", f"{summary.method}, generation {summary.generation}"]
    parts.append(describe_lineage(lineage))
    others = [parent for parent in dict.fromkeys(summary.parents) if parent != drawn_under]
    if others:
        parts.append(f"{'also ' if drawn_under else ''}from {', '.join(others)}")
    if summary.status != "active":
        parts.append(summary.status + (f": {summary.status_reason}" if summary.status_reason else ""))
    return "; ".join(parts)
