"""Which maps of a snapshot are exported, and what of them: by id, status, place, SQL and licence."""

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from featuredb.errors import ExportError, UnplacedMapError
from featuredb.geo.utm import geodetic_from_utm
from featuredb.maps.feature_map import FeatureMap, MapImage, MapStatus
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import AnyMap, MapKind, UnplacedMap, UnplacedStatus
from featuredb.store.database import Database
from featuredb.store.snapshot import MapSummary, Snapshot, UnplacedSummary
from featuredb.store.sql import SqlSession

_VERSION = re.compile(r"-v?\d+(\.\d+)*$")
_HELD = "(left out)"
_CANDIDATE_DIGITS = 32  # a contributed photo's id is the beginning of its hash


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What is exported; the default is every active map, whole.

    Attributes:
        maps: ids of maps, whatever their status; empty: all with one of `statuses`.
        bbox: west, south, east, north in WGS84 degrees; maps whose points' box touches it, whole. West may be
            larger than east, across the antimeridian.
        where: an SQL condition on the columns of the view `maps`, such as "images > 20"; "": none.
        licences: of photos; None: whatever they are. Photos with others are left out with all that they
            alone have contributed, see `licensed`.
    """

    maps: tuple[str, ...] = ()
    statuses: tuple[MapStatus | UnplacedStatus, ...] = ("active",)
    bbox: tuple[float, float, float, float] | None = None
    where: str = ""
    licences: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.bbox is not None:
            west, south, east, north = self.bbox
            if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90):
                raise ExportError(
                    "bbox: expected west,south,east,north in degrees with south < north, found "
                    f"{','.join(f'{v:g}' for v in self.bbox)}"
                )
        if self.licences is not None and not all(name.strip() for name in self.licences):
            raise ExportError(
                f"licences: expected names such as cc-by,cc0, found {','.join(self.licences)!r}"
            )


def selected_maps(database: Database, snapshot: Snapshot, selection: Selection) -> list[MapSummary]:
    """The maps that are meant, oldest first, where they need a place.

    Raises:
        ExportError: no map is; which condition left none; or one is asked for that has no place.
        StoreError: `where` is no condition. MapNotFoundError: an id that the snapshot does not have.
    """
    found = selected_any(database, snapshot, selection)
    asked = bool(selection.maps) or "unplaced" in selection.statuses
    try:
        placed = [snapshot.get(m.map_id) for m in found if asked or isinstance(m, MapSummary)]
    except UnplacedMapError as error:
        raise ExportError(f"{error}. Exports to {', '.join(KEEP_UNPLACED)} need none") from error
    _some(placed, "maps with a place")
    return placed


KEEP_UNPLACED = ("colmap", "ply")  # formats that have a frame of their own


def selected_any(
    database: Database, snapshot: Snapshot, selection: Selection
) -> list[MapSummary | UnplacedSummary]:
    """The maps that are meant, oldest first, with a place or without.

    Raises:
        ExportError: no map is; which condition left none. StoreError: `where` is no condition.
        MapNotFoundError: an id that the snapshot does not have.
    """
    there = snapshot.any_maps(include_retired=True)
    if selection.maps:
        wanted = {snapshot.find(start, include_retired=True).map_id for start in selection.maps}
        found = [m for m in there if m.map_id in wanted]
    else:
        found = [m for m in there if m.status in selection.statuses]
        _some(found, f"maps that are {' or '.join(selection.statuses)}")
    if selection.bbox is not None:
        box = selection.bbox
        found = [m for m in found if isinstance(m, MapSummary) and touches(m, box)]
        _some(found, f"maps in {','.join(f'{v:g}' for v in selection.bbox)} (west,south,east,north)")
    if selection.where:
        with SqlSession(snapshot, database) as session:
            rows = session.query(f"SELECT map_id FROM maps WHERE ({selection.where}\n)").rows  # read-only
            where = {row[0] for row in rows}
        found = [m for m in found if m.map_id in where]
        _some(found, f"maps with {selection.where}")
    return found


def exported(
    snapshot: Snapshot, maps: Iterable[MapSummary | UnplacedSummary], licences: tuple[str, ...] | None
) -> Iterator[AnyMap]:
    """The maps as they are exported, one in memory at a time.

    Maps of which no photo has one of the licences are left out.

    Raises:
        ExportError: none is left by its licence.
    """
    left = False
    for summary in maps:
        # The cast: either kind comes out as it goes in.
        part: AnyMap | None = licensed(cast("FeatureMap", snapshot.load_any(summary.map_id)), licences)
        if part is not None:
            left = True
            yield part
        del part  # or there would be two maps in memory while the next one is loaded
    if not left:
        raise ExportError(
            f"expected photos with a licence of {', '.join(licences or ())}, found none in the "
            'selected maps; `featuredb sql DB "select licence, count(*) from images group by 1"` lists them'
        )


def licence_of(image: MapImage, feature_map: AnyMap) -> str:
    """The photo's licence, or that of its whole map; "" where nobody has said."""
    return image.licence or feature_map.licence


