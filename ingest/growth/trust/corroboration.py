"""Photos that look at a quarantined map from outside, localised in it alone: of other maps, and new ones."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store.candidates.states import OPERATOR
from ingest.growth.gates import SIGMAS
from ingest.growth.map_images import LEAST_FEATURES, MOST_IMAGES, NEAR_M, features_and_points
from ingest.growth.place.localised import in_frame, localise_each
from ingest.growth.place.overlaps import indexed_area, localise_image
from ingest.growth.trust.confirmation import CorroboratingImage, Source, Sources
from ingest.growth.values import FeaturesOf, LocalisedPhoto
from ingest.photos.photo import Photo
from ingest.sfm.pairs import Pair
from reloc.localise.candidates import IndexedArea

# A photo whose place is known contradicts the map if the map has it further away than that, and than `SIGMAS`
# standard deviations of both.
_LEAST_M = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPhotos:
    """New photos that may corroborate.

    Attributes:
        rows: of `photos` that may be asked.
        localised: those that the active maps localise, by row.
        heard: what photos said of maps before, by the map's write and row; None where they do not see it. A
            map is examined again whenever another one changes, and its own photos are the same.
        overlaps: pairs of `photos` that show the same, as their matches say; None: not known. Of a map that
            is made of `photos`, those are asked that overlap with one of its own.
    """

    photos: Sequence[Photo]
    rows: Sequence[int]
    features_of: FeaturesOf
    localised: dict[int, LocalisedPhoto]
    heard: dict[tuple[str, int], LocalisedPhoto | None] = field(default_factory=dict)
    overlaps: Collection[Pair] | None = None

    def that_may_see(self, feature_map: FeatureMap) -> list[int]:
        """Rows of those that may be asked about a map."""
        if self.overlaps is None:
            return list(self.rows)
        names = {image.sha256 for image in feature_map.images}
        own = {row for row, photo in enumerate(self.photos) if photo.sha256 in names}
        if len(own) < len(names):  # whose matches with these photos nobody has looked at
            return list(self.rows)
        beside = {j for i, j in self.overlaps if i in own} | {i for i, j in self.overlaps if j in own}
        return [row for row in self.rows if row in beside]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corroboration:
    """Photos from outside that see the map's points; sources of those that contradict it, with sentences."""

    corroborating: tuple[CorroboratingImage, ...]
    contradictions: tuple[tuple[Source, str], ...]


def corroborate(
    feature_map: FeatureMap,
    others: Sequence[FeatureMap],
    new: NewPhotos | None,
    sources: Sources,
    *,
    write_id: str,
    threads: int = 1,
) -> Corroboration:
    """Localise photos of other owners than the map's, whose word counts, in the map alone.

    Args:
        others: maps around it, active or quarantined.
        write_id: of the map as it is.
    """
    indexed = indexed_area(feature_map)
    if not len(indexed.area.points):
        return Corroboration(corroborating=(), contradictions=())
    own = set(sources.of_map(feature_map))
    names = {image.sha256 for image in feature_map.images}
    corroborating: list[CorroboratingImage] = []
    against: list[tuple[Source, str]] = []
    for other, image, source in _images_around(feature_map, others, own, sources):
        found = localise_image(other, image, 0, [indexed])
        if found is None or image.sha256 in names:
            continue
        found = in_frame(found, feature_map.frame)
        known = image.cam_from_local @ other.frame.enu_from(feature_map.frame)
        apart = float(np.linalg.norm(known.center - found.cam_from_local.center))
        spread = _spread(found) + _center_variance(other, image)
        what = f"{image.name} of map {other.map_id}"
        _sort_in(found, source, what, apart, spread, corroborating, against)
    if new is not None:
        _hear_new(feature_map, write_id, indexed, new, own, names, sources, threads, corroborating, against)
    return Corroboration(corroborating=tuple(corroborating), contradictions=tuple(against))


