"""What a reconstruction leaves open of its lenses, from the normal equations of its adjustment."""

from collections.abc import Mapping

import numpy as np

from featuredb.adjust.block import Block, whole_lens
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import CenterPriors, Terms
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.lens_uncertainty import LensUncertainty, uncertainty_of_lenses
from ingest.colmap_adjust import AdjustOptions, block_variance_px2, lens_prior_of


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
    terms = Terms(
        keypoint_px=float(np.sqrt(block_variance_px2(block))),
        dilution=options.dilution,
        lenses=priors,
        centers=_any_scale(block),
        held_photos=(0,),
    )
    found = Problem(block, terms, options.threads).marginals()
    # Priors count `dilution` times in the problem; in truth observations count so much less.
    lenses = [options.dilution * found.lens(c) for c in range(len(block.cameras))]
    photos = np.bincount(block.camera_of, minlength=len(lenses)).tolist()
    return uncertainty_of_lenses(block.cameras, lenses, photos, options.dilution)


def _any_scale(block: Block) -> CenterPriors:
    """The gauge's scale: centres within the size of the block."""
    centers: FloatArray = block.centers()
    size = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    count = len(centers)
    covariance = np.tile(size**2 * np.eye(3), (count, 1, 1))
    return CenterPriors(photo_of=np.arange(1, count), xyz=centers[1:], covariance=covariance[1:])
