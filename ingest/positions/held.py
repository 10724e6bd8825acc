"""How photos are held, as directions that are square to local axes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

ANGLES_WRONG = 4.0  # standard deviations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Held:
    """How photos are held: directions of the reconstruction that are square to a local axis.

    Level photos: their horizontal image axes, to up. Photos that tell their tilt: where they say that up is,
    to east and to north. Photos that tell their yaw: where they say that north is, to east.

    Attributes:
        directions: (m, 3) unit vectors in the reconstruction's frame.
        across: (m, 3) local axes that they are square to.
        along: (m, 3) local axes that they point along; 0 where either side will do.
        sigma_rad: (m,) how far one is off.
        joint_rad: (m,) the same, so widened that all by one camera are worth no more than what they have in
            common.
        down: (3,) about downwards, in the reconstruction's frame.
        told: the photos say so; otherwise it is assumed.
        checked: they say so, or so many cameras agree that it is more than an assumption.
    """

    directions: FloatArray
    across: FloatArray
    along: FloatArray
    sigma_rad: FloatArray
    joint_rad: FloatArray
    down: FloatArray
    told: bool
    checked: bool

    @property
    def by_yaw(self) -> NDArray[np.bool_]:
        """(m,) those that tell the turn about up, and nothing else."""
        return np.asarray((self.across[:, 2] == 0.0) & (self.along[:, 2] == 0.0))

    def terms(self, rotation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (m,), their derivatives (m, 3) by a turn, and how far each is off (m,), radians.

        Args:
            rotation: (3, 3) from the reconstruction to the local frame.
        """
        placed = self.directions @ rotation.T
        off = (placed * self.across).sum(axis=1)
        slope = np.cross(placed, self.across)
        slope[self.by_yaw, :2] = 0.0
        turned = np.where((placed * self.along).sum(axis=1) < 0.0, np.pi, 0.0)
        return off, slope, np.abs(turned - np.arcsin(np.clip(np.abs(off), 0.0, 1.0)))
