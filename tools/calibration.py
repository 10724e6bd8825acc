"""Do reported uncertainties mean what they say? Errors of answers against their covariances.

Used by tools/simulated_evaluation.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import norm

from featuredb.features.exif.read import read_exif
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from featuredb.index.area import Area
from featuredb.maps.exif_prior import prior_from_exif
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.flight import received_positions
from featuredb.simworld.world import World
from ingest.register.gps import GpsOptions, place_by_gps
from reloc.localise.answer import placement_covariance
from reloc.localise.result import LocalisedPose

# An answer, and the true cam_from_local in the frame of the answer.
Pair = tuple[LocalisedPose, Rigid3]

_STEP_S = 3.1  # between the survey's photos
_SURVEY_SIGMA_M = 0.02  # as the demo ingests exact positions
_FLIGHTS_FOR_SIGMA = 2000  # drawn to measure a receiver's own standard deviations to about 2 %


@dataclass(frozen=True, slots=True, kw_only=True)
class Receiver:
    """What measures the positions that a map is placed by.

    Attributes:
        draw: flight centres (n, 3) in order and a generator to positions (n, 3), metres.
        sigmas: "true" for its own standard deviations, "exif" for what EXIF suggests without saying any.
    """

    name: str
    draw: Callable[[FloatArray, np.random.Generator], FloatArray]
    sigmas: Literal["true", "exif"]


def survey_positions(centers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Positions with 2 cm of error per axis, half of its variance shared by the flight."""
    part = _SURVEY_SIGMA_M / np.sqrt(2.0)
    return centers + rng.normal(0.0, part, 3) + rng.normal(0.0, part, centers.shape)


