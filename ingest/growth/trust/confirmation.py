"""Confirmation of a quarantined map: photos of those whose word counts see the same of it.

A map is the claim of those whose photos made it. Its parents vouch for its place, and only where it overlaps
them; what it adds beyond is believed when photos of another owner show it, too. An owner is an identity that
the wire has authenticated, and its word counts once more than identities has confirmed it (docs/growth.md).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import maximum_bipartite_matching

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.store.candidates.owners import Owners
from featuredb.store.candidates.states import ANONYMOUS, OPERATOR
from ingest.growth.gates import Gate
from ingest.growth.values import QUERY

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
        contradicts: a sentence, where its place is known and is not where the map has it; else it
            corroborates the map.
    """

    name: str
    source: Source
    center: FloatArray
    points: NDArray[np.int64]
    contradicts: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Confirmation:
    """How far a map is confirmed: when the gate passes, it is.

    Attributes:
        owners: of the photos that confirm each other, or are proven.
        confirmed: image ids of the map.
        earned: those of the map's that make a record for their owner: proven themselves, or confirmed by a
            proven photo, or by photos of two other owners on record.
        points: (n,) which points of the map two independent photos see, its own or from outside, or a proven
            one of its own. The altered part of a photo that is true in the others makes points that only its
            owner has seen.
    """

    gate: Gate
    owners: tuple[str, ...]
    confirmed: tuple[int, ...]
    earned: tuple[int, ...]
    points: NDArray[np.bool_]

    @property
    def message(self) -> str:
        """Why it is not confirmed, or how it was; for people."""
        if not self.gate.passes:
            return self.gate.message
        return f"{len(self.confirmed)} photos confirmed by {len(self.owners)} owners"


def confirm(feature_map: FeatureMap, sources: Sources, outside: Sequence[OutsidePhoto] = ()) -> Confirmation:
    """How far a map is confirmed by those whose word counts.

    A photo of the map is confirmed when it is proven, or shares enough of the map's points with a photo that
    is independent of it.
    """
    corroborating = [photo for photo in outside if not photo.contradicts]
    against = [photo for photo in outside if photo.contradicts]
    everyone = [*sources.of_map(feature_map), *(photo.source for photo in corroborating)]
    own = len(feature_map.images)
    sees = _sees(feature_map, corroborating)
    sees_same = (sees @ sees.T).toarray() >= _LEAST_SHARED_POINTS
    apart = parallax(feature_map, corroborating) >= _LEAST_PARALLAX
    may_confirm = apart & np.array([[independent(a, b) for b in everyone] for a in everyone], dtype=bool)
    agree = sees_same & may_confirm
    proven = np.array([s.proven for s in everyone], dtype=bool)
    confirmed: NDArray[np.bool_] = np.asarray(agree.any(axis=1) | proven, dtype=np.bool_)
    others = sparse.csr_array(may_confirm.astype(np.int64)) @ sees  # how many such photos see the point, too
    by_two = np.asarray(sees.multiply(others).sum(axis=0)).ravel() > 0
    by_proven = np.asarray(sees[np.flatnonzero(proven[:own])].sum(axis=0)).ravel() > 0
    ids = [image.image_id for image in feature_map.images]
    return Confirmation(
        gate=_gate(int(confirmed[:own].sum()), _pairs(agree), bool(proven[:own].any()), against),
        owners=tuple(dict.fromkeys(s.owner for s, yes in zip(everyone, confirmed, strict=True) if yes)),
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


def _pairs(agree: NDArray[np.bool_]) -> float:
    """How many pairs of photos that agree there are, no photo in two of them.

    By the graph's double cover, so that a triangle counts as one and a half.
    """
    partner = maximum_bipartite_matching(sparse.csr_array(agree.astype(np.int8)), perm_type="column")
    return int(np.count_nonzero(partner >= 0)) / 2.0


def _gate(confirmed: int, pairs: float, proven: bool, against: Sequence[OutsidePhoto]) -> Gate:
    """Whether more pairs confirm the map than one and as many as contradict it.

    A photo may lie or be mistaken: whichever is left out, a pair that confirms has to be left. Each proven
    photo contradicts it, and each other owner once, whose photos may all lie.
    """
    theirs = [photo.source for photo in against]
    contradicting = sum(s.proven for s in theirs) + len({s.owner for s in theirs if not s.proven})
    needed = contradicting + (0.0 if proven else 1.0)
    if against and (proven or pairs > 1.0):
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
        name="confirmation",
        reason=reason,
        figure=pairs,
        limit=needed,
        passes=pairs > needed or (proven and not against),
        message=message,
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


def parallax(feature_map: FeatureMap, corroborating: Sequence[OutsidePhoto]) -> FloatArray:
    """Distances of the cameras from each other over those from what they see, (n, n)."""
    points, seen = feature_map.points_local(), feature_map.observations
    photos = [
        (image.cam_from_local.center, seen.point_index[seen.image_id == image.image_id])
        for image in feature_map.images
    ]
    photos += [(outside.center, outside.points) for outside in corroborating]
    centers = np.reshape([center for center, _ in photos], (-1, 3))
    reach = np.array(
        [np.median(np.linalg.norm(points[r] - c, axis=1)) if len(r) else np.inf for c, r in photos]
    )
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    return np.asarray(apart / np.maximum(np.minimum(reach[:, None], reach[None]), 1e-9), dtype=np.float64)


def answering_with(feature_map: FeatureMap, points: NDArray[np.bool_]) -> FeatureMap:
    """The map with descriptors for the given points only."""
    seen = feature_map.observations
    keep = seen.has_descriptor & points[seen.point_index]
    descriptors = np.where(keep[:, None], seen.descriptors, np.uint8(0))
    return replace(feature_map, observations=replace(seen, has_descriptor=keep, descriptors=descriptors))
