"""How many pieces of all photos lie where one similarity of the map puts them, and how often chance would.

As one photo is asked (`ingest.register.frame.dense.confirmation`), with all photos counted together: photos
that say little alone say enough together. Pieces that show the same place of the scan count as one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import betabinom

from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.frame.dense.confirmation import CHANCE, compared_pieces
from ingest.register.frame_registration import RenderSource

# Of a piece's side, half of its area: pieces that overlap by half say about half as much as ones that do not.
_CELL = 0.7
_MOST_EACH = 10.0  # places of one similarity that count as such: neighbours on a street agree together
_BEFORE = 10.0  # so many places elsewhere weigh as much as what is known before: chance alone


@dataclass(frozen=True, slots=True, kw_only=True)
class JointEvidence:
    """Of one similarity.

    Attributes:
        places: of the scan that pieces show. agreeing: of these, in shares of the pieces of each.
    """

    places: int
    agreeing: float

    @classmethod
    def of_cells(cls, cells: NDArray[np.int64], agrees: NDArray[np.bool_]) -> "JointEvidence":
        """Of pieces (n,) that agree or not, in cells (n, d)."""
        place = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
        count = np.bincount(place)
        share = np.bincount(place, weights=agrees) / np.maximum(count, 1)
        return cls(places=len(count), agreeing=float(share.sum()))

    def log_nfa(self, elsewhere: Sequence["JointEvidence"], asked: int) -> float:
        """-log10 of how often as many would agree at one of so many wrong places (beta-binomial).

        How often a place agrees that is wrong is taken from others, and from chance: pictures of streets
        agree with streets.

        Args:
            elsewhere: of wrong places. asked: places of which this is the best.
        """
        agreed, failed = _BEFORE * CHANCE, _BEFORE * (1.0 - CHANCE)
        for other in elsewhere:
            weight = min(1.0, _MOST_EACH / max(other.places, 1))
            agreed += weight * other.agreeing
            failed += weight * (other.places - other.agreeing)
        counts = np.arange(int(self.agreeing), self.places + 1)
        tail = float(logsumexp(betabinom.logpmf(counts, self.places, agreed, failed))) / np.log(10.0)
        return float(max(-tail - np.log10(asked), 0.0))


def evidence_of(
    new_from_old: Sim3,
    images: Sequence[MapImage],
    cameras: Sequence[Camera],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
) -> JointEvidence:
    """What the photos say of a place of the map.

    Args:
        grays: (h, w) of each image, by id.
    """
    asked = [
        compared_pieces(
            grays[image.image_id],
            cameras[image.camera_id],
            new_from_old.act_on_pose(image.cam_from_local),
            cloud,
            source,
        )
        for image in images
    ]
    asked = [pieces for pieces in asked if len(pieces.near)]
    if not asked:
        return JointEvidence(places=0, agreeing=0.0)
    side_m = _CELL * float(np.median([pieces.side_m for pieces in asked]))
    cells = np.floor(np.vstack([pieces.points_local for pieces in asked])[:, :2] / side_m)
    return JointEvidence.of_cells(cells.astype(np.int64), np.concatenate([pieces.near for pieces in asked]))