def drone_positions(centers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Positions of a consumer drone."""
    return received_positions(centers, _STEP_S, "realistic", rng)


RECEIVERS = (
    Receiver(name="survey receiver", draw=survey_positions, sigmas="true"),
    Receiver(name="drone, true sigmas", draw=drone_positions, sigmas="true"),
    Receiver(name="drone, EXIF's sigmas", draw=drone_positions, sigmas="exif"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Shares of errors within the reported 68 % radii."""

    answers: int
    horizontal: float
    vertical: float
    orientation: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Errors beside what was reported of them.

    Attributes:
        inside: (n, 3) bool: horizontal, vertical, orientation error within its 68 % radius.
        squared_6: (n,) squared Mahalanobis length of rotation and displacement together.
        squared_3: (n,) of the displacement alone.
        refused: placements that a gate refused.
    """

    inside: np.ndarray
    squared_6: FloatArray
    squared_3: FloatArray
    refused: int = 0

    @property
    def coverage(self) -> Coverage:
        shares = self.inside.mean(axis=0) if len(self.inside) else np.full(3, np.nan)
        return Coverage(
            answers=len(self.inside),
            horizontal=float(shares[0]),
            vertical=float(shares[1]),
            orientation=float(shares[2]),
        )


def as_reported(answers: Sequence[Pair]) -> Calibration:
    """Errors against the covariances of the answers."""
    rows = []
    for pose, true in answers:
        turn = np.kron(np.eye(2), pose.frame.true_enu_from_enu(pose.cam_from_local.center))
        rows.append((turn @ pose_offset(pose.cam_from_local, true), pose.covariance))
    return _calibration(rows)


def over_placements(
    answers: Sequence[Pair],
    area: Area,
    world: World,
    receiver: Receiver,
    draws: int,
    seed: int,
) -> Calibration:
    """The same answers, if the map had been placed by other positions, `draws` times."""
    if len(area.maps) != 1:
        raise SystemExit(f"expected one map of the drone photos, found {len(area.maps)}")
    flight = _flight(area.maps[0], world)
    rng = np.random.default_rng((seed, 31))
    sigmas = flight.exif_sigmas
    if receiver.sigmas == "true":
        sigmas = np.tile(true_sigmas(receiver, flight.true_centers, rng), (len(sigmas), 1))
    measured = [measured_covariance(area, area.maps[0], pose) for pose, _ in answers]
    rows, refused = [], 0
    for _ in range(draws):
        positions = receiver.draw(flight.true_centers, rng)
        again = place_by_gps(flight.centers_sfm, positions, sigmas, GpsOptions())
        if again.reason is not None or again.local_from_sfm is None or again.covariance is None:
            refused += 1
            continue
        moved_map = _placed_by(area.maps[0], again.local_from_sfm, again.covariance)
        motion = again.local_from_sfm @ area.maps[0].placement.local_from_sfm.inverse()
        turn = np.kron(np.eye(2), motion.rotation)
        for (pose, true), own in zip(answers, measured, strict=True):
            moved = motion.act_on_pose(pose.cam_from_local)
            covariance = turn @ own @ turn.T + placement_covariance(area, moved_map, moved.center)
            rows.append((pose_offset(moved, true), covariance))
    return _calibration(rows, refused)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapFlight:
    """The map's photos in the order of the flight, (n, 3) each, metres.

    Attributes:
        centers_sfm: camera centres in the reconstruction's frame.
        true_centers: true ones in the map's local frame.
        exif_sigmas: what the photos' EXIF suggests of their positions, as an ingest takes it.
    """

    centers_sfm: FloatArray
    true_centers: FloatArray
    exif_sigmas: FloatArray


def _flight(feature_map: FeatureMap, world: World) -> MapFlight:
    images = sorted(feature_map.images, key=lambda image: image.name)
    paths = [world.folder / "drone" / image.name for image in images]
    true = [world.truth.images[f"drone/{image.name}"].cam_from_local.center for image in images]
    priors = [prior_from_exif(read_exif(path.read_bytes())) for path in paths]
    sigmas = [(p.sigma_horizontal_m, p.sigma_horizontal_m, p.sigma_vertical_m) for p in priors if p]
    if len(sigmas) != len(images):
        raise SystemExit("a drone photo of the world has no position")
    placed = np.array([image.cam_from_local.center for image in images])
    return MapFlight(
        centers_sfm=feature_map.placement.local_from_sfm.inverse().act(placed),
        true_centers=feature_map.frame.enu_from(world.truth.frame).act(np.array(true)),
        exif_sigmas=np.array(sigmas),
    )


def true_sigmas(receiver: Receiver, centers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(3,) what an honest receiver states: the standard deviations whose 68 % its errors have, by drawing.

    A height that is off by several metres one way or the other is no Gaussian; its root mean square would
    claim a middle that is never there.
    """
    few = centers[:: max(1, len(centers) // 4)]
    errors = np.array([receiver.draw(few, rng) - few for _ in range(_FLIGHTS_FOR_SIGMA)])
    return np.asarray(np.percentile(np.abs(errors), 68.0, axis=(0, 1)) / norm.ppf(0.84))


def pose_offset(pose: Rigid3, true: Rigid3) -> FloatArray:
    """(6,) rotation (rad) before displacement of the camera (m), from a cam_from_local to the true one."""
    turn = so3_log(true.rotation.T @ pose.rotation)
    return np.concatenate([turn, true.center - pose.center])


def measured_covariance(area: Area, feature_map: FeatureMap, pose: LocalisedPose) -> FloatArray:
    """What an answer's covariance (6, 6) holds besides the map's placement, in the area's axes."""
    center = pose.cam_from_local.center
    back = np.kron(np.eye(2), pose.frame.true_enu_from_enu(center).T)
    return back @ pose.covariance @ back.T - placement_covariance(area, feature_map, center)


def _placed_by(feature_map: FeatureMap, local_from_sfm: Any, covariance: FloatArray) -> FeatureMap:
    placement = replace(feature_map.placement, local_from_sfm=local_from_sfm, covariance=covariance)
    return replace(feature_map, placement=placement)


def _calibration(rows: Sequence[tuple[FloatArray, FloatArray]], refused: int = 0) -> Calibration:
    inside = [
        (
            np.hypot(*error[3:5]) <= error_radius(covariance[3:5, 3:5]),
            abs(error[5]) <= error_radius(covariance[5:, 5:]),
            np.linalg.norm(error[:3]) <= error_radius(covariance[:3, :3]),
        )
        for error, covariance in rows
    ]
    return Calibration(
        inside=np.array(inside, dtype=bool).reshape(-1, 3),
        squared_6=np.array([e @ np.linalg.solve(c, e) for e, c in rows]),
        squared_3=np.array([e[3:] @ np.linalg.solve(c[3:, 3:], e[3:]) for e, c in rows]),
        refused=refused,
    )
