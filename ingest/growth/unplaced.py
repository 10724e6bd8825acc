"""Maps without a place are placed by the maps that show the same, as reconstructions of new photos are.

Their images are localised by what the map keeps of them. A map keeps its id, and what could not be taken
along stays a map without a place.
"""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from featuredb.errors import ConflictError
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import NoPlace, UnplacedMap
from featuredb.store import Database, Snapshot
from featuredb.store.snapshot import UnplacedSummary
from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.asked_before import recall, remember
from ingest.growth.graph.map_graph import grow_within_budget, placed_maps
from ingest.growth.growth_report import GrownEntry, grown_entry, refused_entry
from ingest.growth.place.component import GrownMap
from ingest.growth.place.localised import localise_photos
from ingest.growth.place.map_images import features_and_points, model_of, observed_rows
from ingest.growth.trust.scan_check import NOT_ASKED, checked_by_scan
from ingest.growth.values import LEAST_PHOTOS, GrowthOptions, GrowthPhotos, Refused
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures
from reloc.localise.candidates import IndexedArea

_LOG = logging.getLogger(__name__)


def place_unplaced_maps(
    database: Database, areas: Sequence[IndexedArea], work: Path, options: GrowthOptions
) -> tuple[list[GrownEntry], list[str]]:
    """Entries of all maps without a place, tried in the active areas, never asked twice; notes for people.

    Raises:
        StoreError: the database cannot be read or written; what is committed stands.
    """
    snapshot = database.snapshot()
    waiting = snapshot.unplaced_maps() if areas else []
    active = sorted({m.map_id for indexed in areas for m in indexed.area.maps})
    write_ids = sorted(snapshot.get(m).write_id for m in active) if waiting else []
    asks = options_fingerprint(replace(options, threads=1))
    tried: list[GrownEntry] = []
    notes: list[str] = []
    for summary in waiting:
        asked = digest(asks, summary.write_id, *write_ids)
        known = recall(work, "maps", summary.map_id, asked)
        if known is not None:
            tried.append(GrownEntry(**known))
            continue
        outcome = _place(database, snapshot, summary, areas, options, notes)
        if isinstance(outcome, FeatureMap):
            tried.append(grown_entry(outcome))
            continue
        tried.append(refused_entry(outcome, "unplaced", map_id=summary.map_id, points=summary.points))
        if outcome.reason not in ("CONFLICT", NOT_ASKED):
            remember(work, "maps", summary.map_id, asdict(tried[-1]), asked)
    return tried, notes


def _place(
    database: Database,
    snapshot: Snapshot,
    summary: UnplacedSummary,
    areas: Sequence[IndexedArea],
    options: GrowthOptions,
    notes: list[str],
) -> FeatureMap | Refused:
    """Place and commit one map; `notes` gets what a person should know besides."""
    unplaced = snapshot.load_unplaced(summary.map_id)
    grown = _grown(snapshot, unplaced, areas, options)
    if isinstance(grown, GrownMap):
        grown, note = checked_by_scan(database, grown)
        notes += [note] if note else []
    if isinstance(grown, Refused):
        return grown
    # Without descriptors where the map without a place had none: those are all zeros.
    seen = grown.feature_map.observations
    real = seen.has_descriptor & seen.descriptors.any(axis=1)
    feature_map = replace(grown.feature_map, observations=replace(seen, has_descriptor=real))
    said = Counter(grown.left_out.values()).most_common(1)
    code, why = said[0][0] if said else ("DRIFT_BUDGET", "they may be further off than the budget of drift")
    rest = left_over(unplaced, feature_map, by=", ".join(feature_map.parents), code=code, why=why)
    try:
        database.commit_maps(
            [feature_map, *rest],
            replaces=(summary.map_id,),
            based_on={summary.map_id: summary.write_id},
            reasons={part.map_id: summary.status_reason for part in rest},
        )
    except ConflictError as error:
        return Refused(reason="CONFLICT", message=str(error))
    _LOG.info("map %s: placed by %s", summary.map_id, ", ".join(feature_map.parents))
    return feature_map


def _grown(
    snapshot: Snapshot, unplaced: UnplacedMap, areas: Sequence[IndexedArea], options: GrowthOptions
) -> GrownMap | Refused:
    """The map where the others put it, by what it keeps of its photos."""
    named = ("map_id", "name", "source", "licence", "provenance")
    identity = MapIdentity(**{name: getattr(unplaced, name) for name in named})

    rows = [observed_rows(unplaced, image, described=False) for image in unplaced.images]

    def features_of(row: int, *, described: bool = False) -> PhotoFeatures:
        """Those that can be matched come first, so that they have the same rows alone."""
        own = rows[row]
        own = own[unplaced.observations.has_descriptor[own]] if described else own
        features, points = features_and_points(unplaced, unplaced.images[row], own)
        return PhotoFeatures(features=features, rgb=unplaced.points.rgb[points])

    photos = [_photo(unplaced, image) for image in unplaced.images]
    # A lens that nobody lends is about what the reconstruction made of it.
    hinted = [
        replace(photo, focal_px=unplaced.cameras[image.camera_id].focal_px)
        for photo, image in zip(photos, unplaced.images, strict=True)
    ]
    asked = GrowthPhotos(photos=hinted, features_of=partial(features_of, described=True))
    localised, _ = localise_photos(asked, range(len(hinted)), areas, options.threads)
    new = GrowthPhotos(photos=photos, features_of=features_of)
    model = model_of(unplaced, unplaced.images, described=False)
    maps, budget_m = placed_maps(snapshot), options.drift_budget_m
    return grow_within_budget(model, new, localised, areas, maps, budget_m, identity)


def left_over(
    unplaced: UnplacedMap, placed: FeatureMap, *, by: str, code: str, why: str
) -> list[UnplacedMap]:
    """What was not taken along, where it is a map still: a map without a place, under an id of its own.

    Args:
        by: what placed the others. code, why: of the reason why these were not placed.
    """
    taken = {image.name for image in placed.images}
    left = [image for image in unplaced.images if image.name not in taken]
    if len(left) < LEAST_PHOTOS:
        return []
    rest = only_images(unplaced, [image.image_id for image in left])
    if not len(rest.points):
        return []
    key = digest(unplaced.map_id, *sorted(image.sha256 or image.name for image in left))[:12]
    reason = f"left out when map {unplaced.map_id} was placed by {by}: {why}"
    no_place = NoPlace(reason_code=code, reason=reason, ways=unplaced.no_place.ways)
    name = f"{unplaced.name}, the rest"
    return [replace(rest, map_id=f"{unplaced.map_id}-{key}", name=name, no_place=no_place)]


def _photo(unplaced: UnplacedMap, image: MapImage) -> Photo:
    camera, keys = unplaced.cameras[image.camera_id], unplaced.camera_keys
    return Photo(
        path=Path(image.name),
        width=camera.width,
        height=camera.height,
        camera_key=keys[image.camera_id] if keys else "",
        **{n: getattr(image, n) for n in ("name", "sha256", "capture_time", "gps", "owner", "licence")},
    )
