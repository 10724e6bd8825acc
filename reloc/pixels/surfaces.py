"""What a ray of a photo may meet: the scan of the database, or the points of the map that answered."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.lidar.load import PlanBox, load_cloud
from featuredb.maps.lineage import trace
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering, RenderOptions, render
from featuredb.store import Database
from featuredb.store.scans import list_scans
from featuredb.store.tables import LIDAR
from reloc.answered_view import AnsweredView

REACH_M = 1000.0  # of the scan around the camera that is looked at
_OVERVIEW_PX = 1000  # longer side of the picture in which a pixel's distance is looked up first
_LARGEST_HALF_PX = 120  # of the picture of a pixel's surroundings; what needs more is drawn smaller
_SMALLEST_HALF_PX = 16
_SPACINGS = 4.0  # around a place from which its plane is taken: some fifty points
_NEAREST_POINTS = 12  # of a map
_TOLERANCE_SPACINGS = 0.25  # flatter than this is flat at a scan's resolution
# Scans keep coordinates in steps of a centimetre or less, and all points of a level place are rounded alike.
_ROUNDING_M = 0.01 / 12**0.5
_UNKNOWN_HEIGHTS = (
    "the heights of the map and of the scan are both of an unknown datum, and may be tens of metres apart"
)

FEWEST_POINTS = 6  # three make a plane; twice as many say how flat it is
_DRAWS = 64  # of three points: where half of them lie on the plane, one draw in eight is clean
_MOST_POINTS = 80


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A piece of surface.

    Attributes:
        point: (3,) on it, nearest to the place that was asked for.
        normal: (3,) unit vector, towards the viewer.
        scatter_m: standard deviation of the points off the plane, metres.
        fitted_m: how well they determine the plane there, along its normal: one standard deviation.
        share: of the points around that lie on it.
    """

    point: FloatArray
    normal: FloatArray
    scatter_m: float
    fitted_m: float
    share: float


def fit_patch(points: FloatArray, near: FloatArray, viewer: FloatArray, tolerance_m: float) -> Patch | None:
    """The plane through the points around a place that most of them lie on; None where there is none.

    Nearer points count more, with a Gaussian as wide as a half of the farthest.

    Args:
        points: (n, 3). near: (3,) the place, on the wanted surface. viewer: (3,) from where it is seen.
        tolerance_m: a point so far off a plane does not belong to it.
    """
    distance = np.linalg.norm(points - near, axis=1)
    chosen = np.argsort(distance, kind="stable")[:_MOST_POINTS]
    points, distance = points[chosen], distance[chosen]
    if len(points) < FEWEST_POINTS:
        return None
    weight = np.exp(-2.0 * (distance / max(float(distance.max()), 1e-9)) ** 2)
    # The place itself is on the surface to within the points' own distance: it chooses among planes.
    on = _most_supported(points, near, weight, tolerance_m)
    for _ in range(3):
        if on is None or on.sum() < FEWEST_POINTS:
            return None
        origin, axes = _axes(points[on], weight[on])
        off = (points - origin) @ axes[2]
        on = np.abs(off) < tolerance_m
    if on is None or on.sum() < FEWEST_POINTS:
        return None
    return _patch(points[on], weight[on], near, viewer, float(weight[on].sum() / weight.sum()))


