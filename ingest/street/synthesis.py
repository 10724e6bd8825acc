"""A view that nobody took: shape from a scan, grey values from the photos that see each place best.

An airborne scan has points on walls but neither colour nor intensity to speak of there; an ortho image has no
walls at all. Oblique aerial photos have them, under an angle that SIFT does not bridge to the street. Drawn
over the scan's shape, such a photo can be looked at from the street.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render

_CHUNK = 30_000  # OpenCV's remap takes no longer rows
_STRIDE = 2  # pixels between those at which photos are compared
# Neighbours span about four spacings: walls of an airborne scan have few points, in lines.
_NEIGHBOURS = 14
# Variance across a plane over the middle one: noise of 3 cm over half a metre stays below.
_FLAT = 0.08
# A ray meets the plane of its splat within about a splat's size, or the plane is another surface's.
_PLANE_REACH_M = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthesisOptions:
    """How photos are drawn over a scan.

    Attributes:
        max_sources: photos that are drawn into one view; the best few show nearly all that any shows.
        depth_step_m, depth_step_rel: a photo shows a place if its own rendered depth there is that of the
            place, within so much: noise of the scan, of the map, and walls of few points.
        smooth_px: photos' scores are averaged over so many pixels, so that a wall comes from one photo.
        least_cosine: of the angle between a photo's ray and the surface's normal; steeper ones show smear.
        least_detail_share: a place is drawn from photos with at least this share of the view's own pixels per
            metre; coarser ones show nothing that a street photo's keypoints could be.
    """

    max_sources: int = 6
    depth_step_m: float = 0.4
    depth_step_rel: float = 0.005
    smooth_px: int = 31
    least_cosine: float = 0.17
    least_detail_share: float = 0.06


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourcePhoto:
    """An aerial photo with its pose and the scan's depth as it sees it.

    Attributes:
        gray: (h, w) uint8. camera: of these pixels.
        depth: (h / k, w / k) float32 metres, NaN where there is no scan.
    """

    gray: NDArray[np.uint8]
    camera: Camera
    cam_from_local: Rigid3
    depth: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """A scan with the plane around each of its points.

    Attributes:
        cloud: the scan.
        normals: (n, 3) float32 unit normals; zero where the neighbours lie in no plane (leaves, wires).
    """

    cloud: PointCloud
    normals: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SynthesisedView:
    """A drawn view.

    Attributes:
        gray: (h, w) uint8; where `drawn` is false a plain middle grey.
        points: (h, w, 3) float64, what each pixel shows, local frame; NaN in the sky.
        drawn: (h, w) bool.
        camera, cam_from_local: of the view.
    """

    gray: NDArray[np.uint8]
    points: FloatArray
    drawn: NDArray[np.bool_]
    camera: Camera
    cam_from_local: Rigid3


def surfaces_of_scan(cloud: PointCloud) -> Surfaces:
    """Normals by the principal axes of each point and its nearest neighbours."""
    xyz = cloud.xyz
    normals = np.zeros((len(xyz), 3), np.float32)
    tree = cKDTree(xyz)
    for start in range(0, len(xyz), _CHUNK):
        _, near = tree.query(xyz[start : start + _CHUNK], _NEIGHBOURS)
        around = xyz[near].astype(np.float64)
        around -= around.mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        flat = spread[:, 0] < _FLAT * np.maximum(spread[:, 1], 1e-12)
        normals[start : start + _CHUNK][flat] = axes[flat, :, 0]
    return Surfaces(cloud=cloud, normals=normals)


def source_photo(
    cloud: PointCloud, gray: NDArray[np.uint8], camera: Camera, cam_from_local: Rigid3
) -> SourcePhoto:
    """A photo ready to be drawn: with the scan's depth, at half its size.

    Raises:
        MissingExtraError: numba is not installed.
    """
    half = camera.scaled_to(max(camera.width // 2, 1), max(camera.height // 2, 1))
    depth = render(cloud, half, cam_from_local, _DEPTH_ONLY).depth
    return SourcePhoto(gray=gray, camera=camera, cam_from_local=cam_from_local, depth=depth)


def synthesise(
    surfaces: Surfaces,
    camera: Camera,
    cam_from_local: Rigid3,
    sources: Sequence[SourcePhoto],
    options: SynthesisOptions | None = None,
) -> SynthesisedView:
    """What the photos show of the scan from another pose.

    Raises:
        MissingExtraError: numba is not installed.
    """
    options = options or SynthesisOptions()
    points, normals = _seen_surfaces(surfaces, camera, cam_from_local)
    depth = cam_from_local.act(points.reshape(-1, 3))[:, 2].reshape(points.shape[:2])
    coarse, coarse_normals = points[::_STRIDE, ::_STRIDE], normals[::_STRIDE, ::_STRIDE]
    least = options.least_detail_share * camera.focal_px / depth[::_STRIDE, ::_STRIDE]
    seen = np.isfinite(coarse_normals).all(axis=2)
    flat, flat_normals = coarse[seen], coarse_normals[seen]
    best = np.zeros(seen.shape, np.float32)
    choice = np.full(seen.shape, -1, np.int16)
    chosen = _promising(sources, flat, flat_normals, options)
    blur = (max(options.smooth_px // _STRIDE, 1),) * 2
    for number, source in enumerate(chosen):
        score = np.zeros(seen.shape, np.float32)
        score[seen] = _scores(source, flat, flat_normals, options)
        score[score < np.nan_to_num(least, nan=np.inf)] = 0.0
        smooth = cv2.blur(score, blur)
        better = (score > 0.0) & (smooth > best)
        best[better], choice[better] = smooth[better], number
    choice = choice.repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)[: camera.height, : camera.width]
    choice = np.where(np.isfinite(depth), choice, -1)
    gray = np.full(depth.shape, 128, np.uint8)
    for number, source in enumerate(chosen):
        mine = choice == number
        gray[mine] = _sampled(source, points[mine])
    return SynthesisedView(
        gray=gray, points=points, drawn=choice >= 0, camera=camera, cam_from_local=cam_from_local
    )


def _promising(
    sources: Sequence[SourcePhoto], points: FloatArray, normals: FloatArray, options: SynthesisOptions
) -> list[SourcePhoto]:
    """The photos that show most of the points, in most detail."""
    few = np.arange(0, len(points), 53)
    if not len(few):
        return []
    worth = [float(_scores(s, points[few], normals[few], options).sum()) for s in sources]
    order = np.argsort(worth)[::-1][: options.max_sources]
    return [sources[i] for i in order if worth[i] > 0.0]


def _scores(
    source: SourcePhoto, points: FloatArray, normals: FloatArray, options: SynthesisOptions
) -> NDArray[np.float32]:
    """Pixels per metre (n,) with which the photo shows each surface; 0 where it does not."""
    score = np.zeros(len(points), np.float32)
    toward = source.cam_from_local.center - points
    distance = np.linalg.norm(toward, axis=1)
    cosine = np.einsum("ij,ij->i", toward, normals) / distance
    in_camera = source.cam_from_local.act(points)
    rows = np.flatnonzero((cosine > options.least_cosine) & (in_camera[:, 2] > 0.5))
    pixel = source.camera.project(in_camera[rows])
    size = np.array([source.camera.width, source.camera.height])
    with np.errstate(invalid="ignore"):
        inside = ((pixel > 1.0) & (pixel < size - 1.0)).all(axis=1)
    rows, pixel = rows[inside], pixel[inside]
    pixel = (pixel * (np.array(source.depth.shape[::-1]) / size)).astype(np.int64)
    there = source.depth[pixel[:, 1], pixel[:, 0]]
    z = in_camera[rows, 2]
    with np.errstate(invalid="ignore"):
        open_view = np.abs(there - z) < options.depth_step_m + options.depth_step_rel * z
    rows = rows[open_view]
    score[rows] = cosine[rows] * source.camera.focal_px / distance[rows]
    return score


def _sampled(source: SourcePhoto, points: FloatArray) -> NDArray[np.uint8]:
    """Grey values (n,) of the photo where it shows the points."""
    pixel = source.camera.project(source.cam_from_local.act(points)).astype(np.float32) - np.float32(0.5)
    values = np.zeros(len(points), np.uint8)
    for start in range(0, len(points), _CHUNK):
        part = pixel[start : start + _CHUNK]
        values[start : start + _CHUNK] = cv2.remap(
            source.gray, part[None, :, 0], part[None, :, 1], cv2.INTER_LINEAR
        )[0]
    return values


def _seen_surfaces(
    surfaces: Surfaces, camera: Camera, cam_from_local: Rigid3
) -> tuple[FloatArray, FloatArray]:
    """What the pixels show (h, w, 3) and its normals toward the camera, local frame; NaN in the sky.

    Near a wall of few points splats are discs side by side; the ray meets the plane of the disc's point.
    """
    picture = render(surfaces.cloud, camera, cam_from_local, _DEPTH_ONLY)
    depth, index = picture.depth, picture.index
    _, label = cv2.distanceTransformWithLabels(
        (index < 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(label.max()) + 1, dtype=np.int64)
    of_label[label[index >= 0]] = index[index >= 0]
    row = of_label[label]
    y, x = np.mgrid[: camera.height, : camera.width]
    flat = camera.unproject(np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5]))
    rays = (np.column_stack([flat, np.ones(len(flat))]) @ cam_from_local.rotation).reshape(*depth.shape, 3)
    normal = surfaces.normals[row].astype(np.float64)
    offset = surfaces.cloud.xyz[row].astype(np.float64) - cam_from_local.center
    with np.errstate(invalid="ignore", divide="ignore"):
        met = np.einsum("ijk,ijk->ij", normal, offset) / np.einsum("ijk,ijk->ij", normal, rays)
        z = np.where(np.abs(met - depth) < _PLANE_REACH_M, met, depth)
    points = cam_from_local.center + rays * z[..., None]
    # What has no plane is taken as if it faced the camera.
    none = ~normal.any(axis=2)
    normal[none] = -rays[none]
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    normal *= np.sign(np.einsum("ijk,ijk->ij", -rays, normal))[..., None]
    normal[~np.isfinite(points).all(axis=2)] = np.nan
    return points, normal


_DEPTH_ONLY = RenderOptions(attributes=False, threads=1)
