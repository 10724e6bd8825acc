"""Photos whose positions agree with each other on another place than the reconstruction has them at.

Buildings that look alike join photos of one to those of the other, and neither matches nor residuals show it.
Single positions that do not fit are what GPS in streets is like; a group of photos of one thing whose
positions are all off by the same way is either at another place, or was tagged with one error. Which of both
cannot be told, so such photos are in no map.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from featuredb.geometry.arrays import FloatArray
from ingest.colmap.bridge import Model
from ingest.register.gps import GpsPlacement
from ingest.sfm.links import link_shares


@dataclass(frozen=True, slots=True, kw_only=True)
class ElsewhereOptions:
    """When positions that do not fit say that their photos are elsewhere.

    In two simulated communities (500 and 5,000 photos, geotags of 8 m)
    five groups that look-alikes had joined were off by 5.4 to 11 times the noise, two that were wrong
    by 13 and 21 m by less; 62 groups of right photos by up to 4.1 times, one by 1.4 km: its tags were wrong.

    Attributes:
        min_link: photos of a group are tied to each other by links (see `ingest.sfm.links`) of at least this.
        min_photos: of a group that agree with each other, and they are more than half of it.
        min_offset: common offset over the noise, the root mean square of the horizontal residuals of those
            that fit.
        min_offset_m: and at least so many metres: a receiver that loses its correction for some photos of a
            flight is off by less.
        max_spread: distance of two offsets that agree, over the least common offset.
    """

    min_link: float = 0.25
    min_photos: int = 2
    min_offset: float = 5.0
    min_offset_m: float = 10.0
    max_spread: float = 0.75


@dataclass(frozen=True, slots=True, kw_only=True)
class TaggedElsewhere:
    """A group of photos of a model, by place among its rows, and what their positions agree on.

    Attributes:
        offset_m: horizontal distance of where their positions have them from where the model has them.
    """

    photos: tuple[int, ...]
    offset_m: float


def tagged_elsewhere(
    model: Model, with_gps: Sequence[int], placed: GpsPlacement, options: ElsewhereOptions
) -> list[TaggedElsewhere]:
    """Groups of photos that the positions contradict together, and photos without position that hang on them.

    Args:
        with_gps: photos with a position, by place among the model's rows; rows of the placement's residuals.
        placed: the model by these positions.
    """
    groups = agreeing_groups(model, with_gps, placed, options)
    return [g for g in groups if g.offset_m >= least_offset_m(placed, options)]


def least_offset_m(placed: GpsPlacement, options: ElsewhereOptions) -> float:
    """The common offset that counts."""
    noise_m = float(np.sqrt((placed.residuals_m[placed.inliers, :2] ** 2).sum(axis=1).mean()))
    return max(options.min_offset_m, options.min_offset * noise_m)


def agreeing_groups(
    model: Model, with_gps: Sequence[int], placed: GpsPlacement, options: ElsewhereOptions
) -> list[TaggedElsewhere]:
    """Groups of photos outside the placement whose positions agree, however far they are off."""
    offset_of = {k: r[:2] for k, r in zip(with_gps, placed.residuals_m, strict=True)}
    outside = [k for k, fits in zip(with_gps, placed.inliers.tolist(), strict=True) if not fits]
    if len(outside) < options.min_photos or placed.local_from_sfm is None:
        return []
    within_m = options.max_spread * least_offset_m(placed, options)
    links = link_shares(model)
    tied = links[np.ix_(outside, outside)] >= options.min_link
    count, label = connected_components(sparse.csr_array(tied.astype(np.int8)), directed=False)
    untagged = [k for k in range(len(model.rows)) if k not in offset_of]
    found = []
    for number in range(count):
        members = [k for k, of in zip(outside, label.tolist(), strict=True) if of == number]
        offsets = np.array([offset_of[k] for k in members])
        agreeing = _agreeing(offsets, within_m)
        if agreeing.sum() < max(options.min_photos, len(members) // 2 + 1):
            continue
        hanging = [k for k in untagged if links[k].max() >= options.min_link and links[k].argmax() in members]
        offset_m = float(np.linalg.norm(offsets[agreeing].mean(axis=0)))
        found.append(TaggedElsewhere(photos=tuple(sorted([*members, *hanging])), offset_m=offset_m))
    return found


def _agreeing(offsets: FloatArray, within_m: float) -> NDArray[np.bool_]:
    """Of offsets (n, 2) those near the one that most others are near to."""
    near = np.linalg.norm(offsets[:, None] - offsets[None], axis=2) <= within_m
    return np.asarray(near[near.sum(axis=1).argmax()])
