"""Photos whose positions agree with each other on another place than the reconstruction has them at.

Such a group is either at another place, or was tagged with one error. Which of both cannot be told, so its
photos are in no map (docs/measurements/ingest.md).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.special import bdtrc

from featuredb.geometry.arrays import FloatArray
from ingest.colmap.bridge import Model
from ingest.register.gps import GpsPlacement
from ingest.sfm.links import link_shares, select_photos, tied_parts

_MIN_LINK = 0.25  # photos of a group are tied by links (see `ingest.sfm.links`) of at least this
_MIN_PHOTOS = 2  # of a group that agree with each other, and they are more than half of it
# Common offset over the noise, the root mean square of the horizontal residuals of those that fit, ...
_MIN_OFFSET = 5.0
# ... and at least so many metres: a receiver that loses its correction for some photos is off by less.
_MIN_OFFSET_M = 10.0
_MAX_SPREAD = 0.75  # distance of two offsets that agree, over the least common offset
# Share of positions that may be wrong by accident, and how often so many of a group may be.
_WRONG_SHARE, _ACCIDENT = 0.2, 1e-3

PlaceModel = Callable[[Model], tuple[Sequence[int], GpsPlacement]]


@dataclass(frozen=True, slots=True, kw_only=True)
class TaggedElsewhere:
    """A group of photos of a model, by place among its rows, and what their positions agree on.

    Attributes:
        offset_m: horizontal distance of where their positions have them from where the model has them.
    """

    photos: tuple[int, ...]
    offset_m: float


def tagged_elsewhere(model: Model, with_gps: Sequence[int], placed: GpsPlacement) -> list[TaggedElsewhere]:
    """Groups of photos that the positions contradict together, and photos without position that hang on them.

    Photos `with_gps`, by place among the model's rows, are the rows of the placement's residuals.
    """
    offset_of = {k: r[:2] for k, r in zip(with_gps, placed.residuals_m, strict=True)}
    outside = [k for k, fits in zip(with_gps, placed.inliers.tolist(), strict=True) if not fits]
    if len(outside) < _MIN_PHOTOS or placed.local_from_sfm is None:
        return []
    least_m = _least_offset_m(placed)
    links = link_shares(model)
    untagged = [k for k in range(len(model.rows)) if k not in offset_of]
    found = []
    for members in _tied(links, outside):
        offsets = np.array([offset_of[k] for k in members])
        near = np.linalg.norm(offsets[:, None] - offsets[None], axis=2) <= _MAX_SPREAD * least_m
        agreeing = near[near.sum(axis=1).argmax()]  # those near the one that most others are near to
        if agreeing.sum() < max(_MIN_PHOTOS, len(members) // 2 + 1):
            continue
        offset_m = float(np.linalg.norm(offsets[agreeing].mean(axis=0)))
        if offset_m >= least_m:
            photos = tuple(_with_hanging(links, untagged, members))
            found.append(TaggedElsewhere(photos=photos, offset_m=offset_m))
    return found


def _tied(links: FloatArray, among: Sequence[int]) -> list[list[int]]:
    """Groups of photos that are tied to each other by their links or by others of them."""
    tied = sparse.csr_array((links[np.ix_(among, among)] >= _MIN_LINK).astype(np.int8))
    count, label = connected_components(tied, directed=False)
    return [np.asarray(among)[label == number].tolist() for number in range(count)]


def _with_hanging(links: FloatArray, untagged: Sequence[int], members: Sequence[int]) -> list[int]:
    """A group and the photos without position whose firmest tie is to one of it, in their order."""
    hanging = [k for k in untagged if links[k].max() >= _MIN_LINK and links[k].argmax() in members]
    return sorted([*members, *hanging])


def rightly_joined(model: Model, place: PlaceModel, least_tie: int) -> list[Model]:
    """The model, or its parts where look-alikes have joined some of it wrongly.

    Args:
        place: a model by its positions: photos with one, by place among its rows, and the placement.
        least_tie: points that two photos have in common if they tie what is left together.
    """
    with_gps, placed = place(model)
    if placed.reason is not None or tagged_elsewhere(model, with_gps, placed):
        return [model]
    groups = [model.rows[group].tolist() for group in joined_wrongly(model, with_gps, placed)]
    if not groups:
        return [model]
    rest = select_photos(model, set(model.rows.tolist()).difference(*groups))
    parts = [select_photos(model, rows) for rows in [*tied_parts(rest, least_tie), *groups]]
    return [one for part in parts for one in rightly_joined(part, place, least_tie)]


def joined_wrongly(model: Model, with_gps: Sequence[int], placed: GpsPlacement) -> list[list[int]]:
    """Groups of tied photos of which more do not fit their positions than by accident, by place in the model.

    Look-alikes have joined such a part of the reconstruction to the rest, turned or at another place: their
    offsets do not agree, as `tagged_elsewhere`, whose arguments these are, wants it. Photos without position
    that hang on them are of the group. What is wrong in height alone tells nothing.
    """
    near = np.linalg.norm(placed.residuals_m[:, :2], axis=1) < _least_offset_m(placed)
    fits = dict(zip(with_gps, (placed.inliers | near).tolist(), strict=True))
    if all(fits.values()):
        return []
    links = link_shares(model)
    untagged = [k for k in range(len(model.rows)) if k not in fits]
    outside = [k for k, yes in fits.items() if not yes]
    groups = _tied(links, [*outside, *untagged])  # photos without position tie others together
    found = []
    for group in groups:
        members = [k for k in group if k in fits]
        around = fits.keys() & {*members, *np.flatnonzero((links[members] >= _MIN_LINK).any(axis=0)).tolist()}
        wrong = sum(not fits[k] for k in around)
        if wrong and bdtrc(wrong - 1, len(around), _WRONG_SHARE) < _ACCIDENT / len(groups):
            found.append(_with_hanging(links, untagged, members))
    return found


def _least_offset_m(placed: GpsPlacement) -> float:
    """How far off horizontally positions must be to say that their photos are elsewhere."""
    noise_m = float(np.sqrt((placed.residuals_m[placed.inliers, :2] ** 2).sum(axis=1).mean()))
    return max(_MIN_OFFSET_M, _MIN_OFFSET * noise_m)
