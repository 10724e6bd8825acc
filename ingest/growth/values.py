"""The values that pass between the steps of growth: new photos, localised ones, overlaps, refusals."""

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from ingest.colmap.bridge import Model, TwoView
from ingest.growth.gates import Gate
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures
from ingest.sfm.pairs import Pair
from reloc.localise.acceptance import AcceptanceOptions
from reloc.localise.lens_prior import LensPriors
from reloc.localise.options import LocaliseOptions, PoseOptions
from reloc.localise.result import LocaliseResult

_OF_NONE: Any = {}.__getitem__  # of no photos, and of no overlaps: nobody calls it
DRIFT_BUDGET_M = 0.5  # what a survey's points are usually wanted for
# Of a reconstruction, of a map without a place, of those by which two maps overlap, and of those that see a
# point that is asked for what is there: two leave it along a ray.
LEAST_PHOTOS = 3
MAD = 1.4826  # standard deviation of a normal distribution over its median absolute value

# As for queries, but for the gate of `spread`: where a query stands alone, photos that are taken into a map
# must agree with others in any case (a tenth of ten strangers' photos of a church was lost to it).
QUERY = LocaliseOptions(
    pose=PoseOptions(lens=LensPriors(whole_lens=False)), acceptance=AcceptanceOptions(min_spread=0.0)
)
# Points in common that connect two maps, of two poses; an existing map with fewer would not hold a new one
# alone.
LEAST_SHARED_POINTS = 2 * QUERY.acceptance.min_inliers
# At images of 1600: twice the inlier tolerance of a pose, for two poses, or reconstructions of few photos
# that are bent.
TOLERANCE_PX = 2.0 * 1600.0 * QUERY.pose.tolerance_rel


def tied_together(nodes: Sequence[Hashable], pairs: Iterable[tuple[Hashable, Hashable]]) -> list[int]:
    """For each node the number of its group: of those that a chain of pairs ties together."""
    row = {node: k for k, node in enumerate(nodes)}
    a, b = np.array([(row[a], row[b]) for a, b in pairs], dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(nodes), len(nodes)))
    labels: list[int] = connected_components(graph, directed=False)[1].tolist()
    return labels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalisedPhoto:
    """A new photo that the existing maps localise, by itself.

    Attributes:
        frame: local frame of everything metric here.
        covariance: (6, 6) as pose_uncertainty has it, axes of the frame, without the maps' placements: small
            rotation of the camera (rad) before displacement of its centre (m).
        feature_rows: (k,) rows of the photo's features that are inliers; pixels: (k, 2) float64 of those.
        map_ids: the maps of the inliers' points; map_of: (k,) index into them.
        point_of: (k,) row of that map's points.
        points: (k, 3) those points in the frame, metres.
        point_covariance: (k, 3, 3) of the points, relative to their map's gauge.
        result: the answer as a query would have got it.
    """

    frame: LocalFrame
    cam_from_local: Rigid3
    covariance: FloatArray
    camera: Camera
    feature_rows: NDArray[np.int64]
    pixels: FloatArray
    map_ids: tuple[str, ...]
    map_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    points: FloatArray
    point_covariance: FloatArray
    result: LocaliseResult


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """An overlap of a map with another one; kept in the evidence of the map that was placed by it.

    Attributes:
        other_from_map: carries what this map says to where the other says it; this map's local frame.
        covariance: (7, 7) of its left perturbation, relative to the other map.
        shared_points, photos: that it rests on.
        place: digest of the other map's place when it was measured (`graph.map_graph.place_key`).
        shared: (7, 3) the part of the covariance that overlaps have in common (`place.drift.shared_turn`).
    """

    map_id: str
    other_from_map: Sim3
    covariance: FloatArray
    shared_points: int = 0
    photos: int = 0
    place: str = ""
    shared: FloatArray = field(default_factory=lambda: np.zeros((7, 3)))

    def carried(self, other: Sim3, own: Sim3) -> "Edge":
        """The same overlap where the other map's coordinates, and this one's, are moved so."""
        return replace(
            self,
            other_from_map=other @ self.other_from_map @ own.inverse(),
            covariance=other.carried(self.covariance),
            shared=other.adjoint() @ self.shared,
        )

    def as_json(self) -> dict[str, Any]:
        return {
            "map_id": self.map_id,
            "place": self.place,
            "shared_points": self.shared_points,
            "photos": self.photos,
            "parent_from_new": self.other_from_map.log().tolist(),
            "covariance": self.covariance.ravel().tolist(),
            "shared": self.shared.ravel().tolist(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> "Edge":
        return cls(
            map_id=str(value["map_id"]),
            place=str(value.get("place", "")),
            shared_points=int(value.get("shared_points", 0)),
            photos=int(value.get("photos", 0)),
            other_from_map=Sim3.exp(value.get("parent_from_new") or np.zeros(7)),
            covariance=np.reshape(value["covariance"], (7, 7)),
            shared=np.reshape(value.get("shared") or np.zeros(21), (7, 3)),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refused:
    """What did not become a map: code of the reason for programs, a message with figures for people, and
    every gate that was asked."""

    reason: str
    message: str
    gates: tuple[Gate, ...] = ()

    @classmethod
    def by(cls, gate: Gate, *before: Gate) -> "Refused":
        """By a gate, after others that were asked."""
        return cls(reason=gate.reason, message=gate.message, gates=(*before, gate))


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowthOptions:
    """How a database grows.

    Attributes:
        drift_budget_m: 95 % bound on a map's errors against its anchors beyond which it is not taken.
        trusted: identities that the operator vouches for.
        threads: photos that are localised at a time.
    """

    drift_budget_m: float = DRIFT_BUDGET_M
    trusted: tuple[str, ...] = ()
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrowthPhotos:
    """New photos, matched and reconstructed; without any, quarantined maps and new anchors are looked at.

    Attributes:
        features_of: of the photo of a row; called when they are needed, so that not all are in memory.
        models: their reconstructions, called once a round; rows of a model are rows of `photos`.
        candidate_ids: of contributed photos, by row.
        overlaps: pairs of rows whose matches were verified. geometry_of: of such a pair.

    Raises:
        InvalidValueError: photos without their features, or overlaps without their geometry.
    """

    photos: Sequence[Photo] = ()
    features_of: Callable[[int], PhotoFeatures] = _OF_NONE
    models: Callable[[], Iterable[Model]] = tuple
    overlaps: Collection[Pair] = ()
    geometry_of: Callable[[Pair], TwoView] = _OF_NONE
    candidate_ids: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.photos and self.features_of is _OF_NONE) or (self.overlaps and self.geometry_of is _OF_NONE):
            raise InvalidValueError("GrowthPhotos: expected features of photos and geometry of overlaps")