def _most_supported(
    points: FloatArray, near: FloatArray, weight: FloatArray, tolerance_m: float
) -> FloatArray | None:
    """Which points lie on the best of the planes through three of them (MSAC)."""
    rng = np.random.default_rng(len(points))
    best, most = None, 0.0
    likely = weight / weight.sum()
    for _ in range(_DRAWS):
        a, b, c = points[rng.choice(len(points), 3, replace=False, p=likely)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs((near - a) @ normal) > 2.0 * tolerance_m * length:
            continue
        off = np.abs((points - a) @ normal) / length / tolerance_m
        support = float(weight @ np.maximum(1.0 - off**2, 0.0))
        if support > most:
            best, most = off < 1.0, support
    return best


def _axes(points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    origin = np.average(points, axis=0, weights=weight)
    _, _, axes = np.linalg.svd((points - origin) * np.sqrt(weight)[:, None], full_matrices=False)
    return np.asarray(origin), np.asarray(axes)


def _patch(
    points: FloatArray, weight: FloatArray, near: FloatArray, viewer: FloatArray, share: float
) -> Patch | None:
    origin, axes = _axes(points, weight)
    s, t, off = ((points - origin) @ axes.T).T
    a, b = (near - origin) @ axes[0], (near - origin) @ axes[1]
    plan = np.column_stack([np.ones(len(points)), s - a, t - b])
    information = plan.T @ (plan * weight[:, None])
    if np.linalg.cond(information) > 1e8:  # on a line
        return None
    inverse = np.linalg.inv(information)
    height, slope_s, slope_t = inverse @ plan.T @ (weight * off)
    residual = off - plan @ [height, slope_s, slope_t]
    effective = weight.sum() ** 2 / (weight**2).sum()
    variance = float(weight @ residual**2 / weight.sum()) * effective / max(effective - 3.0, 1.0)
    leverage = float((inverse @ plan.T @ (plan * (weight**2)[:, None]) @ inverse)[0, 0])
    normal = axes[2] - slope_s * axes[0] - slope_t * axes[1]
    normal /= np.linalg.norm(normal)
    point = origin + a * axes[0] + b * axes[1] + height * axes[2]
    if normal @ (viewer - point) < 0:
        normal = -normal
    return Patch(
        point=np.asarray(point),
        normal=np.asarray(normal),
        scatter_m=float(np.sqrt(variance)),
        fitted_m=float(np.sqrt(variance * leverage)),
        share=share,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Met:
    """Where a ray meets a surface.

    Attributes:
        patch: the surface there.
        sigma_m: one standard deviation of the surface along its normal.
        spacing_m: distance between the points that it is known by; edges are known no better.
        tolerance_m: what lies farther off the patch is another surface.
        around: metres along the optical axis at pixels (k, 2) around; NaN where nothing is.
    """

    patch: Patch
    sigma_m: float
    spacing_m: float
    tolerance_m: float
    around: Callable[[FloatArray], FloatArray]


@dataclass(slots=True, kw_only=True, eq=False)
class ScanSurface:
    """A cloud in the frame of the view; `doubt` is said of each place on it.

    Attributes:
        common_m: one standard deviation of what neighbouring points are off by together (their strip, the
            datum), metres; None: half of how far they scatter.
    """

    cloud: PointCloud
    common_m: float | None = None
    kind: str = "scan"
    doubt: str = ""
    _overview: Rendering | None = field(default=None, repr=False)

    def meet(self, view: AnsweredView, pixel: FloatArray, reach_px: float) -> Met | str:
        """Where the ray of a pixel (2,) meets it, or why it does not.

        Args:
            reach_px: how far around the pixel distances will be asked for.
        """
        rough = self._depth(view, pixel)
        if rough is None:
            return "the scan has no points there"
        depth, spacing = rough
        spacing_px = spacing * view.camera.focal_px / depth
        half = max(_SPACINGS * spacing_px, reach_px + spacing_px, _SMALLEST_HALF_PX)
        zoom = min(1.0, _LARGEST_HALF_PX / half)
        window, corner, scale = window_camera(view.camera, pixel, half, zoom)
        drawn = render(self.cloud, window, view.cam_from_local, RenderOptions(attributes=False))
        around = _Window(depth=drawn.depth, corner=corner, scale=scale)
        ray = view.rays(pixel[None])[0]
        viewer = view.cam_from_local.center
        nearest = around.nearest(pixel, spacing_px)
        if nearest is None:
            return "the scan has no points there"
        place = viewer + ray * nearest
        shown = self.cloud.xyz[np.unique(drawn.index[drawn.index >= 0])].astype(np.float64)
        near = shown[np.linalg.norm(shown - place, axis=1) < _SPACINGS * spacing]
        tolerance = _TOLERANCE_SPACINGS * spacing
        patch = fit_patch(near, place, viewer, tolerance)
        if patch is None:
            return f"the {len(near)} points of the scan around lie on no surface"
        common = 0.5 * patch.scatter_m if self.common_m is None else self.common_m
        sigma = float(np.linalg.norm([patch.fitted_m, common, _ROUNDING_M]))
        return Met(patch=patch, sigma_m=sigma, spacing_m=spacing, tolerance_m=tolerance, around=around)

    def _depth(self, view: AnsweredView, pixel: FloatArray) -> tuple[float, float] | None:
        """Metres along the axis and between points, of an overview that is drawn once."""
        if self._overview is None:
            camera = view.camera
            shrink = min(1.0, _OVERVIEW_PX / max(camera.width, camera.height))
            small = resampled(camera, shrink)
            self._overview = render(self.cloud, small, view.cam_from_local, RenderOptions(attributes=False))
        drawn = self._overview
        at = pixel * (drawn.camera.width / view.camera.width)
        column, row = (int(v) for v in np.minimum(at, [drawn.camera.width - 1, drawn.camera.height - 1]))
        part = (slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3))
        depth, index = drawn.depth[part], drawn.index[part]
        if not np.isfinite(depth).any():
            return None
        own = index[index >= 0]
        spacing = self.cloud.spacing_m
        assert spacing is not None
        apart = float(np.median(spacing[own])) if len(own) else float(np.median(spacing))
        return float(np.nanmin(depth)), max(apart, 1e-3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapSurface:
    """Points (n, 3) of a map in the frame of the view, those that the photo should show."""

    points: FloatArray
    kind: str = "map"
    doubt: str = ""

    def meet(self, view: AnsweredView, pixel: FloatArray, reach_px: float) -> Met | str:
        """As `ScanSurface.meet`."""
        pixels = view.camera.project(view.cam_from_local.act(self.points))
        apart = np.linalg.norm(pixels - pixel, axis=1)
        nearest = np.argsort(np.where(np.isfinite(apart), apart, np.inf), kind="stable")[:_NEAREST_POINTS]
        near = self.points[nearest]
        if len(near) < _NEAREST_POINTS:
            return "the map has no points there"
        ray = view.rays(pixel[None])[0]
        depth = view.cam_from_local.act(near)[:, 2]
        viewer = view.cam_from_local.center
        place = viewer + ray * float(np.median(depth))
        spacing = float(np.sqrt(np.pi) * np.linalg.norm(near - place, axis=1).max() / np.sqrt(len(near)))
        around = (pixels[nearest] - pixel) / apart[nearest].max()
        if np.linalg.norm(around.mean(axis=0)) > 0.5:  # all on one side: the plane would be a guess
            return "the map's points lie beside the pixel"
        tolerance = _TOLERANCE_SPACINGS * spacing
        patch = fit_patch(near, place, viewer, tolerance)
        if patch is None or patch.share < 0.5:
            return "the map's points around lie on no surface"
        # Between points so far apart the surface may do what it does at them.
        sigma = float(np.hypot(patch.fitted_m, patch.scatter_m))
        return Met(
            patch=patch,
            sigma_m=sigma,
            spacing_m=spacing,
            tolerance_m=tolerance,
            around=lambda pixels: np.full(len(pixels), np.nan),  # so few points show no edges
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """Depth (h, w) of a window; its corner (2,) in the photo, and its pixels per pixel of the photo."""

    depth: NDArray[np.float32]
    corner: FloatArray
    scale: float

    def __call__(self, pixels: FloatArray) -> FloatArray:
        at = np.floor((pixels - self.corner) * self.scale).astype(np.int64)
        height, width = self.depth.shape
        inside = ((at >= 0) & (at < [width, height])).all(axis=1)
        found = np.full(len(pixels), np.nan)
        found[inside] = self.depth[at[inside, 1], at[inside, 0]]
        return found

    def nearest(self, pixel: FloatArray, within_px: float) -> float | None:
        """Depth at a pixel, or in a gap between points at what is shown nearest to it."""
        rows, columns = np.nonzero(np.isfinite(self.depth))
        if not len(rows):
            return None
        away = (np.column_stack([columns, rows]) + 0.5) / self.scale + self.corner - pixel
        apart = np.hypot(away[:, 0], away[:, 1])
        best = int(np.argmin(apart))
        if apart[best] > max(within_px, 1.0 / self.scale):
            return None
        return float(self.depth[rows[best], columns[best]])


RaySurface = ScanSurface | MapSurface


def scan_surface(
    database: Database, view: AnsweredView, box: PlanBox = (-REACH_M, -REACH_M, REACH_M, REACH_M)
) -> ScanSurface | None:
    """The scans around the camera whose heights are of the answer's datum; None where there are none.

    Args:
        box: in the view's frame, what is loaded.
    """
    if not database.has(LIDAR):
        return None
    scans = [s.scan_id for s in list_scans(database) if s.height_datum == view.height_datum]
    if not scans:
        return None
    cloud = load_cloud(database, view.frame, box, scan_ids=scans)
    unsure = view.height_datum == "unknown" and not _placed_by_scans(database, view)
    return ScanSurface(cloud=cloud, doubt=_UNKNOWN_HEIGHTS if unsure else "") if len(cloud) else None


def _placed_by_scans(database: Database, view: AnsweredView) -> bool:
    """Whether all that the answer stands on is maps that scans placed, whose heights are thus a scan's."""
    maps = {m.map_id: m for m in database.snapshot().maps(include_retired=True)}
    traced = [trace(map_id, maps).anchors if map_id in maps else () for map_id in view.map_ids]
    return bool(traced) and all(
        anchors and all(maps[anchor].method == "lidar" for anchor in anchors) for anchors in traced
    )


def window_camera(
    camera: Camera, pixel: FloatArray, half_px: float, zoom: float
) -> tuple[Camera, FloatArray, float]:
    """The lens for a square of the picture around a pixel.

    Returns:
        The lens; the square's corner (2,) in the picture; its pixels per pixel of the picture.
    """
    side = max(2 * int(np.ceil(half_px * zoom)) + 1, 3)
    small = resampled(camera, zoom)
    scale = small.width / camera.width
    corner = np.floor(pixel * scale) - side // 2
    params = np.array(small.params)
    params[small.to_pycolmap().principal_point_idxs()] -= corner
    return replace(small, width=side, height=side, params=tuple(params)), corner / scale, scale


def resampled(camera: Camera, zoom: float) -> Camera:
    """The lens for a smaller picture, by the same factor in both directions: that of the widths.

    Where that leaves a part of a row, the picture has the row, however far that is from the aspect ratio.
    """
    if zoom >= 1.0:
        return camera
    width = max(round(camera.width * zoom), 1)
    scale = width / camera.width
    lens, params = camera.to_pycolmap(), np.array(camera.params)
    params[[*lens.focal_length_idxs(), *lens.principal_point_idxs()]] *= scale
    return replace(camera, width=width, height=int(np.ceil(camera.height * scale)), params=tuple(params))
