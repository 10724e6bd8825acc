"""Confirmation of a quarantined map: photos of those whose word counts, its own and others, see the same.

A map is the claim of those whose photos made it. Its parents vouch for its place, and only where it overlaps
them; what it adds beyond is believed when photos of another owner show it, too (docs/growth.md).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import maximum_bipartite_matching

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store.candidates.photos import Owners
from featuredb.store.candidates.states import ANONYMOUS, OPERATOR
from ingest.growth.gates import SIGMAS, Gate
from ingest.growth.map_places import centers_of, place_sigmas_m
from ingest.growth.place import map_images
from ingest.growth.place.localised import in_frame, localise_photos
from ingest.growth.values import DRIFT_BUDGET_M, QUERY, GrowthPhotos, LocalisedPhoto
from reloc.localise.candidates import IndexedArea

# Distance of two cameras over their distance from what both see. The same picture given by two people, cut or
# compressed anew, shows no parallax; poses of one place are good to some thousandths.
_LEAST_PARALLAX = 0.01
# Common points of the map from which on two photos confirm each other: an accepted pose has so many, chance
# gives a few.
_LEAST_SHARED_POINTS = QUERY.acceptance.min_inliers


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Where a photo comes from.

    Attributes:
        owner: who gave it, by identity.
        proven: it needs nobody's word: it is the operator's, a trusted identity's, or an anchor's.
        on_record: its owner's word counts, beside that of another such owner.
    """

    owner: str
    proven: bool = False
    on_record: bool = False

    def speaks_to(self, sources: Iterable["Source"]) -> bool:
        """Whether its word counts, for or against a map of these sources, not all its own."""
        return (self.proven or self.on_record) and any(self.owner != other.owner for other in sources)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Tells where photos come from.

    Attributes:
        owners: of the database as it is; by default, one to which nobody has contributed.
        trusted: identities that the operator vouches for.
    """

    owners: Owners = field(default_factory=Owners)
    trusted: tuple[str, ...] = ()

    def with_records(self, owners: Iterable[str]) -> "Sources":
        """The same with these owners on record, too, as far as they may be."""
        more = frozenset(owners) - {ANONYMOUS, OPERATOR}
        return replace(self, owners=replace(self.owners, on_record=self.owners.on_record | more))

    def of_owner(self, owner: str, *, anchor: bool = False) -> Source:
        """Of a photo of this owner; `anchor`: of a map that measured its own place."""
        proven = anchor or owner == OPERATOR or owner in self.trusted
        return Source(owner=owner, proven=proven, on_record=owner in self.owners.on_record)

    def of_map(self, feature_map: FeatureMap) -> list[Source]:
        """Of the images of a map, in their order."""
        anchor = feature_map.map_id in self.owners.anchors
        return [self.of_owner(owner, anchor=anchor) for owner in self.owners.of_map(feature_map)]


def independent(a: Source, b: Source) -> bool:
    """Whether two photos that see the same confirm each other."""
    return a.owner != b.owner and (a.proven or b.proven or (a.on_record and b.on_record))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutsidePhoto:
    """A photo that is not the map's own, and localised in it alone.

    Attributes:
        center: (3,) of its camera in the map's frame, metres.
        points: (k,) rows of the map's points that are its inliers.
        contradicts: a sentence, where its place is known and is not where the map has it.
    """

    name: str
    source: Source
    center: FloatArray
    points: NDArray[np.int64]
    contradicts: str = ""


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
        """Rows of those that may be asked about a map; if it is made of given photos, those beside these."""
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
    new: NewPhotos,
    sources: Sources,
    *,
    write_id: str,
    threads: int = 1,
) -> list[OutsidePhoto]:
    """Photos of other owners than the map's, whose word counts, as far as the map alone localises them.

    Asked are new ones, and images of `others`: maps around it, active or quarantined. `write_id` is its own.
    """
    indexed, own = IndexedArea.of([feature_map]), set(sources.of_map(feature_map))
    if not len(indexed.area.points):
        return []
    names = {image.sha256 for image in feature_map.images}
    heard: list[OutsidePhoto] = []
    for other, image, source in _images_around(feature_map, others, own, sources):
        found = None if image.sha256 in names else map_images.localise_image(other, image, [indexed])
        if found is not None:
            pose = image.cam_from_local @ other.frame.enu_from(feature_map.frame)
            known = pose.center, _center_variance(other, image)
            name = f"{image.name} of map {other.map_id}"
            heard.append(_heard(feature_map, found, source, name, known))
    photos, asked = new.given.photos, dict[int, Source]()
    for row in new.that_may_see(feature_map):
        source = sources.of_owner(photos[row].contributor or OPERATOR)
        if photos[row].sha256 not in names and source.speaks_to(own):
            asked[row] = source
    unheard = [row for row in asked if (write_id, row) not in new.heard]
    said = localise_photos(new.given, unheard, [indexed], threads)[0]
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
    """A photo that the map localises; `known`: its centre (3,) by others and its variance, map's frame, m."""
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
    return own + float(place_sigmas_m(other.placement.covariance, image.cam_from_local.center[None])[0]) ** 2


