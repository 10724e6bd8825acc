"""Finds the pose of a photo over a scan by summing score maps at the pixels that a pose predicts.

No piece has to be right on its own: each has a map of scores (`score_maps`), a pose says where in each map to
look, and the sum over some hundred pieces is a smooth function of the pose with a high maximum at the true
one. It is searched coarse to fine: on a grid of poses at low resolution, then by downhill simplex.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame.dense.pictures import (
    PinholeView,
    finest_side_px,
    pinhole_view,
    viewing_distance_m,
)
from ingest.register.frame.dense.score_maps import ScoreMaps, score_maps_of, scores_at
from ingest.register.frame.prior_fit import prior_sigmas
from ingest.register.frame.views import FrameViews
from ingest.register.frame_registration import FramePrior, RenderSource

# Longer side of the photo's view at each octave, coarse to fine. Octaves finer than the scan's points allow
# (_FINEST_SPACING) are left out.
_SIDES_PX = (128, 256, 512)
# A pixel of the finest view is at least this share of the scan's point spacing; below, splats are larger than
# details.
_FINEST_SPACING = 1.2
REACH_SIGMA = 2.5  # how far from the prior is searched
# The render reaches at most this share of the view's longer side beyond it, on each side; bounds the time
# when a prior is nearly unknown.
_MAX_MARGIN = 1.6
# Renders are made for turns about the optical axis this far apart; pieces bear 6 degrees.
_TURN_STEP_DEG = 6.0
_GRID_STEP_PX = 2.0  # of pan and tilt in the vote; half the width of a score map's peak
# Positions are tried so close that neighbours differ by this in the picture after pan and tilt have taken up
# the common shift.
_PARALLAX_STEP_PX = 5.0
# Poses from the vote that are refined; kept: those that go on to the next octave.
_CANDIDATES = 12
_KEPT = 6
_SEPARATION_PX = 5.0  # two candidates are different if they predict pixels this far apart
_REFINE_RADIUS_PX = 12  # of the score maps at the finer octaves
_MAX_PIECES = 260
_SCORE_CLIP = 6.0  # a single piece counts no more than this many standard deviations
_SCORE_WEIGHT = 0.3  # of the summed scores against the prior; pieces overlap, so each says less than it seems
_MAX_POSITIONS_PER_AXIS = 5
_MIN_PIECES = 12  # fewer pieces are not to win by chance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DensePose:
    """A pose and how well the score maps of the finest octave agree with it.

    Attributes:
        score: sum of the pieces' scores over the root of their number; a random pose has about N(0, 1) times
            the root of how many neighbouring pieces overlap.
        pieces: how many the photo shows at this pose.
    """

    cam_from_local: Rigid3
    score: float
    pieces: int


def register_dense(views: FrameViews, prior: FramePrior, source: RenderSource) -> list[DensePose]:
    """Poses of a photo, best first; empty where the scan shows nothing that could be searched for.

    They are hypotheses: whether the first is right is for `confirm_pose` to say.
    """
    camera, cloud = views.camera, views.cloud
    octaves = [pinhole_view(views.gray, camera, side) for side in sides(camera, prior, cloud)]
    poses = _vote(octaves[0], prior, cloud, source)
    for octave, view in enumerate(octaves):
        near = [refined(view, pose, prior, cloud, source) for pose in poses]
        found = sorted((p for p in near if p is not None), key=lambda p: -p.score)
        distinct = _distinct(found, view.camera, prior)
        poses = [p.cam_from_local for p in distinct[: max(1, _KEPT // 2**octave)]]
    return distinct


def _vote(view: PinholeView, prior: FramePrior, cloud: PointCloud, source: RenderSource) -> list[Rigid3]:
    """The best poses of a grid around the prior, at the coarsest octave."""
    tilt = REACH_SIGMA * np.radians(prior.sigma_tilt_deg)
    focal, longer = view.camera.params[0], max(view.camera.width, view.camera.height)
    first = render(cloud, view.camera, prior.cam_from_local, RenderOptions(threads=1, attributes=False))
    depth = first.depth[first.valid].astype(np.float64)
    if len(depth) < 100:
        depth = np.array([viewing_distance_m(cloud, prior.cam_from_local)])
    distance = float(np.median(depth))
    sideways = REACH_SIGMA * prior.sigma_horizontal_m / distance
    reach_px = focal * (np.tan(min(tilt, 1.0)) + sideways)
    margin = int(min(reach_px, _MAX_MARGIN * longer))
    offsets = _position_offsets(prior, view.camera, depth)
    pans = _pan_tilts(reach_px, view.camera)
    found: list[DensePose] = []
    for turn in _turns(prior):
        start = Rigid3(rotation=so3_exp([0, 0, turn]), translation=np.zeros(3)) @ prior.cam_from_local
        maps = score_maps_of(view, start, margin, cloud, source, None, _MAX_PIECES)
        if len(maps) < 4:
            continue
        for offset in offsets:
            moved = Rigid3(rotation=start.rotation, translation=start.translation - start.rotation @ offset)
            scores = _grid_scores(maps, moved, pans)
            for best in np.argsort(-scores)[:3]:
                turned = Rigid3(rotation=pans[best], translation=np.zeros(3)) @ moved
                found.append(DensePose(cam_from_local=turned, score=float(scores[best]), pieces=0))
    found.sort(key=lambda pose: -pose.score)
    return [p.cam_from_local for p in _distinct(found, view.camera, prior)]


def _grid_scores(maps: ScoreMaps, pose: Rigid3, turns: FloatArray) -> FloatArray:
    """Score (m,) of a pose followed by each of m turns (m, 3, 3)."""
    points = pose.act(maps.points_local).astype(np.float32)
    focal, cx, cy = maps.camera.params
    _, height, width = maps.maps.shape
    x0, y0 = maps.origin[0]
    flat, base = maps.maps.ravel(), np.arange(len(maps)) * (height * width)
    scores = np.empty(len(turns))
    step = max(1, 400_000 // len(maps))
    for first in range(0, len(turns), step):
        cam = points @ turns[first : first + step].astype(np.float32).transpose(0, 2, 1)
        z = np.maximum(cam[..., 2], 1e-3)
        column = (cam[..., 0] / z * focal + (cx - x0 + 0.5)).astype(np.int32)
        row = (cam[..., 1] / z * focal + (cy - y0 + 0.5)).astype(np.int32)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height) & (cam[..., 2] > 1e-3)
        value = flat[base + np.where(inside, row * width + column, 0)]
        value = np.where(inside, np.clip(value, -_SCORE_CLIP, _SCORE_CLIP), 0.0)
        scores[first : first + step] = value.sum(1) / np.sqrt(np.maximum(inside.sum(1), _MIN_PIECES))
    return scores


def _position_offsets(prior: FramePrior, camera: Camera, depth: FloatArray) -> list[FloatArray]:
    """Displacements of the camera (3,), metres, local axes: those that no turn can stand for."""
    focal = camera.params[0]
    radius = 0.4 * float(np.hypot(camera.width, camera.height))
    near, distance = np.percentile(depth, 5), float(np.median(depth))
    relief = float(distance / max(near, 0.05 * distance) - 1.0)
    # A sideways move taken up by a turn leaves a keystone and the parallax of what is nearer.
    sideways_px = prior.sigma_horizontal_m / distance * (radius**2 / focal + focal * relief)
    along_px = prior.sigma_vertical_m / distance * radius

    def steps(sigma_m: float, effect_px: float) -> FloatArray:
        reach = 1.6  # sigmas: nine tenths; what lies beyond is within reach of the nearest step
        count = int(np.ceil(2 * reach * effect_px / _PARALLAX_STEP_PX))
        count = min(count | 1, _MAX_POSITIONS_PER_AXIS)
        return np.linspace(-reach, reach, count) * sigma_m if count > 1 else np.zeros(1)

    level = steps(prior.sigma_horizontal_m, sideways_px)
    # Both may shift and scale: which one does depends on how the camera looks.
    upward = steps(prior.sigma_vertical_m, max(along_px, prior.sigma_vertical_m / distance * focal * relief))
    return [np.array([x, y, z]) for z in upward for y in level for x in level]


def _turns(prior: FramePrior) -> list[float]:
    """Turns about the optical axis, radians."""
    steepness = abs(float(prior.cam_from_local.rotation[2, 2]))  # 1 when looking straight down
    sigma = float(np.hypot(prior.sigma_heading_deg * steepness, prior.sigma_tilt_deg))
    reach = min(REACH_SIGMA * sigma, 180.0)
    if reach >= 180.0 - _TURN_STEP_DEG / 2:
        count = int(np.ceil(360.0 / _TURN_STEP_DEG))
        return [float(a) for a in 2.0 * np.pi * np.arange(count) / count]
    side = int(np.ceil(max(0.0, reach - _TURN_STEP_DEG / 2) / _TURN_STEP_DEG))
    return [float(np.radians(i * _TURN_STEP_DEG)) for i in range(-side, side + 1)]


def _pan_tilts(reach_px: float, camera: Camera) -> FloatArray:
    """Rotations (m, 3, 3) that shift the picture's middle over a disc of the given radius."""
    focal = camera.params[0]
    reach = min(np.arctan(reach_px / focal), np.radians(40.0))
    side = int(np.ceil(reach * focal / _GRID_STEP_PX))
    steps = np.arange(-side, side + 1) * (_GRID_STEP_PX / focal)
    pan, tilt = (axis.ravel() for axis in np.meshgrid(steps, steps))
    axes = np.column_stack([tilt, pan, np.zeros(len(pan))])[np.hypot(pan, tilt) <= reach + 1e-9]
    return np.asarray(Rotation.from_rotvec(axes).as_matrix())


