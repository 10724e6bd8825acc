"""The values that pass between the steps of growth: localised photos, placements, grown maps, refusals."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.bridge import Model
from ingest.growth.gates import Gate
from ingest.sfm.extract import PhotoFeatures
from reloc.localise.result import LocaliseResult

FeaturesOf = Callable[[int], PhotoFeatures]
"""Features of the photo of a row; called when they are needed, so that not all are in memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalisedPhoto:
    """A new photo that the existing maps localise, by itself, without knowing of other new photos.

    Attributes:
        row: row of the photos.
        frame: local frame of everything metric here.
        cam_from_local: pose in that frame.
        covariance: (6, 6), axes of the frame, measured part only (without the maps' placements): small
            rotation of the camera (rad) before displacement of its centre (m), as pose_uncertainty has it.
        camera: intrinsics that the localisation used or estimated.
        feature_rows: (k,) rows of the photo's features that are inliers.
        pixels: (k, 2) float64 of those.
        map_ids: the maps that the inliers' points belong to, most inliers first.
        map_of: (k,) index into map_ids.
        point_of: (k,) row of that map's points.
        points: (k, 3) those points in the frame, metres.
        point_covariance: (k, 3, 3) of the points, relative to their map's gauge.
        by_prior: found only inside the reach of the photo's own position.
        result: the answer as a query would have got it.
    """

    row: int
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
    by_prior: bool
    result: LocaliseResult

    def __post_init__(self) -> None:
        k = len(self.feature_rows)
        for name, shape, kind in (
            ("covariance", (6, 6), np.float64),
            ("feature_rows", (k,), np.int64),
            ("pixels", (k, 2), np.float64),
            ("map_of", (k,), np.int64),
            ("point_of", (k,), np.int64),
            ("points", (k, 3), np.float64),
            ("point_covariance", (k, 3, 3), np.float64),
        ):
            value = frozen_array(f"LocalisedPhoto.{name}", getattr(self, name), shape, kind)
            object.__setattr__(self, name, value)
        if k and not 0 <= self.map_of.min() <= self.map_of.max() < len(self.map_ids):
            raise InvalidValueError("LocalisedPhoto.map_of: names a map that map_ids does not have")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """How one existing map holds a new one.

    Attributes:
        map_id: the existing map.
        parent_from_new: correction (a similarity near the identity, in the frame of the new map) that this
            parent alone would apply to the placed map.
        covariance: (7, 7) of its left perturbation, relative to the parent.
        shared_points: points of the parent that are seen by new photos.
        photos: new photos that see them.
    """

    map_id: str
    parent_from_new: Sim3
    covariance: FloatArray
    shared_points: int
    photos: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapsPlacement:
    """A reconstruction placed by existing maps; accepted when `reason` is None.

    Attributes:
        reason: code of the first gate that refused it, or None; `message` says it for people.
        frame: local frame in which the similarity places the model.
        local_from_sfm: None where none could be estimated.
        covariance_relative: (7, 7) of its left perturbation, relative to the existing maps, or None.
        covariance: (7, 7) with the uncertainty of the existing maps on Earth, or None.
        agreeing, disagreeing: rows of the localised photos that agree with the placement, and of those
            that do not. Photos that no map localises are in neither.
        blind: those that show too little of what existing maps, or the others' points, say they should.
        edges: one for each existing map that holds it, most shared points first.
        residual_rms_m: of the agreeing photos' centres, placed minus localised, metres; NaN without any.
        gates: every gate with its figure, in the order they were asked.
    """

    reason: str | None
    message: str
    frame: LocalFrame
    local_from_sfm: Sim3 | None = None
    covariance_relative: FloatArray | None = None
    covariance: FloatArray | None = None
    agreeing: tuple[int, ...] = ()
    disagreeing: tuple[int, ...] = ()
    blind: tuple[int, ...] = ()
    edges: tuple[Edge, ...] = ()
    residual_rms_m: float = float("nan")
    gates: tuple[Gate, ...] = ()

    @property
    def parents(self) -> tuple[str, ...]:
        """Maps that hold the new one, most shared points first."""
        return tuple(edge.map_id for edge in self.edges)

    def figures(self) -> dict[str, Any]:
        """Gates by name, JSON-able."""
        return {gate.name: gate.as_json() for gate in self.gates}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapAgreement:
    """What a new map that overlaps two existing ones says of how well they agree.

    Attributes:
        map_a, map_b: the existing maps.
        a_from_b: similarity, in the frame of the new map, that carries what B says to where A says it.
        covariance: (7, 7) of its left perturbation.
        distance_m: displacement of the middle of the overlap.
        sigma_m: its standard deviation along the displacement, without the maps' own placements.
        sigmas: distance over sigma.
        photos: new photos that see points of A, of B.
    """

    map_a: str
    map_b: str
    a_from_b: Sim3
    covariance: FloatArray
    distance_m: float
    sigma_m: float
    sigmas: float
    photos: tuple[int, int]

    def __str__(self) -> str:
        return (
            f"maps {self.map_a} and {self.map_b} differ by {self.distance_m:.2f} m here, "
            f"{self.sigmas:.1f} sigma"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrownMap:
    """A new map, ready to be committed (as quarantined, by whoever commits it).

    Attributes:
        feature_map: method "map", its parents, generation and evidence["growth"].
        placement: how it was placed.
        model: the reconstruction after refinement; metric, in the frame of the map.
        agreements: between the existing maps that it overlaps.
        left_out: photos of the reconstruction that are not in the map, by row, with reason and message.
    """

    feature_map: FeatureMap
    placement: MapsPlacement
    model: Model
    agreements: tuple[MapAgreement, ...] = ()
    left_out: Mapping[int, tuple[str, str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refused:
    """Photos that did not become a map.

    Attributes:
        reason: code of the gate, for programs.
        message: for people, with figures.
        rows: the photos concerned.
        gates: every gate that was asked.
    """

    reason: str
    message: str
    rows: tuple[int, ...]
    gates: tuple[Gate, ...] = field(default=())

    def figures(self) -> dict[str, Any]:
        """Gates by name, JSON-able."""
        return {gate.name: gate.as_json() for gate in self.gates}