def _images_around(
    feature_map: FeatureMap, others: Sequence[FeatureMap], own: set[Source], sources: Sources
) -> list[tuple[FeatureMap, MapImage, Source]]:
    """Images of other maps whose owners' word counts, nearest to the map's cameras first."""
    centers = centers_of(feature_map)
    reach = map_images.NEAR_M + 0.5 * float(np.linalg.norm(np.ptp(centers, axis=0)))
    found: list[tuple[float, str, FeatureMap, MapImage, Source]] = []
    for other in others:
        here_from_other = feature_map.frame.enu_from(other.frame)
        for image, source in zip(other.images, sources.of_map(other), strict=True):
            center = here_from_other.act(image.cam_from_local.center)
            distance = float(np.linalg.norm(centers - center, axis=1).min())
            if distance <= reach and source.speaks_to(own):
                found.append((distance, f"{other.map_id} {image.name}", other, image, source))
    nearest = (entry[2:] for entry in sorted(found, key=lambda e: e[:2]))
    described = (e for e in nearest if len(map_images.observed_rows(*e[:2])) >= map_images.LEAST_FEATURES)
    return list(islice(described, map_images.MOST_IMAGES))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Confirmation:
    """How far a map is confirmed: when the gate passes, it is.

    Attributes:
        confirmed: image ids of the map.
        earned: those of the map's that make a record for their owner: proven themselves, or confirmed by a
            proven photo, or by photos of two other owners on record.
        points: (n,) which points of the map two independent photos see, its own or from outside, or a proven
            one of its own: the altered part of a photo makes points that only its owner has seen.
    """

    gate: Gate
    confirmed: tuple[int, ...]
    earned: tuple[int, ...]
    points: NDArray[np.bool_]


def confirm(feature_map: FeatureMap, sources: Sources, outside: Sequence[OutsidePhoto] = ()) -> Confirmation:
    """How far a map is confirmed: by its photos that are proven, or share points with independent ones."""
    corroborating = [photo for photo in outside if not photo.contradicts]
    against = [photo for photo in outside if photo.contradicts]
    everyone = [*sources.of_map(feature_map), *(photo.source for photo in corroborating)]
    own = len(feature_map.images)
    sees = _sees(feature_map, corroborating)
    sees_same = (sees @ sees.T).toarray() >= _LEAST_SHARED_POINTS
    apart = _parallax(feature_map, corroborating, sees) >= _LEAST_PARALLAX
    may_confirm = apart & np.array([[independent(a, b) for b in everyone] for a in everyone], dtype=bool)
    agree = sees_same & may_confirm
    # Pairs that agree, no photo in two of them; by the graph's double cover a triangle counts 1.5.
    partner = maximum_bipartite_matching(sparse.csr_array(agree.astype(np.int8)), perm_type="column")
    pairs = int(np.count_nonzero(partner >= 0)) / 2.0
    proven = np.array([s.proven for s in everyone], dtype=bool)
    confirmed: NDArray[np.bool_] = np.asarray(agree.any(axis=1) | proven, dtype=np.bool_)
    others = sparse.csr_array(may_confirm.astype(np.int64)) @ sees  # how many such photos see the point, too
    by_two = np.asarray(sees.multiply(others).sum(axis=0)).ravel() > 0
    by_proven = np.asarray(sees[np.flatnonzero(proven[:own])].sum(axis=0)).ravel() > 0
    ids = [image.image_id for image in feature_map.images]
    owners = {s.owner for s, yes in zip(everyone, confirmed, strict=True) if yes}
    return Confirmation(
        gate=_gate(int(confirmed[:own].sum()), len(owners), pairs, bool(proven[:own].any()), against),
        confirmed=tuple(i for i, yes in zip(ids, confirmed[:own], strict=True) if yes),
        earned=tuple(i for k, i in enumerate(ids) if _earns(k, everyone, sees_same, apart)),
        points=(by_two | by_proven)[: len(feature_map.points)],
    )


