"""Pictures of an anchoring: the scan's edges over a photo, the map over the scan, residuals."""

from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import render
from featuredb.render.rendering import Rendering
from featuredb.render.shading import shaded_relief
from ingest.plot_parts import png_bytes
from ingest.register.anchor.proposals import small_camera

_WIDTH_PX = 1280  # of overlays: a screen's width; more only makes the page heavy
_DEPTH_STEP = 0.015  # share of the depth by which it jumps at an edge: 1 m seen from 70 m
_DEPTH_RGB, _VALUE_RGB = (255, 60, 60), (60, 230, 255)
_DPI = 110
_MAX_POINTS = 60_000  # more only hide each other and cost seconds
_BEFORE, _AFTER, _SCAN, _INK = "#c62828", "#f9a825", "#9aa7b4", "#1b2733"


def scan_view(cloud: PointCloud, camera: Camera, cam_from_local: Rigid3) -> Rendering:
    """The scan as the photo's camera sees it, at the size of an overlay."""
    return render(cloud, small_camera(camera, _WIDTH_PX), cam_from_local)


def view_rgb(view: Rendering) -> NDArray[np.uint8]:
    """The scan as a colour picture (h, w, 3): its colours, else its intensities, else its shaded relief."""
    if view.rgb is not None:
        return view.rgb
    gray = view.intensity if view.intensity is not None else shaded_relief(view)
    return np.repeat(np.asarray(gray, dtype=np.uint8)[:, :, None], 3, axis=2)


def edges_of(view: Rendering) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Edges (h, w) of the scan's depth, and of its colours or intensities (paper, figure 7).

    Depth edges are where the depth jumps between two neighbours that are both seen; the scan's own border and
    its holes are no edges.
    """
    depth = view.depth
    jump = np.zeros(depth.shape, bool)
    for marked, here, there in (
        (jump[:-1], depth[:-1], depth[1:]),
        (jump[:, :-1], depth[:, :-1], depth[:, 1:]),
    ):
        marked |= np.abs(there - here) > _DEPTH_STEP * np.minimum(here, there)  # not where one is NaN
    gray = cv2.cvtColor(view_rgb(view), cv2.COLOR_RGB2GRAY)
    valid = view.valid
    inside = cv2.erode(valid.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.5)
    gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    high = float(np.percentile(gradient[inside], 93)) if inside.any() else 1.0  # the strongest few percent
    canny = cv2.Canny(smooth, 0.4 * high, high, L2gradient=True) > 0
    return jump, canny & inside


def edge_layer(view: Rendering) -> NDArray[np.uint8]:
    """(h, w, 4) colour and alpha: depth edges red, colour or intensity edges light blue, else clear."""
    layer = np.zeros((*view.depth.shape, 4), np.uint8)
    depth_edges, value_edges = edges_of(view)
    layer[value_edges] = (*_VALUE_RGB, 220)
    thick = cv2.dilate(depth_edges.astype(np.uint8), np.ones((2, 2), np.uint8)).astype(bool)
    layer[thick] = (*_DEPTH_RGB, 255)
    return layer


def resized(photo_rgb: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """The photo at the size of a camera."""
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(photo_rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def png(rgb_or_rgba: NDArray[np.uint8]) -> bytes:
    """As a PNG file."""
    order = cv2.COLOR_RGBA2BGRA if rgb_or_rgba.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return bytes(cv2.imencode(".png", cv2.cvtColor(rgb_or_rgba, order))[1])


def jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """As a JPEG file."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def map_over_scan_png(
    cloud: PointCloud, before_local: FloatArray, after_local: FloatArray, centers_local: FloatArray
) -> bytes:
    """Map points over the scan in plan and in side view, before and after (paper, figure 8).

    Args:
        before_local, after_local: (n, 3) map points; centers_local: (k, 3) cameras after; all in the cloud's
            frame, metres.
    """
    low, high = _bounds(np.vstack([before_local, after_local, centers_local]))
    scan = _thinned(cloud.xyz[((cloud.xyz[:, :2] >= low) & (cloud.xyz[:, :2] <= high)).all(axis=1)])
    width, height = high - low
    figure = Figure(figsize=(9.2, 9.2), dpi=_DPI, facecolor="white", layout="constrained")
    ratio = float(np.clip(height / width, 0.35, 1.6))
    top, side = figure.subplots(2, 1, height_ratios=(2.4 * ratio, 1.2))
    colours = np.percentile(scan[:, 2], (1, 99)) if len(scan) else (0.0, 1.0)
    top.scatter(scan[:, 0], scan[:, 1], s=0.6, c=scan[:, 2], cmap="Greys_r", vmin=colours[0], vmax=colours[1])
    side.plot(scan[:, 0], scan[:, 2], ",", color=_SCAN)
    for points, colour, label in ((before_local, _BEFORE, "before"), (after_local, _AFTER, "after")):
        few = _thinned(points, 8000)
        top.plot(few[:, 0], few[:, 1], ".", ms=1.2, color=colour)
        side.plot(few[:, 0], few[:, 2], ".", ms=1.2, color=colour)
        top.plot([], [], "o", ms=5, color=colour, label=f"map points {label}")
    top.plot(centers_local[:, 0], centers_local[:, 1], "^", ms=5, color=_INK, label="cameras after")
    top.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", ylabel="north, m")
    top.legend(loc="upper right", fontsize=8, framealpha=0.9)
    heights = np.percentile(np.concatenate([before_local[:, 2], after_local[:, 2]]), (0.5, 99.5))
    margin = 0.15 * (heights[1] - heights[0]) + 1.0
    side.set(
        xlim=(low[0], high[0]),
        ylim=(heights[0] - margin, heights[1] + margin),
        xlabel="east, m",
        ylabel="up, m",
    )
    return png_bytes(figure)


def residuals_png(before_m: FloatArray, after_m: FloatArray) -> bytes:
    """Histogram of the distances from map points to the scan, before and after."""
    figure = Figure(figsize=(9.2, 2.9), dpi=_DPI, facecolor="white", layout="constrained")
    axes = figure.subplots()
    both = np.concatenate([before_m, after_m])
    low = max(float(np.percentile(both, 1)) if len(both) else 0.01, 0.005)
    high = max(float(np.percentile(both, 99.5)) if len(both) else 1.0, 2 * low)
    bins = np.geomspace(low, high, 60)
    for values, colour, label in ((before_m, _BEFORE, "before"), (after_m, "#2e7d32", "after")):
        if len(values):
            axes.hist(
                np.clip(values, low, high),
                bins=list(bins),
                color=colour,
                alpha=0.6,
                label=f"{label}: median {np.median(values):.3f} m",
            )
    axes.set(xscale="log", xlabel="distance of a map point to the scan, m", ylabel="map points")
    axes.legend(fontsize=8)
    return png_bytes(figure)


def _bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    low, high = np.percentile(points[:, :2], (0.5, 99.5), axis=0)
    margin = 0.1 * (high - low) + 2.0
    return low - margin, high + margin


def _thinned(points: NDArray[Any], most: int = _MAX_POINTS) -> NDArray[Any]:
    return points[:: max(1, -(-len(points) // most))]
