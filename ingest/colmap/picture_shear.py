"""Shear of single pictures: what a rolling shutter leaves in an adjustment's residuals, and what it hides.

While the rows of a picture are read out, a camera that moves or turns goes on: what is seen is displaced in
proportion to the row y, by (a y, b y). That is a turn by a / 2 and a change of size by b / 2, which the pose
takes up, and a shear of the same size, which nothing in an adjustment can follow: a lens shears all of its
pictures alike, if at all. So as much as pictures are sheared, their poses are off.
"""

from dataclasses import dataclass

import numpy as np

from featuredb.adjust.terms import Block
from featuredb.geometry.arrays import FloatArray
from ingest.colmap.adjust import longest_side, residuals_of

_LEAST_OBSERVATIONS = 50  # of a picture; fewer tell noise
# Contradiction: can a lens do this? One in twenty reconstructions of real photos, and one in a thousand, has
# more: a log-normal over maps of `brighton`, `lewis`, `seneca`, `fountain-P11`, `entry-P10` and `karma`, with
# 0.3 to 4.6e-5 (`tools.lens_widths` prints both for the sets that it is given). `sacre_coeur`, which was not
# among them, has 6.7e-5. Simulated films read out over 30 ms have 1.3 to 9e-4.
UNUSUAL, IMPOSSIBLE = 0.8e-4, 4.2e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureShear:
    """Root mean squares over the pictures of a reconstruction, pixels per pixel.

    Attributes:
        along: of one axis being longer and the other shorter; what is hidden is a change of size.
        across: of the axes not being at right angles; what is hidden is a turn about the optical axis, rad.
    """

    along: float = 0.0
    across: float = 0.0

    @property
    def size(self) -> float:
        """Of both together."""
        return float(np.hypot(self.along, self.across))

    def hidden(self, depths: FloatArray) -> FloatArray:
        """(k, 6, 6) covariances of what poses hide of it: left perturbations (omega, nu) of cam_from_block.

        Args:
            depths: (k,) distance of what each photo sees, units of the block.
        """
        result = np.zeros((len(depths), 6, 6))
        result[:, 2, 2] = self.across**2
        result[:, 5, 5] = (self.along * depths) ** 2
        return result


def shear_words(size: float) -> str:
    """A shear and its likely cause, for people."""
    return (
        f"the pictures are sheared by {size:.3%} (root mean square), as by a rolling shutter while the "
        "camera moves, or by software that stabilises a film"
    )


def picture_shear(block: Block) -> PictureShear:
    """Of the pictures of an adjusted block that have enough observations."""
    residuals, pixels, photo_of = residuals_of(block)
    often = np.bincount(photo_of, minlength=len(block.names))[photo_of] >= _LEAST_OBSERVATIONS
    residuals, pixels, photo_of = residuals[often], pixels[often], photo_of[often]
    if not len(residuals):
        return PictureShear()
    side = longest_side(block.cameras)
    sizes = np.array([(block.camera(k).width, block.camera(k).height) for k in range(len(block.names))])
    x, y = ((pixels - sizes[photo_of] / 2.0) / side).T
    one, none = np.ones(len(x)), np.zeros(len(x))
    affine = np.stack(  # shifts, size, turn, and the two shears
        [
            np.stack([one, none, x, -y, x, y], axis=1),
            np.stack([none, one, y, x, -y, x], axis=1),
        ],
        axis=1,
    )
    squared = (residuals**2).sum(axis=1)
    weight = 1.0 / (1.0 + squared / (4.0 * max(float(np.median(squared)), 1e-12)))
    normal, right = np.zeros((len(block.names), 6, 6)), np.zeros((len(block.names), 6))
    np.add.at(normal, photo_of, weight[:, None, None] * np.swapaxes(affine, 1, 2) @ affine)
    np.add.at(right, photo_of, weight[:, None] * np.einsum("mij,mi->mj", affine, residuals / side))
    seen = np.unique(photo_of)
    found = np.linalg.solve(normal[seen] + 1e-9 * np.eye(6), right[seen][:, :, None])[:, :, 0]
    along, across = np.sqrt((found[:, 4:] ** 2).mean(axis=0))
    return PictureShear(along=float(along), across=float(across))