def _earns(
    row: int, sources: Sequence[Source], sees_same: NDArray[np.bool_], apart: NDArray[np.bool_]
) -> bool:
    """Whether a photo makes a record for its owner; one that copies a proven photo does not."""
    mine, same, moved = sources[row], sees_same[row], apart[row]
    seen = zip(sources, same, moved, strict=True)
    others = [(s, far) for s, yes, far in seen if yes and s.owner != mine.owner]
    if mine.proven or not all(far for s, far in others if s.proven):
        return mine.proven
    known = {s.owner for s, far in others if s.on_record and far}
    return any(s.proven for s, _ in others) or len(known) > 1


def _gate(confirmed: int, owners: int, pairs: float, proven: bool, against: Sequence[OutsidePhoto]) -> Gate:
    """Whether more pairs confirm the map than one and as many as contradict it.

    A photo may lie or be mistaken: whichever is left out, a pair that confirms has to be left. Each proven
    photo contradicts it, and each other owner once, whose photos may all lie.
    """
    theirs = [photo.source for photo in against]
    contradicting = sum(s.proven for s in theirs) + len({s.owner for s in theirs if not s.proven})
    needed = contradicting + (0.0 if proven else 1.0)
    passes = pairs > needed or (proven and not against)
    if passes:
        reason, message = "", f"{confirmed} photos confirmed by {owners} owners"
    elif against and (proven or pairs > 1.0):
        reason = "CONTRADICTED"
        message = (
            f"{len(against)} photos from outside contradict it and count as {contradicting}, {pairs:g} pairs "
            f"confirm it: {against[0].contradicts}"
        )
    elif pairs:
        reason = "FEW_PAIRS"
        message = f"{confirmed} photos are confirmed by one photo alone; another independent pair is needed"
    else:
        reason, message = "ONE_SOURCE", "no two owners whose word counts see the same of it"
    return Gate(
        name="confirmation", reason=reason, figure=pairs, limit=needed, passes=passes, message=message
    )


def _sees(feature_map: FeatureMap, corroborating: Sequence[OutsidePhoto]) -> sparse.csr_array:
    """Which points each photo sees, (photos, points), 1 or 0: images of the map, then photos from outside."""
    seen, own = feature_map.observations, len(feature_map.images)
    images = [feature_map.image_rows(seen.image_id)]
    images += [np.full(len(outside.points), k) for k, outside in enumerate(corroborating, start=own)]
    points = np.concatenate([seen.point_index, *(outside.points for outside in corroborating)])
    shape = (own + len(corroborating), max(len(feature_map.points), 1))
    sees = sparse.csr_array((np.ones(len(points), np.int64), (np.concatenate(images), points)), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1
    return sees


def _parallax(
    feature_map: FeatureMap, corroborating: Sequence[OutsidePhoto], sees: sparse.csr_array
) -> FloatArray:
    """Distances of the cameras from each other over those from what they see, (n, n)."""
    points = feature_map.points_local()
    centers = np.reshape([*centers_of(feature_map), *(outside.center for outside in corroborating)], (-1, 3))
    reach = np.full(len(centers), np.inf)
    for k, rows in enumerate(np.split(sees.indices, sees.indptr[1:-1])):
        if len(rows):
            reach[k] = np.median(np.linalg.norm(points[rows] - centers[k], axis=1))
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    return np.asarray(apart / np.maximum(np.minimum(reach[:, None], reach[None]), 1e-9), dtype=np.float64)
