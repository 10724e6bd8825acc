"""Poses of photos by registering each one directly to a coloured scan, by dense correspondences.

What tools/scan_poses.py runs. It shares no code with the map, anchoring or localisation: laspy reads the
scan, PROJ makes the topocentric frame, numpy rasters and renders, OpenCV matches and solves. The first pose
comes from SIFT between the photo and a nadir raster of the scan; then the scan is rendered from that pose,
tracked into the photo at thousands of places, and all photos' poses are estimated together with one camera.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pyproj
from numpy.typing import NDArray

Floats = NDArray[np.float64]
RASTER_M = 0.06  # cell of the nadir raster: about the spacing of a dense photogrammetric scan
RENDER_WIDTH = 1600  # px; finer than the scan's points gains nothing


@dataclass(frozen=True, slots=True)
class GrayScan:
    """Points, and the grey of their colours, in an east-north-up frame at `origin` (easting, northing,
    height in the file's CRS)."""

    xyz: Floats
    gray: NDArray[np.uint8]
    origin: tuple[float, float, float]
    crs: str


@dataclass(frozen=True, slots=True)
class Lens:
    """OpenCV's pinhole: f, cx, cy, k1, k2, p1, p2; its pixels: centre of the top-left pixel at (0, 0)."""

    width: int
    height: int
    values: Floats

    def matrix(self) -> Floats:
        f, cx, cy = self.values[:3]
        return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])

    def distortion(self) -> Floats:
        return self.values[3:]

    def scaled(self, width: int) -> "Lens":
        s = width / self.width
        centre = (self.values[1:3] + 0.5) * s - 0.5
        values = np.concatenate([self.values[:1] * s, centre, self.values[3:]])
        return Lens(width, round(self.height * s), values)


@dataclass(frozen=True, slots=True)
class PosedPicture:
    name: str
    gray: NDArray[np.uint8]
    pose: Floats  # (6,) rotation vector and translation, camera from scan
    world: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))


def read_scan(path: Path) -> GrayScan:
    las = laspy.read(path)
    crs = las.header.parse_crs()
    grid = np.column_stack([las.x, las.y, las.z]).astype(np.float64)
    origin = tuple(np.round(np.median(grid, axis=0)).tolist())
    rgb = np.column_stack([las.red, las.green, las.blue])
    if rgb.max() > 255:
        rgb = rgb >> 8
    gray = cv2.cvtColor(rgb[:, None].astype(np.uint8), cv2.COLOR_RGB2GRAY)[:, 0]
    return GrayScan(_local(grid, crs, origin), gray, origin, crs.to_string())


def _local(grid: Floats, crs: pyproj.CRS, origin: tuple[float, float, float]) -> Floats:
    """East, north, up (n, 3) of projected coordinates (n, 3) at an origin given in these, by PROJ."""
    to_geodetic = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    lon, lat = to_geodetic.transform(origin[0], origin[1])
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={origin[2]!r}"
    )
    lon, lat = to_geodetic.transform(grid[:, 0], grid[:, 1])
    return np.column_stack(pipeline.transform(lon, lat, grid[:, 2])).astype(np.float64)


def nadir_raster(scan: GrayScan) -> tuple[NDArray[np.uint8], Floats, Floats]:
    """The scan from above, north up: picture, heights, both filled where no point fell, and the south-west
    corner."""
    low = scan.xyz.min(axis=0)
    column, row = ((scan.xyz[:, :2] - low[:2]) / RASTER_M).astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    order = np.argsort(scan.xyz[:, 2])  # the highest point of a cell is written last
    heights = np.full(shape, np.nan)
    heights[row[order], column[order]] = scan.xyz[order, 2]
    picture = np.zeros(shape, np.uint8)
    picture[row[order], column[order]] = scan.gray[order]
    empty = np.isnan(heights).astype(np.uint8)
    filled = cv2.inpaint(picture, empty, 3, cv2.INPAINT_TELEA)
    known = np.nan_to_num(heights[::-1], nan=0).astype(np.float32)
    return filled[::-1].copy(), cv2.inpaint(known, empty[::-1].copy(), 3, cv2.INPAINT_NS), low


