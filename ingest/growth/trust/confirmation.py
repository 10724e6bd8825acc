"""Confirmation of a quarantined map by independent sources: photos of different people see the same of it.

A map is the claim of those whose photos made it. Its parents vouch for its place, and only where it overlaps
them; what it adds beyond is believed when photos of someone else show it, too. Sources are told apart by
owner, and where the owner is unknown by camera and day. One person with several accounts is several sources
here; who an owner is, is not for this system to know (docs/growth.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.growth.gates import Gate

Independence = Literal["owner", "any"]

# A photo may lie or be mistaken: whichever is left out, a pair that confirms has to be left. Pairs with one
# photo in common count as one, three photos that confirm each other as one and a half.
_ONE_PAIR = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Where a photo comes from; "" and None are unknown, and never tell two sources apart.

    Attributes:
        owner: who gave it. camera: its EXIF key. day: of capture, by the camera's own clock.
    """

    owner: str = ""
    camera: str = ""
    day: date | None = None

    def as_json(self) -> dict[str, Any]:
        return {
            "owner": self.owner,
            "camera": self.camera,
            "day": None if self.day is None else self.day.isoformat(),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfirmationOptions:
    """When a map counts as confirmed.

    Attributes:
        independent_by: "owner": photos of different owners are independent, and photos without an owner by
            another camera or day; the same owner never confirms himself. "any": another owner, camera or
            day is enough, which a contributor who means harm can make up.
        trusted_owners: whose photos need nobody else: surveys of those who keep the database.
        min_shared_points: two photos confirm each other from so many common points of the map on. An
            accepted pose has at least so many inliers (reloc.localise.options), and chance gives a few.
        min_parallax: distance of two cameras over their distance from what both see. The same picture given
            by two people, cut or compressed anew, shows no parallax; poses of one place are good to some
            thousandths.
    """

    independent_by: Independence = "owner"
    trusted_owners: tuple[str, ...] = ()
    min_shared_points: int = 15
    min_parallax: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CorroboratingImage:
    """A photo that is not the map's own, and localised in it.

    Attributes:
        name: for people.
        center: (3,) of its camera in the map's frame, metres.
        points: (k,) rows of the map's points that are its inliers.
    """

    name: str
    source: Source
    center: FloatArray
    points: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmation:
    """How far a map is confirmed.

    Attributes:
        gate: the map is confirmed when it passes.
        sources: those among the photos that confirm each other, or are trusted.
        confirmed: image ids of the map.
        corroborating: names of photos from outside that confirm one of the map.
    """

    gate: Gate
    sources: tuple[Source, ...]
    confirmed: tuple[int, ...]
    corroborating: tuple[str, ...] = ()

    @property
    def message(self) -> str:
        """Why it is not confirmed, or how it was; for people."""
        if not self.gate.passes:
            return self.gate.message
        return f"{len(self.confirmed)} photos confirmed by {len(self.sources)} sources"


def source_of(image: MapImage, camera_keys: Sequence[str]) -> Source:
    """Where a map's image comes from."""
    return Source(
        owner=image.owner,
        camera=camera_keys[image.camera_id] if camera_keys else "",
        day=None if image.capture_time is None else image.capture_time.date(),
    )


def independent(a: Source, b: Source, by: Independence = "owner") -> bool:
    """Whether two photos come from sources that do not know of each other."""
    other_owner = bool(a.owner and b.owner and a.owner != b.owner)
    other_camera = bool(a.camera and b.camera and a.camera != b.camera)
    other_day = a.day is not None and b.day is not None and a.day != b.day
    if by == "owner" and a.owner and b.owner:
        return other_owner
    return other_owner or other_camera or other_day


def confirm(
    feature_map: FeatureMap,
    options: ConfirmationOptions,
    corroborating: Sequence[CorroboratingImage] = (),
    against: Sequence[str] = (),
) -> Confirmation:
    """How far independent sources confirm a map.

    A photo of the map is confirmed when it shares enough of the map's points with a photo of an independent
    source, the map's own or one from outside, or when its owner is trusted.

    Args:
        against: sentences on photos from outside that the map has elsewhere than they are.
    """
    sources = [source_of(image, feature_map.camera_keys) for image in feature_map.images]
    own = len(sources)
    everyone = [*sources, *(w.source for w in corroborating)]
    shared = _shared_points(feature_map, corroborating)
    agree = np.zeros_like(shared, dtype=np.bool_)
    enough = (shared >= options.min_shared_points) & (
        parallax(feature_map, corroborating) >= options.min_parallax
    )
    for i, j in np.argwhere(np.triu(enough, 1)).tolist():
        agree[i, j] = agree[j, i] = independent(everyone[i], everyone[j], options.independent_by)
    trusted = np.array([bool(s.owner) and s.owner in options.trusted_owners for s in everyone], dtype=bool)
    confirmed: NDArray[np.bool_] = np.asarray(agree.any(axis=1) | trusted, dtype=np.bool_)
    groups = _groups(everyone, confirmed, agree, options.independent_by)
    gate = _gate(int(confirmed[:own].sum()), _pairs(agree), bool((confirmed & trusted)[:own].any()), against)
    ids = [image.image_id for image in feature_map.images]
    vouching: list[bool] = [bool(row.any()) for row in agree[own:, :own]]
    return Confirmation(
        gate=gate,
        sources=tuple(groups),
        confirmed=tuple(i for i, yes in zip(ids, confirmed[:own], strict=True) if yes),
        corroborating=tuple(w.name for w, yes in zip(corroborating, vouching, strict=True) if yes),
    )


def _pairs(agree: NDArray[np.bool_]) -> float:
    """How many pairs of photos that agree there are, no photo in two of them.

    By the graph's double cover, so that a triangle counts as one and a half.
    """
    partner = maximum_bipartite_matching(sparse.csr_array(agree.astype(np.int8)), perm_type="column")
    return int(np.count_nonzero(partner >= 0)) / 2.0


def _gate(confirmed: int, pairs: float, trusted: bool, against: Sequence[str]) -> Gate:
    """Whether more pairs confirm the map than one and those that photos contradict it with."""
    needed = len(against) + (0.0 if trusted else _ONE_PAIR)
    if against and (trusted or pairs > _ONE_PAIR):
        reason = "CONTRADICTED"
        message = (
            f"{len(against)} photos from outside contradict it, {pairs:g} pairs confirm it: {against[0]}"
        )
    elif pairs:
        reason = "FEW_PAIRS"
        message = (
            f"{confirmed} photos are confirmed by one photo alone; another pair of independent photos is "
            "needed"
        )
    else:
        reason, message = "ONE_SOURCE", "no two independent sources see the same of it"
    return Gate(
        name="confirmation",
        reason=reason,
        figure=pairs,
        limit=needed,
        passes=pairs > needed or (trusted and not against),
        message=message,
    )


def _shared_points(feature_map: FeatureMap, corroborating: Sequence[CorroboratingImage]) -> NDArray[np.int64]:
    """Numbers of common points of the map's images and those from outside, (n, n)."""
    row = {image.image_id: i for i, image in enumerate(feature_map.images)}
    seen = feature_map.observations
    images = np.array([row[int(i)] for i in seen.image_id], dtype=np.int64)
    points = seen.point_index
    for k, outside in enumerate(corroborating, start=len(row)):
        images = np.concatenate([images, np.full(len(outside.points), k)])
        points = np.concatenate([points, outside.points])
    count = len(row) + len(corroborating)
    sees = sparse.csr_array(
        (np.ones(len(images), dtype=np.int64), (images, points)),
        shape=(count, max(len(feature_map.points), 1)),
    )
    sees.sum_duplicates()
    sees.data[:] = 1
    return np.asarray((sees @ sees.T).toarray(), dtype=np.int64)


def parallax(feature_map: FeatureMap, corroborating: Sequence[CorroboratingImage]) -> FloatArray:
    """Distances of the cameras from each other over those from what they see, (n, n)."""
    points = feature_map.points_local()
    seen = feature_map.observations
    rows = [seen.point_index[seen.image_id == image.image_id] for image in feature_map.images]
    rows += [w.points for w in corroborating]
    centers = np.array(
        [image.cam_from_local.center for image in feature_map.images] + [w.center for w in corroborating]
    ).reshape(-1, 3)
    reach = np.array(
        [
            np.median(np.linalg.norm(points[r] - c, axis=1)) if len(r) else np.inf
            for r, c in zip(rows, centers, strict=True)
        ]
    )
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    return np.asarray(apart / np.maximum(np.minimum(reach[:, None], reach[None]), 1e-9), dtype=np.float64)


def _groups(
    sources: Sequence[Source], confirmed: NDArray[np.bool_], agree: NDArray[np.bool_], by: Independence
) -> list[Source]:
    """One source of each group of photos that are not independent of each other, among those confirmed."""
    distinct = list(dict.fromkeys(sources[i] for i in np.flatnonzero(confirmed).tolist()))
    if not distinct:
        return []
    same = [[not independent(a, b, by) for b in distinct] for a in distinct]
    _, label = connected_components(sparse.csr_array(np.array(same, dtype=np.int8)), directed=False)
    found = {int(k): source for k, source in zip(label[::-1], distinct[::-1], strict=True)}
    # Photos of unknown source join groups to one; where two of them confirm each other all the same, by what
    # is known of them, there are two.
    groups = [found[k] for k in sorted(found)]
    if len(groups) == 1 and agree.any():
        return [sources[k] for k in np.argwhere(agree)[0].tolist()]
    return groups


def sources_json(confirmation: Confirmation) -> list[Mapping[str, Any]]:
    return [source.as_json() for source in confirmation.sources]
