"""What an adjustment leaves open of a map's lenses, poses and shape, from its normal equations."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from featuredb.adjust.marginals import Marginals
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, CenterPriors, Orientations, Terms, whole_lens
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew
from featuredb.maps.error_modes import LENS_SIZE, ErrorModes
from featuredb.maps.lens_uncertainty import LensUncertainty, uncertainty_of_lenses
from ingest.colmap.adjust import AdjustOptions, block_variance_px2, lens_prior_of
from ingest.colmap.picture_shear import PictureShear, picture_shear

_NEAR = 10.0  # sizes of the block, and radians: nothing is known
_KEPT = 0.999  # share of the poses' variance that the modes hold together
_MOST_MODES = 24
_LEAST = 1e-12  # of an eigenvalue over the largest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapErrors:
    """Errors of a map, relative to its placement.

    Attributes:
        lenses: None where no lens is of OPENCV's parameters.
        poses: (k, 6, 6) covariances of the photos' left perturbations, rad and units of the block.
        modes: what of them is common to all.
        shear: of the pictures; what poses hide of it is in `poses`.
    """

    lenses: LensUncertainty | None
    poses: FloatArray
    modes: ErrorModes
    shear: PictureShear


def map_errors(block: Block, focal_px: Mapping[int, float], centers: CenterPriors | None = None) -> MapErrors:
    """Of a block that its photos, what is known of lenses, and positions hold.

    Args:
        focal_px: of EXIF, by camera. centers: positions in the block's frame, if it is placed by them.
    """
    options = AdjustOptions()
    block = whole_lens(block)
    terms = terms_of_map(block, focal_px, centers, options)
    found, weighted = Problem(block, terms, options.threads).honest_marginals()
    # Photos agree on a wrong lens: parameters are off by more than poses made with them.
    lenses = [options.dilution * weighted.lens(c) for c in range(len(block.cameras))]
    photos = np.bincount(block.camera_of, minlength=len(lenses)).tolist()
    size = 6 * len(block.names)
    del weighted  # of 1,000 photos each of these matrices has 300 MB; what follows works in place
    joint = _joint(block, found)
    del found
    factor = _factor(joint, size)
    noise = joint[:size, :size]
    noise -= factor[:size] @ factor[:size].T
    moved, fit = _similarity_of(block)
    factor[:size] -= moved @ (fit @ factor[:size])
    noise -= moved @ (fit @ noise)
    noise -= (noise @ fit.T) @ moved.T
    shear, depths = picture_shear(block), block.distances()
    by_lens = factor[:size].reshape(len(block.names), 6, factor.shape[1])
    poses = np.array([noise[k : k + 6, k : k + 6] for k in range(0, size, 6)]).reshape(-1, 6, 6)
    poses += by_lens @ np.swapaxes(by_lens, 1, 2)
    return MapErrors(
        lenses=uncertainty_of_lenses(block.cameras, lenses, photos, options.dilution),
        poses=poses + shear.hidden(depths),
        modes=_modes(block, noise, factor, depths),
        shear=shear,
    )


def terms_of_map(
    block: Block, focal_px: Mapping[int, float], centers: CenterPriors | None, options: AdjustOptions
) -> Terms:
    """What holds a map of whole lenses: what is known of these, and positions; without any the first photo.

    Args:
        focal_px, centers: as of `map_errors`.
    """
    gauge, orientations = _anywhere(block)
    return Terms(
        keypoint_px=float(np.sqrt(block_variance_px2(block))),
        dilution=options.dilution,
        lenses=tuple(lens_prior_of(lens, focal_px.get(c), options) for c, lens in enumerate(block.cameras)),
        centers=centers or gauge,
        orientations=orientations,
        held_photos=() if centers is not None else (0,),
    )


def _joint(block: Block, found: Marginals) -> FloatArray:
    """Covariance (6 k + 8 c, 6 k + 8 c) of all poses and lenses; zero where they are held or no OPENCV."""
    size = 6 * len(block.names)
    free = np.flatnonzero(found.pose_start >= 0)
    place = [6 * k + np.arange(6) for k in free]
    of = [found.pose_start[k] + np.arange(6) for k in free]
    for c, (start, camera) in enumerate(zip(found.lens_start.tolist(), block.cameras, strict=True)):
        if start >= 0 and camera.model == "OPENCV":
            place.append(size + LENS_SIZE * c + np.arange(LENS_SIZE))
            of.append(np.arange(start, start + LENS_SIZE))
    rows, own = (np.concatenate(parts).astype(np.int64) for parts in (place, of))
    joint = np.zeros((size + LENS_SIZE * len(block.cameras),) * 2)
    joint[np.ix_(rows, rows)] = found.shared[np.ix_(own, own)]
    return joint


def _factor(joint: FloatArray, size: int) -> FloatArray:
    """(6 k + 8 c, m): its square is the covariance of the lenses, and of the poses as they go with them."""
    free = size + np.flatnonzero(np.diag(joint)[size:] > 0.0)
    scale = np.sqrt(np.diag(joint)[free])
    values, vectors = np.linalg.eigh(joint[np.ix_(free, free)] / np.outer(scale, scale))
    good = values > _LEAST * values.max(initial=0.0)
    return np.asarray(joint[:, free] @ (vectors[:, good] / scale[:, None] / np.sqrt(values[good])))


def _similarity_of(block: Block) -> tuple[FloatArray, FloatArray]:
    """How poses move with a similarity (6 k, 7), and the similarity that fits their centres (7, 6 k)."""
    arms = block.centers() - block.centers().mean(axis=0)
    at_centers = np.concatenate([np.column_stack([arm, -skew(arm), np.eye(3)]) for arm in arms])
    by_center = np.linalg.pinv(at_centers)
    moved, fit = np.zeros((6 * len(arms), 7)), np.zeros((7, 6 * len(arms)))
    for k, pose in enumerate(block.cam_from_block):
        turn, shift, center = 6 * k + np.arange(3), 6 * k + 3 + np.arange(3), 3 * k + np.arange(3)
        moved[turn, 1:4] = -pose.rotation
        moved[shift] = -pose.rotation @ at_centers[center]
        fit[:, shift] = -by_center[:, center] @ pose.rotation.T
    return moved, fit


def _modes(block: Block, noise: FloatArray, factor: FloatArray, depths: FloatArray) -> ErrorModes:
    """The largest principal components of the poses' displacements, lenses as they go with them.

    `noise` is changed in place.
    """
    count = len(block.names)
    size = 6 * count
    unit = np.ones((count, 6))
    unit[:, 3:] = 1.0 / depths[:, None]
    scaled = unit.ravel()[:, None] * factor[:size]
    noise *= unit.ravel()[:, None]
    noise *= unit.ravel()
    noise += scaled @ scaled.T
    variance = max(float(np.trace(noise)), 1e-300)
    largest = (max(0, size - _MOST_MODES), size - 1)
    values, vectors = eigh(noise, overwrite_a=True, subset_by_index=largest)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    together = np.cumsum(values) / variance
    kept = min(int(np.searchsorted(together, _KEPT)) + 1, int((values > 0.0).sum()))
    root = np.sqrt(values[:kept])
    lenses = factor[size:] @ (scaled.T @ (vectors[:, :kept] / root))
    return ErrorModes(
        image_id=np.arange(count),
        poses=(vectors[:, :kept] * root).reshape(count, 6, kept),
        lenses=lenses.reshape(-1, LENS_SIZE, kept),
    )


def _anywhere(block: Block) -> tuple[CenterPriors, Orientations]:
    """The gauge, and what photos without points leave open: the photo that is furthest from the first stays
    as far, to a thousandth; all others lie and look anywhere near.
    """
    centers: FloatArray = block.centers()
    seeing = np.unique(block.photo_of)
    away = np.linalg.norm(centers - centers[0], axis=1) * np.isin(np.arange(len(centers)), seeing)
    size, count, furthest = float(away.max()) or 1.0, len(centers), int(np.argmax(away))
    covariance = np.tile((_NEAR * size) ** 2 * np.eye(3), (count, 1, 1))
    along = (centers[furthest] - centers[0]) / size
    covariance[furthest] -= ((_NEAR**2 - 1e-6) * size**2) * np.outer(along, along)
    others = seeing[seeing > 0]
    return (
        CenterPriors(photo_of=others, xyz=centers[others], covariance=covariance[others]),
        Orientations(
            photo_of=others,
            cam_from_block=np.array([block.cam_from_block[k].rotation for k in others]),
            covariance=np.tile(_NEAR**2 * np.eye(3), (len(others), 1, 1)),
        ),
    )