def first_pose(photo: NDArray[np.uint8], lens: Lens, raster: tuple, scan_features: tuple) -> Floats | None:
    """Pose by SIFT against the raster and RANSAC PnP, or None."""
    picture, heights, low = raster
    keypoints, descriptors = scan_features
    size = (RENDER_WIDTH // 2, round(photo.shape[0] * RENDER_WIDTH / 2 / photo.shape[1]))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    found, described = cv2.SIFT_create(6000).detectAndCompute(small, None)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    pairs = [m for m, n in matcher.knnMatch(described, descriptors, k=2) if m.distance < 0.8 * n.distance]
    scale = photo.shape[1] / small.shape[1]
    pixels = np.array([found[m.queryIdx].pt for m in pairs]) * scale
    at = np.array([keypoints[m.trainIdx].pt for m in pairs])
    up = heights[at[:, 1].round().astype(int), at[:, 0].round().astype(int)]
    east, north = at[:, 0] + 0.5, picture.shape[0] - at[:, 1] - 0.5
    world = np.column_stack([low[0] + east * RASTER_M, low[1] + north * RASTER_M, up])
    camera = lens.matrix(), lens.distortion()
    search = {"iterationsCount": 20000, "reprojectionError": 20.0, "flags": cv2.SOLVEPNP_AP3P}
    done, rvec, tvec, inliers = cv2.solvePnPRansac(world, pixels, *camera, **search)
    if not done or len(inliers) < 30:
        return None
    rvec, tvec = cv2.solvePnPRefineLM(world[inliers[:, 0]], pixels[inliers[:, 0]], *camera, rvec, tvec)
    return np.concatenate([rvec.ravel(), tvec.ravel()])


def render(scan: GrayScan, lens: Lens, pose: Floats) -> tuple[NDArray[np.uint8], NDArray[np.int64], Floats]:
    """Gray picture, point index (-1 where empty) and the points' projections, by splats in order of depth."""
    rotation = cv2.Rodrigues(pose[:3])[0]
    camera_points = scan.xyz @ rotation.T + pose[3:]
    projected = np.full((len(scan.xyz), 2), -1e6)
    front = camera_points[:, 2] > 1.0
    # Beyond the picture's corners the lens polynomial may fold back: keep to what is within 1.3 of them.
    f, *corner = lens.values[:3]
    slope = np.hypot(*(camera_points[front, :2] / camera_points[front, 2:]).T)
    front[np.flatnonzero(front)[slope > 1.3 * np.hypot(*corner) / f]] = False
    camera = lens.matrix(), lens.distortion()
    projected[front] = cv2.projectPoints(scan.xyz[front], pose[:3], pose[3:], *camera)[0][:, 0]
    depth = camera_points[:, 2]
    size = (lens.width + 4, lens.height + 4)
    rows = np.flatnonzero(front & (projected > -5).all(axis=1) & (projected < size).all(axis=1))
    rows = rows[np.argsort(-depth[rows])]  # far first, near written last
    index = np.full((lens.height, lens.width), -1, np.int64)
    radius = max(1, round(0.5 * f / float(np.median(depth[rows])) * 0.12))
    nearest = np.full(index.shape, np.inf)
    offsets = [(i, j) for i in range(-radius, radius + 1) for j in range(-radius, radius + 1)]
    offsets.sort(key=lambda o: -(o[0] ** 2 + o[1] ** 2))  # a point's own pixel wins over its neighbours'
    for dy, dx in offsets:
        column, row = (projected[rows].round().astype(np.int64) + np.array([dx, dy])).T
        ok = (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
        layer = np.full(index.shape, np.inf)
        layer_index = np.full(index.shape, -1, np.int64)
        layer[row[ok], column[ok]] = depth[rows[ok]]
        layer_index[row[ok], column[ok]] = rows[ok]
        # Nearer by more than a surface's own unevenness, or as near and closer to the splat's centre.
        better = layer < nearest + 0.15
        nearest[better], index[better] = layer[better], layer_index[better]
    picture = np.where(index >= 0, scan.gray[index], 0).astype(np.uint8)
    return picture, index, projected


def correspond(photo: PosedPicture, lens: Lens, scan: GrayScan) -> PosedPicture:
    """The photo with new correspondences: places of the render tracked into the photo."""
    small = lens.scaled(RENDER_WIDTH)
    picture, index, projected = render(scan, small, photo.pose)
    target = cv2.resize(photo.gray, (small.width, small.height), interpolation=cv2.INTER_AREA)
    target = cv2.GaussianBlur(target, (0, 0), 1.5)  # the scan's own sharpness
    solid = cv2.erode((index >= 0).astype(np.uint8), np.ones((25, 25), np.uint8))
    filled = cv2.inpaint(picture, (index < 0).astype(np.uint8), 3, cv2.INPAINT_TELEA)
    filled = cv2.GaussianBlur(filled, (0, 0), 1)
    a, b = _equal_contrast(filled), _equal_contrast(target)
    corners = cv2.goodFeaturesToTrack(a, 6000, 0.005, 7, mask=solid, blockSize=7)
    settings = {
        "winSize": (31, 31),
        "maxLevel": 2,
        "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 0.005),
    }
    there, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, **settings)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **settings)
    good = (ok[:, 0] & ok_back[:, 0]).astype(bool) & (np.linalg.norm(back - corners, axis=2)[:, 0] < 0.5)
    corners, flow = corners[good, 0], (there - corners)[good, 0]
    rows = index[corners[:, 1].round().astype(int), corners[:, 0].round().astype(int)]
    scale = lens.width / small.width
    pixels = (projected[rows] + flow + 0.5) * scale - 0.5
    return replace(photo, world=scan.xyz[rows], pixels=pixels)


