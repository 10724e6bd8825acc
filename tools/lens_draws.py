"""Are the bounds of answers true when lenses are not known? Draws of lenses, positions and keypoints.

Each draw is a flight over a made-up town whose lens differs from what EXIF says of it: focal length by 2 %,
principal point by 1 % of the longer side, two radial and two tangential terms. Keypoints have half a pixel of
noise, half of the variance of positions is shared by the flight, descriptors are made up. Everything after
matching is what an ingest does: structure from motion, the adjustment, placement by positions of that sigma,
the map. Then twenty photos that the map has not seen are localised by EXIF alone.

For each sigma of the positions: shares of errors of position and orientation inside their 68 % and 95 %
bounds, and how many lie outside twice their 99.9 % bound.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from featuredb.features.extractor import rootsift_8bit
from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap, GeoPrior, Placement
from featuredb.simworld.camera.photograph import look_pose
from featuredb.simworld.world import in_order
from ingest.colmap.adjust import AdjustOptions, Known, adjust_models
from ingest.colmap.bridge import Model, SfmPhoto, read_models, run_incremental, verify_pair, write_database
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.photos.photo import Photo
from ingest.placed_models import placed_by_gps
from ingest.sfm.extract import PhotoFeatures
from ingest.sfm.mapper import SfmOptions, mapping_settings
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import localise_features
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest
from tools.figures import inside_figures, pose_offset, squared, study_parser, write_figures

_WIDTH, _HEIGHT, _FOCAL_PX = 1200, 900, 1000.0
_SIGMAS_M = (0.02, 0.5, 3.0)  # of positions
_KEYPOINT_PX = 0.5
_SHOWN = 0.7  # of the points in view
_QUERIES = 20
_FAR = 4.0 * float(chi2.ppf(0.999, 3))
_KEY = "drone"
_PARTS = (slice(0, 3), slice(3, 6))  # of an error: rotation, displacement
_EPSG, _ORIGIN = 32632, (456_800.0, 5_429_300.0, 120.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LensDraw:
    """A draw: a town's points (n, 3), metres, and their descriptors (n, 128); the true lens; and a generator
    of all else."""

    xyz: FloatArray
    descriptors: NDArray[np.uint8]
    lens: Camera
    rng: np.random.Generator
    fingerprint: str

    def seen(self, pose: Rigid3) -> tuple[NDArray[np.int64], Features]:
        """Points (k,) that a photo shows, with its features in the same order."""
        local = pose.act(self.xyz)
        pixels = self.lens.project(local) + self.rng.normal(0.0, _KEYPOINT_PX, (len(local), 2))
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 0) & (pixels < [_WIDTH, _HEIGHT])).all(axis=1) & (local[:, 2] > 0)
        rows = np.flatnonzero(inside & (self.rng.random(len(inside)) < _SHOWN))
        noise = self.rng.normal(0.0, 5.0, (len(rows), 128))
        return rows, Features(
            xy=pixels[rows].astype(np.float32),
            scale=np.full(len(rows), 5.0, np.float32),
            angle=np.zeros(len(rows), np.float32),
            response=np.ones(len(rows), np.float32),
            descriptors=np.clip(self.descriptors[rows] + noise, 0, 255).astype(np.uint8),
            width=_WIDTH,
            height=_HEIGHT,
            fingerprint=self.fingerprint,
        )


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--draws", type=int, default=300)
    args = parser.parse_args()
    figures: dict[str, float] = {}
    for sigma in _SIGMAS_M:
        answers = [one for draw in in_order(partial(drawn, sigma_m=sigma), args.draws, 2) for one in draw]
        for k, kind in enumerate(("orientation", "position")):
            squares = [one[k] for one in answers]
            found = inside_figures(kind, squares) | {f"{kind}_far": sum(one > _FAR for one in squares)}
            figures |= {f"{name}_{100.0 * sigma:g}cm": value for name, value in found.items()}
    write_figures(args.json, figures)


def drawn(seed: int, sigma_m: float) -> list[list[float]]:
    """Squared errors of orientation and position over their covariances of one draw's answers, of three axes
    each; none where no map is placed."""
    scene, frame = scene_of(seed), LocalFrame.from_utm(*_ORIGIN, _EPSG)
    made = _map_of(scene, flight(scene.rng), frame, sigma_m)
    if made is None:
        return []
    indexed = [IndexedArea.of([made])]
    answers = []
    request = LocaliseRequest(camera_key=_KEY, exif_focal_px=_FOCAL_PX)
    for _ in range(_QUERIES):
        height, tilt = scene.rng.uniform(25.0, 60.0), scene.rng.uniform(0.0, 30.0)
        place = [*scene.rng.uniform(-35.0, 35.0, 2), height]
        pose = look_pose(place, scene.rng.uniform(0, 360), -90.0 - tilt)
        answer = localise_features(scene.seen(pose)[1], request, indexed).result.pose
        if answer is None:
            continue
        true = pose @ frame.enu_from(answer.frame)
        turn = np.kron(np.eye(2), answer.frame.true_enu_from_enu(answer.cam_from_local.center))
        error = turn @ pose_offset(answer.cam_from_local, true)
        answers.append([squared(error[k], answer.covariance[k, k]) for k in _PARTS])
    return answers


def scene_of(seed: int) -> LensDraw:
    """Ground with houses, and a lens."""
    rng = np.random.default_rng((seed, 26))
    ground = np.column_stack([rng.uniform(-75, 75, (2200, 2)), np.zeros(2200)])
    ground[:, 2] = 1.5 * np.sin(ground[:, 0] / 25.0) * np.cos(ground[:, 1] / 30.0)
    corners = rng.uniform(-60, 60, (14, 2))
    houses = [
        np.column_stack([c + rng.uniform(-6, 6, (60, 2)), rng.uniform(3.0, 9.0) + rng.normal(0, 0.3, 60)])
        for c in corners
    ]
    xyz = np.concatenate([ground, *houses])
    focal = _FOCAL_PX * (1.0 + 0.02 * rng.normal())
    center = np.array([_WIDTH, _HEIGHT]) / 2 + 0.01 * _WIDTH * rng.normal(size=2)
    params = (focal, focal * (1 + 3e-4 * rng.normal()), *center, *rng.normal(0, [0.03, 0.02, 1e-3, 1e-3]))
    return LensDraw(
        xyz=xyz,
        descriptors=rootsift_8bit(rng.gamma(0.4, size=(len(xyz), 128)).astype(np.float32)),
        lens=Camera(model="OPENCV", width=_WIDTH, height=_HEIGHT, params=tuple(map(float, params))),
        rng=rng,
        fingerprint=LocaliseOptions().extractor.fingerprint,
    )


def flight(rng: np.random.Generator) -> list[Rigid3]:
    """Four lines of six photos, there and back."""
    poses = []
    for line, y in enumerate(np.linspace(-33.0, 33.0, 4)):
        for x in np.linspace(-40.0, 40.0, 6) * (1 if line % 2 == 0 else -1):
            center = np.array([x, y, 45.0]) + rng.normal(0.0, [1.0, 1.0, 0.5])
            poses.append(look_pose(center, 90.0 + 180.0 * (line % 2), -90.0 - abs(rng.normal(0, 4.0))))
    return poses


def _map_of(scene: LensDraw, poses: Sequence[Rigid3], frame: LocalFrame, sigma_m: float) -> FeatureMap | None:
    """What an ingest makes of the photos once their features are matched."""
    shown = [scene.seen(pose) for pose in poses]
    centers = np.array([pose.center for pose in poses])
    part = sigma_m / np.sqrt(2.0)
    measured = centers + scene.rng.normal(0.0, part, 3) + scene.rng.normal(0.0, part, centers.shape)
    with tempfile.TemporaryDirectory() as scratch:
        model = _model_of(shown, measured, sigma_m, Path(scratch))
    if model is None:
        return None
    chosen = [_photo(row, frame, measured[row], sigma_m) for row in model.rows]
    own, _, placed = placed_by_gps(model, chosen)
    if placed.local_from_sfm is None or placed.covariance is None or placed.reason or own is None:
        return None
    placement = Placement(
        method="gps",
        local_from_sfm=placed.local_from_sfm,
        covariance=placed.covariance,
        residual_rms_m=placed.residual_rms_m,
    )
    features = [
        PhotoFeatures(features=shown[row][1], rgb=np.zeros((len(shown[row][1]), 3), np.uint8))
        for row in model.rows
    ]
    identity = MapIdentity(map_id="draw", name="draw", source="", licence="", provenance={})
    options = MapOptions(height_datum="ellipsoidal")
    made = build_map(model, placement, own, chosen, features, identity, options)
    return None if made is None else replace(made, status="active")


def _photo(number: int, frame: LocalFrame, position: FloatArray, sigma_m: float) -> Photo:
    latitude, longitude, height = (float(v) for v in frame.geodetic_from_enu(position))
    return Photo(
        name=f"{number:02d}.jpg",
        path=Path(f"{number:02d}.jpg"),
        sha256=f"{number:064x}",
        width=_WIDTH,
        height=_HEIGHT,
        camera_key=_KEY,
        focal_px=_FOCAL_PX,
        gps=GeoPrior(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            sigma_horizontal_m=sigma_m,
            sigma_vertical_m=sigma_m,
        ),
    )


def _model_of(
    shown: Sequence[tuple[NDArray[np.int64], Features]],
    measured: FloatArray,
    sigma_m: float,
    work: Path,
) -> Model | None:
    """Structure from motion, with a camera that starts as EXIF says."""
    start = Camera.from_focal(_WIDTH, _HEIGHT, _FOCAL_PX)
    photos = tuple(
        SfmPhoto(
            name=f"{k:02d}.jpg",
            camera_row=0,
            keypoints=features.xy,
            prior_position=tuple(position.tolist()),
            prior_sigma_m=(sigma_m, sigma_m, sigma_m),
        )
        for k, ((_, features), position) in enumerate(zip(shown, measured, strict=True))
    )
    pairs = {}
    for i, j in combinations(range(len(photos)), 2):
        both, a, b = np.intersect1d(shown[i][0], shown[j][0], return_indices=True)
        if len(both) >= 30:
            matches = np.column_stack([a, b]).astype(np.uint32)
            pairs[i, j] = verify_pair(
                start, shown[i][1].xy, start, shown[j][1].xy, matches,
                focal_known=True, max_error_px=4.0, seed=0,
            )  # fmt: skip
    database, output = work / "colmap.db", work / "models"
    output.mkdir()
    write_database(database, [(start, True)], photos, pairs)
    run_incremental(database, work, output, mapping_settings(SfmOptions(), _WIDTH))
    adjust_models(output, database, Known(photos=photos, focal_px={1: _FOCAL_PX}), 0.5, AdjustOptions())
    return max(read_models(output), key=lambda model: len(model.rows), default=None)


if __name__ == "__main__":
    main()