def licence_is(licence: str, wanted: str) -> bool:
    """Whether a photo's licence is the wanted one: "cc-by" is also "CC BY 4.0", and not "CC-BY-SA-4.0"."""
    mine, theirs = _spelled(licence), _spelled(wanted)
    return bool(mine) and theirs in (mine, _VERSION.sub("", mine))


def licensed(feature_map: MapKind, licences: tuple[str, ...] | None) -> MapKind | None:
    """What the photos with these licences have contributed; None where that is nothing.

    Photos with other licences, or without, are left out, with their observations and descriptors, and with
    what evidence and provenance say of them by name. A point stays if two of the photos that are left see it:
    they could have made it alone.
    """
    if licences is None:
        return feature_map
    kept = [
        image.image_id
        for image in feature_map.images
        if any(licence_is(licence_of(image, feature_map), wanted) for wanted in licences)
    ]
    if not kept:
        return None
    left_out = len(feature_map.images) - len(kept)
    if not left_out:
        return feature_map
    note = {"licences": sorted(licences), "photos_left_out": left_out}
    part = only_images(feature_map, kept)
    gone = names_of(i for i in feature_map.images if i.image_id not in kept) - names_of(part.images)
    provenance = forget(feature_map.provenance, gone) | {"exported_by_licence": note}
    if isinstance(part, UnplacedMap):
        no_place = replace(part.no_place, evidence=forget(part.no_place.evidence, gone))
        return replace(part, no_place=no_place, provenance=provenance)
    evidence = forget(part.placement.evidence, gone)
    return replace(part, placement=replace(part.placement, evidence=evidence), provenance=provenance)


def _spelled(licence: str) -> str:
    return re.sub(r"[\s_-]+", "-", licence.strip().casefold())


def degrees_around(summary: MapSummary) -> tuple[float, float, float, float] | None:
    """West, south, east, north of the corners of a map's box in UTM; grid lines curve off by centimetres.

    None without points. Of a map across the antimeridian they are around the whole Earth.
    """
    box = summary.box
    if box is None:
        return None
    corners = [
        (e, n, 0.0) for e in (box.min_easting, box.max_easting) for n in (box.min_northing, box.max_northing)
    ]
    lat_lon = geodetic_from_utm(corners, summary.epsg)[:, :2]
    (south, west), (north, east) = lat_lon.min(axis=0).tolist(), lat_lon.max(axis=0).tolist()
    return west, south, east, north


def touches(summary: MapSummary, bbox: tuple[float, float, float, float]) -> bool:
    """Whether a map's box meets one of degrees, west, south, east, north."""
    around = degrees_around(summary)
    if around is None:
        return False
    (w, s, e, n), (west, south, east, north) = around, bbox
    if e - w > 180:  # the map lies across the antimeridian
        w, e = e, w
    return bool(s <= north and south <= n and _meet((w, e), (west, east)))


def _meet(a: tuple[float, float], b: tuple[float, float]) -> bool:
    """Whether two intervals of longitude meet that may cross the antimeridian."""

    def parts(west: float, east: float) -> list[tuple[float, float]]:
        return [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]

    return any(w <= e2 and w2 <= e for w, e in parts(*a) for w2, e2 in parts(*b))


def _some(found: Sequence[object], what: str) -> None:
    if not found:
        raise ExportError(f"expected {what}, found none; `featuredb maps DB --all` lists what there is")


def names_of(images: Iterable[MapImage]) -> frozenset[str]:
    """What photos are called in evidence: paths, file names, hashes, ids of contributed photos."""
    found: set[str] = set()
    for image in images:
        found |= {image.name, image.name.rsplit("/", 1)[-1], image.sha256, image.sha256[:_CANDIDATE_DIGITS]}
    return frozenset(found - {""})


def forget(value: Any, names: Collection[str]) -> Any:
    """A JSON value without what is said of some photos.

    Members that are called like one of them or that are one of these names are left out, and so is, from a
    list, an object that names one of them: it is about that photo. A name in the midst of a text is replaced.
    """
    if not names:
        return value
    longest_first = sorted(names, key=lambda name: (-len(name), name))
    within = re.compile(rf"(?<![\w/.-])(?:{'|'.join(map(re.escape, longest_first))})(?![\w-])")
    return _without(value, frozenset(names), within)


def _without(value: Any, names: frozenset[str], within: re.Pattern[str]) -> Any:
    if isinstance(value, dict):
        kept = {
            within.sub(_HELD, k): v for k, v in value.items() if k not in names and not _is_name(v, names)
        }
        return {key: _without(v, names, within) for key, v in kept.items()}
    if isinstance(value, list | tuple):
        return [_without(v, names, within) for v in value if not _about(v, names)]
    return within.sub(_HELD, value) if isinstance(value, str) else value


def _about(value: Any, names: frozenset[str]) -> bool:
    """Whether an element of a list is one of the photos, or tells of one."""
    if isinstance(value, dict):
        return any(_is_name(v, names) for v in value.values())
    return _is_name(value, names)


def _is_name(value: Any, names: frozenset[str]) -> bool:
    return isinstance(value, str) and value in names