def _equal_contrast(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image less its local mean, over its local deviation: light and colour tables drop out."""
    values = image.astype(np.float32)
    mean = cv2.GaussianBlur(values, (0, 0), 20)
    deviation = np.sqrt(cv2.GaussianBlur((values - mean) ** 2, (0, 0), 20))
    return np.clip(128 + 45 * (values - mean) / (deviation + 4), 0, 255).astype(np.uint8)


def adjust(photos: list[PosedPicture], lens: Lens, free: tuple[int, ...]) -> tuple[list[PosedPicture], Lens]:
    """Poses of all photos and the lens parameters `free` (0 f, 1 cx, 2 cy, 3 k1, 4 k2, 5 p1, 6 p2) from all
    correspondences, robustly (Geman-McClure at three times the spread)."""
    count, poses, values = len(photos), np.array([p.pose for p in photos]), lens.values.copy()
    size = 6 * count + len(free)
    for _ in range(30):
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        current = replace(lens, values=values)
        results = [_linearise(p, pose, current) for p, pose in zip(photos, poses, strict=True)]
        sigma = 1.4826 * float(np.median(np.concatenate([np.abs(r).ravel() for r, _ in results])))
        for i, (residual, jacobian) in enumerate(results):
            squared = (residual**2).sum(axis=1) / (3 * sigma) ** 2
            weight = np.repeat(1 / (1 + squared) ** 2, 2)
            columns = np.concatenate([jacobian[:, :6], jacobian[:, 6:][:, list(free)]], axis=1)
            at = np.concatenate([np.arange(6 * i, 6 * i + 6), np.arange(6 * count, size)])
            normal[np.ix_(at, at)] += columns.T @ (weight[:, None] * columns)
            gradient[at] += columns.T @ (weight * residual.ravel())
        step = np.linalg.solve(normal + 1e-12 * np.diag(np.diag(normal)), gradient)
        poses = poses + step[: 6 * count].reshape(-1, 6)
        values[list(free)] += step[6 * count :]
        if np.abs(step[: 6 * count].reshape(-1, 6)[:, 3:]).max() < 1e-4:
            break
    moved = [replace(p, pose=pose) for p, pose in zip(photos, poses, strict=True)]
    return moved, replace(lens, values=values)


def _linearise(photo: PosedPicture, pose: Floats, lens: Lens) -> tuple[Floats, Floats]:
    """Photo minus projection (n, 2), and the projection's Jacobian (2n, 13) by pose and `Lens.values`."""
    projected, j = cv2.projectPoints(photo.world, pose[:3], pose[3:], lens.matrix(), lens.distortion())
    jacobian = np.column_stack([j[:, :6], j[:, 6] + j[:, 7], j[:, 8:10], j[:, 10:14]])
    return photo.pixels - projected[:, 0], jacobian