def refined(
    view: PinholeView, pose: Rigid3, prior: FramePrior, cloud: PointCloud, source: RenderSource
) -> DensePose | None:
    """Downhill simplex on the score maps of a render made at the pose; None where it shows too little."""
    radius = _REFINE_RADIUS_PX
    maps = score_maps_of(view, pose, radius, cloud, source, radius, _MAX_PIECES)
    if len(maps) < 4:
        return None
    depth = float(np.median(pose.act(maps.points_local)[:, 2]))
    turn = 2.0 / maps.camera.params[0]  # two pixels
    scale = np.array([turn, turn, 2 * turn, *(np.array([1.0, 1.0, 1.5]) * turn * depth)])
    scale[3:] = np.minimum(scale[3:], max(prior.sigma_horizontal_m, prior.sigma_vertical_m))

    def cost(step: FloatArray) -> float:
        moved = Rigid3.exp(step * scale) @ pose
        total, _ = _summed(maps, moved)
        return -_SCORE_WEIGHT * total + 0.5 * prior_sigmas(prior, moved) ** 2

    simplex = np.vstack([np.zeros(6), np.eye(6)])
    result = minimize(
        cost,
        np.zeros(6),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 300, "xatol": 0.02, "fatol": 0.02, "adaptive": True},
    )
    moved = Rigid3.exp(result.x * scale) @ pose
    total, pieces = _summed(maps, moved)
    score = total / float(np.sqrt(max(pieces, _MIN_PIECES)))
    return DensePose(cam_from_local=moved, score=score, pieces=pieces)


