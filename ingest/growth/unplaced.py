"""Maps without a place are placed by the maps that show the same, behind the gates of growth.

Such a map is a reconstruction like any other: its images are localised by what the map keeps of them, the
similarity that they agree upon is refined with the existing points held fixed, and gates ask whether to
believe it. It keeps its id, and what could not be taken along stays a map without a place.
"""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from featuredb.errors import ConflictError
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import NoPlace, UnplacedMap
from featuredb.store import Database, Snapshot
from featuredb.store.snapshot import UnplacedSummary
from ingest.colmap.bridge import Model
from ingest.fingerprint import digest, options_fingerprint
from ingest.growth.graph.budget import grow_within_budget
from ingest.growth.graph.map_graph import placed_maps
from ingest.growth.growth_report import GrownEntry
from ingest.growth.map_images import observed_features
from ingest.growth.place.component import GrowOptions, grow_component
from ingest.growth.place.localised import LocaliseEachOptions, localise_photos
from ingest.growth.run_record import grown_entry
from ingest.growth.trust.examined import recall, remember
from ingest.growth.trust.scan_check import ScanCheckOptions, scan_gate, with_gate
from ingest.growth.values import GrownMap, Refused
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures
from reloc.localise.candidates import IndexedArea

_LOG = logging.getLogger(__name__)
_LEAST_PHOTOS = 3  # of a map without a place, as of any reconstruction


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceUnplacedOptions:
    """The steps of growth as maps without a place go through them; see `GrowthOptions`."""

    drift_budget_m: float
    localise: LocaliseEachOptions = field(default_factory=LocaliseEachOptions)
    grow: GrowOptions = field(default_factory=GrowOptions)
    scan: ScanCheckOptions = field(default_factory=ScanCheckOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """What became of the maps without a place.

    Attributes:
        placed: entries of those that have one now, in quarantine like all that growth makes.
        unplaced: entries of those that have none still, with the reason.
        notes: for people.
    """

    placed: tuple[GrownEntry, ...] = ()
    unplaced: tuple[GrownEntry, ...] = ()
    notes: tuple[str, ...] = ()


def place_unplaced_maps(
    database: Database, areas: Sequence[IndexedArea], work: Path, options: PlaceUnplacedOptions
) -> Placed:
    """Try every map without a place; a question that was answered before is not asked again.

    Args:
        areas: of the active maps.

    Raises:
        StoreError: the database cannot be read or written; what is committed stands.
    """
    snapshot = database.snapshot()
    waiting = snapshot.unplaced_maps() if areas else []
    active = sorted({m.map_id for indexed in areas for m in indexed.area.maps})
    write_ids = [snapshot.get(m).write_id for m in active] if waiting else []
    asks = options_fingerprint(replace(options, localise=replace(options.localise, threads=1)))
    placed: list[GrownEntry] = []
    unplaced: list[GrownEntry] = []
    notes: list[str] = []
    for summary in waiting:
        asked = digest(asks, summary.write_id, *sorted(write_ids))
        known = recall(work, summary.map_id, asked)
        if known is not None:
            code, reason, gates = known
            refused = Refused(reason=code, message=reason, rows=(), gates=gates)
        else:
            done = _place(database, snapshot, summary, areas, options, notes)
            if isinstance(done, GrownEntry):
                placed.append(done)
                continue
            refused = done
            if refused.reason != "CONFLICT":
                remember(work, summary.map_id, asked, refused.reason, refused.message, refused.gates)
        unplaced.append(_unplaced_entry(summary, refused))
    return Placed(placed=tuple(placed), unplaced=tuple(unplaced), notes=tuple(dict.fromkeys(notes)))


def _place(
    database: Database,
    snapshot: Snapshot,
    summary: UnplacedSummary,
    areas: Sequence[IndexedArea],
    options: PlaceUnplacedOptions,
    notes: list[str],
) -> GrownEntry | Refused:
    """Place and commit one map; `notes` gets what a person should know besides."""
    unplaced = snapshot.load_unplaced(summary.map_id)
    grown = _within_budget(snapshot, unplaced, areas, options)
    if isinstance(grown, Refused):
        return grown
    feature_map = grown.feature_map
    scan, unasked = scan_gate(database, feature_map, options.scan)
    notes += [unasked] if unasked else []
    if scan is not None:
        feature_map = with_gate(feature_map, scan)
        if not scan.passes:
            gates = (*grown.placement.gates, scan)
            return Refused(reason=scan.reason, message=scan.message, rows=(), gates=gates)
    rest = left_over(unplaced, feature_map, grown.left_out)
    try:
        database.commit_maps(
            [feature_map, *rest],
            replaces=(summary.map_id,),
            based_on={summary.map_id: summary.write_id},
            reasons={part.map_id: summary.status_reason for part in rest},
        )
    except ConflictError as error:
        return Refused(reason="CONFLICT", message=str(error), rows=())
    _LOG.info("map %s: placed by %s", summary.map_id, ", ".join(feature_map.parents))
    names = tuple(image.name for image in feature_map.images)
    return grown_entry(feature_map, grown, names, "quarantined", "", "")


def _within_budget(
    snapshot: Snapshot, unplaced: UnplacedMap, areas: Sequence[IndexedArea], options: PlaceUnplacedOptions
) -> GrownMap | Refused:
    """The map where the others put it; where it reaches beyond the drift budget, the part that does not."""
    stored = stored_photos(unplaced)
    # A lens that nobody lends is about what the reconstruction made of it.
    hinted = [
        replace(photo, focal_px=unplaced.cameras[image.camera_id].focal_px)
        for photo, image in zip(stored.photos, unplaced.images, strict=True)
    ]
    localised, _ = localise_photos(hinted, range(len(hinted)), stored.described_of, areas, options.localise)

    def grown(part: Model) -> GrownMap | Refused:
        found = grow_component(
            part, stored.photos, stored.features_of, localised, areas, _identity(unplaced), options.grow
        )
        if isinstance(found, Refused):
            return found
        return replace(found, feature_map=_matchable(found.feature_map))

    return grow_within_budget(stored.model, grown, placed_maps(snapshot), options.drift_budget_m)


def _identity(unplaced: UnplacedMap) -> MapIdentity:
    return MapIdentity(
        map_id=unplaced.map_id,
        name=unplaced.name,
        source=unplaced.source,
        licence=unplaced.licence,
        provenance=unplaced.provenance,
    )


def _matchable(feature_map: FeatureMap) -> FeatureMap:
    """The map without descriptors where the map without a place had none: those are all zeros."""
    seen = feature_map.observations
    real = seen.has_descriptor & seen.descriptors.any(axis=1)
    return replace(feature_map, observations=replace(seen, has_descriptor=real))


def left_over(
    unplaced: UnplacedMap, placed: FeatureMap, left_out: Mapping[int, tuple[str, str]]
) -> list[UnplacedMap]:
    """What was not taken along, where it is a map still: a map without a place, under an id of its own.

    Args:
        left_out: why photos of the map, by row, are not in the placed one: code and message.
    """
    taken = {image.name for image in placed.images}
    left = [image for image in unplaced.images if image.name not in taken]
    if len(left) < _LEAST_PHOTOS:
        return []
    rest = only_images(unplaced, [image.image_id for image in left])
    if not len(rest.points):
        return []
    said = Counter(left_out.values()).most_common(1)
    code, why = said[0][0] if said else ("DRIFT_BUDGET", "they may be further off than the budget of drift")
    reason = f"left out when map {unplaced.map_id} was placed by {', '.join(placed.parents)}: {why}"
    key = digest(unplaced.map_id, *sorted(image.sha256 or image.name for image in left))[:12]
    return [
        replace(
            rest,
            map_id=f"{unplaced.map_id}-{key}",
            name=f"{unplaced.name}, the rest",
            no_place=NoPlace(reason_code=code, reason=reason, ways=unplaced.no_place.ways),
        )
    ]


def _unplaced_entry(summary: UnplacedSummary, refused: Refused) -> GrownEntry:
    return GrownEntry(
        map_id=summary.map_id,
        status="unplaced",
        reason_code=refused.reason,
        reason=refused.message,
        photos=(),
        points=summary.points,
        gates=refused.figures(),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredPhotos:
    """Images of a map as photos; one row each, in the map's order.

    Attributes:
        model: the map's reconstruction, in its own frame; keypoints are rows of the features.
        features: of every observation; those with a descriptor first, the largest of them first.
        described: (k,) how many of each image's features have a descriptor.
    """

    photos: tuple[Photo, ...]
    model: Model
    features: tuple[PhotoFeatures, ...]
    described: tuple[int, ...]

    def features_of(self, row: int) -> PhotoFeatures:
        """All features of an image."""
        return self.features[row]

    def described_of(self, row: int) -> PhotoFeatures:
        """Those that can be matched; they have the same rows."""
        rows = np.arange(self.described[row])
        whole = self.features[row]
        return PhotoFeatures(features=whole.features.take(rows), rgb=whole.rgb[rows])


def stored_photos(unplaced: UnplacedMap) -> StoredPhotos:
    """The images of a map, as if they were new."""
    seen = unplaced.observations
    features, described, point_of, photo_of, keypoint_of = [], [], [], [], []
    for row, image in enumerate(unplaced.images):
        rows = np.flatnonzero(seen.image_id == image.image_id)
        rows = rows[np.lexsort((-seen.scale[rows], ~seen.has_descriptor[rows]))]
        rgb = unplaced.points.rgb[unplaced.observations.point_index[rows]]
        features.append(PhotoFeatures(features=observed_features(unplaced, image, rows), rgb=rgb))
        described.append(int(seen.has_descriptor[rows].sum()))
        point_of.append(seen.point_index[rows])
        photo_of.append(np.full(len(rows), row, dtype=np.int64))
        keypoint_of.append(np.arange(len(rows), dtype=np.int64))
    points, photos, keypoints = (np.concatenate(parts) for parts in (point_of, photo_of, keypoint_of))
    order = np.lexsort((photos, points))
    model = Model(
        cameras=unplaced.cameras,
        rows=np.arange(len(unplaced.images), dtype=np.int64),
        camera_of=np.array([image.camera_id for image in unplaced.images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in unplaced.images),
        xyz=unplaced.points.xyz,
        point_of=points[order].astype(np.int64),
        photo_of=photos[order],
        keypoint_of=keypoints[order],
    )
    return StoredPhotos(
        photos=tuple(_photo(unplaced, image) for image in unplaced.images),
        model=model,
        features=tuple(features),
        described=tuple(described),
    )


def _photo(unplaced: UnplacedMap, image: MapImage) -> Photo:
    camera = unplaced.cameras[image.camera_id]
    keys = unplaced.camera_keys
    return Photo(
        name=image.name,
        path=Path(image.name),
        sha256=image.sha256,
        width=camera.width,
        height=camera.height,
        camera_key=keys[image.camera_id] if keys else "",
        capture_time=image.capture_time,
        gps=image.gps,
        owner=image.owner,
        licence=image.licence,
    )
