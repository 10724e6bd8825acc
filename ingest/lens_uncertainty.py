"""What a reconstruction leaves open of its lenses, from the normal equations of its adjustment."""

from collections.abc import Mapping

import numpy as np

from featuredb.adjust.block import Block, whole_lens
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import CenterPriors, Orientations, Terms
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.lens_uncertainty import LensUncertainty, uncertainty_of_lenses
from ingest.colmap_adjust import AdjustOptions, block_variance_px2, lens_prior_of

_NEAR = 10.0  # sizes of the block, and radians: nothing is known


def lens_uncertainty(
    block: Block, focal_px: Mapping[int, float], options: AdjustOptions | None = None
) -> LensUncertainty | None:
    """Of a block that nothing but its photos and what is known of lenses holds.

    Args:
        focal_px: of EXIF, by camera.
    """
    options = options or AdjustOptions()
    block = whole_lens(block)
    priors = tuple(lens_prior_of(camera, focal_px.get(c), options) for c, camera in enumerate(block.cameras))
    centers, orientations = _anywhere(block)
    terms = Terms(
        keypoint_px=float(np.sqrt(block_variance_px2(block))),
        dilution=options.dilution,
        lenses=priors,
        centers=centers,
        orientations=orientations,
        held_photos=(0,),
    )
    found = Problem(block, terms, options.threads).marginals()
    # Priors count `dilution` times in the problem; in truth observations count so much less.
    lenses = [options.dilution * found.lens(c) for c in range(len(block.cameras))]
    photos = np.bincount(block.camera_of, minlength=len(lenses)).tolist()
    return uncertainty_of_lenses(block.cameras, lenses, photos, options.dilution)


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
