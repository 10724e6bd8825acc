"""Photos that look at a quarantined map from outside, localised in it alone: of other maps, and new ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store.candidates.states import OPERATOR
from ingest.growth.gates import SIGMAS
from ingest.growth.place.localised import in_frame, localise_photos
from ingest.growth.place.map_images import (
    LEAST_FEATURES,
    MOST_IMAGES,
    NEAR_M,
    features_and_points,
    localise_image,
)
from ingest.growth.trust.confirmation import OutsidePhoto, Source, Sources
from ingest.growth.values import DRIFT_BUDGET_M, GrowthPhotos, LocalisedPhoto
from reloc.localise.candidates import IndexedArea


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPhotos:
    """New photos that may corroborate.

    Attributes:
        rows: of the given photos that may be asked.
        localised: those that the active maps localise, by row.
        heard: what photos said of maps before, by the map's write and row; None where they do not see it. A
            map is examined again whenever another one changes, and its own photos are the same.
    """

    given: GrowthPhotos
    rows: Sequence[int]
    localised: Mapping[int, LocalisedPhoto]
    heard: dict[tuple[str, int], LocalisedPhoto | None] = field(default_factory=dict)

    def that_may_see(self, feature_map: FeatureMap) -> list[int]:
        """Rows of those that may be asked about a map.

        Of a map that is made of the given photos, those that overlap with one of its own.
        """
        names = {image.sha256 for image in feature_map.images}
        own = {row for row, photo in enumerate(self.given.photos) if photo.sha256 in names}
        if len(own) < len(names):  # whose matches with these photos nobody has looked at
            return list(self.rows)
        pairs = self.given.overlaps
        beside = {j for i, j in pairs if i in own} | {i for i, j in pairs if j in own}
        return [row for row in self.rows if row in beside]


def corroborate(
    feature_map: FeatureMap,
    others: Sequence[FeatureMap],
    new: NewPhotos | None,
    sources: Sources,
    *,
    write_id: str,
    threads: int = 1,
) -> list[OutsidePhoto]:
    """Photos of other owners than the map's, whose word counts, as far as the map alone localises them.

    Args:
        others: maps around it, active or quarantined.
        write_id: of the map as it is.
    """
    indexed, own = IndexedArea.of([feature_map]), set(sources.of_map(feature_map))
    if not len(indexed.area.points):
        return []
    names = {image.sha256 for image in feature_map.images}
    heard: list[OutsidePhoto] = []
    for other, image, source in _images_around(feature_map, others, own, sources):
        found = None if image.sha256 in names else localise_image(other, image, [indexed])
        if found is not None:
            pose = image.cam_from_local @ other.frame.enu_from(feature_map.frame)
            known = pose.center, _center_variance(other, image)
            name = f"{image.name} of map {other.map_id}"
            heard.append(_heard(feature_map, found, source, name, known))
    if new is None:
        return heard
    photos, asked = new.given.photos, dict[int, Source]()
    for row in new.that_may_see(feature_map):
        source = sources.of_owner(photos[row].contributor or OPERATOR)
        if photos[row].sha256 not in names and source.speaks_to(own):
            asked[row] = source
    unheard = [row for row in asked if (write_id, row) not in new.heard]
    said = localise_photos(photos, unheard, new.given.features_of, [indexed], threads)[0]
    new.heard.update({(write_id, row): said.get(row) for row in unheard})
    for row, source in asked.items():
        found, known_here = new.heard[write_id, row], None
        if row in new.localised:
            there = in_frame(new.localised[row], feature_map.frame)
            known_here = there.cam_from_local.center, _spread(there)
        if found is not None:
            heard.append(_heard(feature_map, found, source, photos[row].name, known_here))
    return heard


def _heard(
    feature_map: FeatureMap,
    found: LocalisedPhoto,
    source: Source,
    name: str,
    known: tuple[FloatArray, float] | None,
) -> OutsidePhoto:
    """A photo that the map localises.

    Args:
        known: its centre (3,) by others, in the map's frame, and the variance of that, square metres.
    """
    here = in_frame(found, feature_map.frame)
    center, contradicts = here.cam_from_local.center, ""
    if known is not None:
        apart_m = float(np.linalg.norm(known[0] - center))
        # What is nearer than a map may drift contradicts nothing.
        if apart_m > max(DRIFT_BUDGET_M, SIGMAS * float(np.sqrt(_spread(here) + known[1]))):
            contradicts = f"{name} is {apart_m:.2f} m from where the map has it"
    points = np.unique(here.point_of)
    return OutsidePhoto(name=name, source=source, center=center, points=points, contradicts=contradicts)


def _spread(photo: LocalisedPhoto) -> float:
    """Largest variance of the camera's centre, with that of the maps' placements, square metres."""
    pose = photo.result.pose
    covariance = photo.covariance if pose is None else pose.covariance
    return float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])


def _center_variance(other: FeatureMap, image: MapImage) -> float:
    """Of a map image's centre on Earth, roughly: its own, and its map's placement."""
    own = 0.0 if image.covariance is None else float(np.trace(image.covariance[3:, 3:]))
    jacobian = point_jacobian(image.cam_from_local.center)
    return own + float(np.linalg.eigvalsh(jacobian @ other.placement.covariance @ jacobian.T)[-1])


def _images_around(
    feature_map: FeatureMap, others: Sequence[FeatureMap], own: set[Source], sources: Sources
) -> list[tuple[FeatureMap, MapImage, Source]]:
    """Images of other maps whose owners' word counts, nearest to the map's cameras first."""
    centers = np.array([image.cam_from_local.center for image in feature_map.images])
    reach = NEAR_M + 0.5 * float(np.linalg.norm(np.ptp(centers, axis=0)))
    found: list[tuple[float, str, FeatureMap, MapImage, Source]] = []
    for other in others:
        here_from_other = feature_map.frame.enu_from(other.frame)
        for image, source in zip(other.images, sources.of_map(other), strict=True):
            center = here_from_other.act(image.cam_from_local.center)
            distance = float(np.linalg.norm(centers - center, axis=1).min())
            if distance <= reach and source.speaks_to(own):
                found.append((distance, f"{other.map_id} {image.name}", other, image, source))
    nearest = (entry[2:] for entry in sorted(found, key=lambda e: e[:2]))
    described = (e for e in nearest if len(features_and_points(e[0], e[1])[1]) >= LEAST_FEATURES)
    return list(islice(described, MOST_IMAGES))
