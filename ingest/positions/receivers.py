"""Whether photos are by many people: then what one camera is off by averages out."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

_SEVERAL = 4.0


def receivers(camera_of: NDArray[np.int64] | None, count: int) -> float:
    """How many cameras took the photos, were they shared out evenly; 1 where most took several.

    What a camera that took several is off by, as a receiver and as a gimbal, does not show among its photos,
    and several such cameras are too few to tell it from the shape of a map. Photos by many people, who took
    about one each, show it.

    Args:
        camera_of: (n,) numbers of the cameras; None: one took all. count: n.
    """
    if camera_of is None or not count:
        return 1.0
    _, by_one = np.unique(camera_of, return_counts=True)
    evenly = count**2 / float((by_one**2).sum())
    return evenly if evenly >= max(_SEVERAL, count / 2.0) else 1.0


def places_apart(xyz: FloatArray, apart_m: float) -> int:
    """How many of places (n, 3) lie apart from each other in plan, one taken after the other."""
    taken: list[FloatArray] = []
    for place in xyz[:, :2]:
        if all(np.linalg.norm(place - other) > apart_m for other in taken):
            taken.append(place)
    return max(len(taken), 1)