def _summed(maps: ScoreMaps, pose: Rigid3) -> tuple[float, int]:
    cam = pose.act(maps.points_local)
    focal, cx, cy = maps.camera.params
    z = np.maximum(cam[:, 2:], 1e-3)
    pixels = cam[:, :2] / z * focal + (cx, cy)
    scores, inside = scores_at(maps, pixels[None])
    return float(np.clip(scores[0], -_SCORE_CLIP, _SCORE_CLIP).sum()), int(inside.sum())


def _distinct(poses: Sequence[DensePose], camera: Camera, prior: FramePrior) -> list[DensePose]:
    """The first of those that show something else than every better one, as many as are looked into."""
    kept: list[DensePose] = []
    grid = np.array([(x, y) for y in (0.1, 0.5, 0.9) for x in (0.1, 0.5, 0.9)])
    rays = np.column_stack([camera.unproject(grid * (camera.width, camera.height)), np.ones(len(grid))])
    seen: list[FloatArray] = []
    for pose in poses:
        cam_from_prior = pose.cam_from_local @ prior.cam_from_local.inverse()
        # Compared on a plane across the optical axis, far away beside the step between positions.
        here = cam_from_prior.inverse().act(rays * 100.0)
        pixels = here[:, :2] / np.maximum(here[:, 2:], 1e-3) * camera.params[0]
        if not seen or np.abs(np.array(seen) - pixels).max(axis=(1, 2)).min() > _SEPARATION_PX:
            kept.append(pose)
            seen.append(pixels)
        if len(kept) == _CANDIDATES:
            break
    return kept


def sides(camera: Camera, prior: FramePrior, cloud: PointCloud) -> list[int]:
    """Longer sides of the octaves that photo and scan can fill."""
    most = finest_side_px(camera, prior.cam_from_local, cloud, _FINEST_SPACING)
    return [side for side in _SIDES_PX if side <= 1.2 * most] or [_SIDES_PX[0]]
