"""Does an answer contradict what the photo says of its own place?"""

from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import GeoPrior
from reloc.localise.result import LocalisedPose

# Chi-square with two degrees of freedom is above this once in 10,000 answers if the prior's sigma is honest.
_CHI_SQUARE_LIMIT = 18.42

# Phones between houses are off by tens of metres, whatever accuracy they write into a photo.
_OWN_POSITION_SIGMA_M = 20.0


def weakened(position: GeoPrior) -> GeoPrior:
    """A photo's own position as a prior, not believed more closely than phones deserve."""
    sigma_m = max(position.sigma_horizontal_m, _OWN_POSITION_SIGMA_M)
    return replace(position, sigma_horizontal_m=sigma_m)


def distance_from(answer: LocalisedPose, prior: GeoPrior) -> float:
    """Horizontal distance of the camera from the prior, metres."""
    return float(np.linalg.norm(_offset(answer, prior)))


def _offset(answer: LocalisedPose, prior: GeoPrior) -> FloatArray:
    """(2,) metres from the camera to the prior, along true east and north."""
    height = answer.geopose.height_m
    place = answer.frame.enu_from_geodetic(np.array([prior.latitude_deg, prior.longitude_deg, height]))
    to_true = answer.frame.true_enu_from_enu(answer.cam_from_local.center)
    return np.asarray((to_true @ (place - answer.cam_from_local.center))[:2], dtype=np.float64)


def contradicts_prior(answer: LocalisedPose, prior: GeoPrior | None) -> str | None:
    """A sentence with the figures if the answer is too far from the prior for both to be right, else None.

    Horizontal only: heights of photos are rarely in a known datum.
    """
    if prior is None:
        return None
    offset = _offset(answer, prior)
    covariance = answer.covariance[3:5, 3:5] + np.eye(2) * prior.sigma_horizontal_m**2
    chi_square = float(offset @ np.linalg.solve(covariance, offset))
    if chi_square <= _CHI_SQUARE_LIMIT:
        return None
    return (
        f"the pose lies {np.linalg.norm(offset):.1f} m from the prior, whose standard deviation is "
        f"{prior.sigma_horizontal_m:.1f} m; chi-square {chi_square:.1f}, limit {_CHI_SQUARE_LIMIT}"
    )