def _hear_new(
    feature_map: FeatureMap,
    write_id: str,
    indexed: IndexedArea,
    new: NewPhotos,
    own: set[Source],
    names: set[str],
    sources: Sources,
    threads: int,
    corroborating: list[CorroboratingImage],
    against: list[tuple[Source, str]],
) -> None:
    source_of = {
        row: sources.of_owner(new.photos[row].contributor or OPERATOR)
        for row in new.that_may_see(feature_map)
    }
    asked = [
        row
        for row, source in source_of.items()
        if new.photos[row].sha256 not in names and source.speaks_to(own)
    ]
    unheard = [row for row in asked if (write_id, row) not in new.heard]
    for row, said in localise_each(new.photos, unheard, new.features_of, [indexed], threads):
        new.heard[write_id, row] = said if isinstance(said, LocalisedPhoto) else None
    for row in asked:
        found = new.heard[write_id, row]
        if found is None:
            continue
        found = in_frame(found, feature_map.frame)
        apart, spread = 0.0, _spread(found)
        if row in new.localised:
            there = in_frame(new.localised[row], feature_map.frame)
            apart = float(np.linalg.norm(there.cam_from_local.center - found.cam_from_local.center))
            spread += _spread(there)
        _sort_in(found, source_of[row], new.photos[row].name, apart, spread, corroborating, against)


def _sort_in(
    found: LocalisedPhoto,
    source: Source,
    name: str,
    apart_m: float,
    variance: float,
    corroborating: list[CorroboratingImage],
    against: list[tuple[Source, str]],
) -> None:
    """A photo that the map has where it is known to be speaks for it, another one against it."""
    if apart_m > max(_LEAST_M, SIGMAS * float(np.sqrt(variance))):
        against.append((source, f"{name} is {apart_m:.2f} m from where the map has it"))
        return
    corroborating.append(
        CorroboratingImage(
            name=name,
            source=source,
            center=found.cam_from_local.center,
            points=np.unique(found.point_of),
        )
    )


def _spread(photo: LocalisedPhoto) -> float:
    """Largest variance of the camera's centre, with that of the maps' placements, square metres."""
    pose = photo.result.pose
    covariance = photo.covariance if pose is None else pose.covariance
    return float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])


def _center_variance(other: FeatureMap, image: MapImage) -> float:
    """Of a map image's centre on Earth, roughly: its own, and its map's placement."""
    own = 0.0 if image.covariance is None else float(np.trace(image.covariance[3:, 3:]))
    return own + float(np.linalg.eigvalsh(other.placement.covariance[4:, 4:])[-1])


def _images_around(
    feature_map: FeatureMap,
    others: Sequence[FeatureMap],
    own: set[Source],
    sources: Sources,
) -> list[tuple[FeatureMap, MapImage, Source]]:
    """Images of other maps whose owners' word counts, nearest to the map's cameras first."""
    centers = np.array([image.cam_from_local.center for image in feature_map.images])
    found: list[tuple[float, str, FeatureMap, MapImage, Source]] = []
    for other in others:
        if other.map_id == feature_map.map_id:
            continue
        here_from_other = feature_map.frame.enu_from(other.frame)
        for image, source in zip(other.images, sources.of_map(other), strict=True):
            if not source.speaks_to(own):
                continue
            center = here_from_other.act(image.cam_from_local.center)
            distance = float(np.linalg.norm(centers - center, axis=1).min())
            if distance <= NEAR_M + _reach(centers):
                found.append((distance, f"{other.map_id} {image.name}", other, image, source))
    chosen = []
    for _, _, other, image, source in sorted(found, key=lambda e: e[:2]):
        if len(features_and_points(other, image)[1]) >= LEAST_FEATURES:
            chosen.append((other, image, source))
        if len(chosen) == MOST_IMAGES:
            break
    return chosen


def _reach(centers: FloatArray) -> float:
    return 0.5 * float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0)))
