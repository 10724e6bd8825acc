"""Pictures of an anchoring: the scan's edges over a photo, the map over the scan, residuals; a page to flick
through proposed frames: one file, no network.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
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
from ingest.html_parts import STYLE
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
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis)) / np.minimum(
            *(np.take(depth, range(i, depth.shape[axis] - 1 + i), axis) for i in (0, 1))
        )
        mark = np.nan_to_num(step, nan=0.0) > _DEPTH_STEP
        jump |= np.pad(mark, [(0, int(axis == 0)), (0, int(axis == 1))])
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


def overlay_rgb(photo_rgb: NDArray[np.uint8], view: Rendering) -> NDArray[np.uint8]:
    """The scan's edges over the photo, (h, w, 3), at the size of the view."""
    photo = resized(photo_rgb, view.camera)
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    # Half grey: the edges must stand out in whatever colours the photo has.
    base = 0.5 * photo + 0.5 * gray[:, :, None]
    layer = edge_layer(view)
    alpha = layer[:, :, 3:].astype(np.float32) / 255.0
    return np.asarray(np.rint((1 - alpha) * base + alpha * layer[:, :, :3]), dtype=np.uint8)


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
    for points, colour, label in ((before_local, _BEFORE, "before"), (after_local, _AFTER, "after")):
        few = _thinned(points, 8000)
        top.plot(few[:, 0], few[:, 1], ".", ms=1.2, color=colour)
        top.plot([], [], "o", ms=5, color=colour, label=f"map points {label}")
    top.plot(centers_local[:, 0], centers_local[:, 1], "^", ms=5, color=_INK, label="cameras after")
    top.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", ylabel="north, m")
    top.legend(loc="upper right", fontsize=8, framealpha=0.9)
    side.plot(scan[:, 0], scan[:, 2], ",", color=_SCAN)
    for points, colour in ((before_local, _BEFORE), (after_local, _AFTER)):
        few = _thinned(points, 8000)
        side.plot(few[:, 0], few[:, 2], ".", ms=1.2, color=colour)
    heights = np.percentile(np.concatenate([before_local[:, 2], after_local[:, 2]]), (0.5, 99.5))
    margin = 0.15 * (heights[1] - heights[0]) + 1.0
    side.set(
        xlim=(low[0], high[0]),
        ylim=(heights[0] - margin, heights[1] + margin),
        xlabel="east, m",
        ylabel="up, m",
    )
    for axes in (top, side):
        _tidy(axes)
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
    _tidy(axes)
    return png_bytes(figure)


def _bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    low, high = np.percentile(points[:, :2], (0.5, 99.5), axis=0)
    margin = 0.1 * (high - low) + 2.0
    return low - margin, high + margin


def _thinned(points: NDArray[Any], most: int = _MAX_POINTS) -> NDArray[Any]:
    return points[:: max(1, -(-len(points) // most))]


def _tidy(axes: Any) -> None:
    axes.tick_params(labelsize=8)
    axes.grid(color="#e6ebef", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


_PAGE_STYLE = """
main{max-width:1320px}.stage{position:relative;background:#111;border-radius:8px;overflow:hidden;line-height:0}
.stage img{display:block;width:100%;margin:0;position:absolute;left:0;top:0}
.stage img.photo{position:relative}
.bar{all:unset}.controls{display:flex;flex-wrap:wrap;gap:18px;align-items:center;margin:12px 0}
.controls input[type=range]{width:320px}.tabs{display:flex;flex-wrap:wrap;gap:8px;margin:14px 0}
.tabs button{border:1px solid var(--line);background:#fff;border-radius:8px;padding:6px 12px;font:inherit;
cursor:pointer}.tabs button.on{border-color:var(--ink);font-weight:600}
.frame{display:none}.frame.on{display:block}
pre.command{background:#eef1f4;padding:10px 14px;border-radius:8px;user-select:all}
"""
# The only script of the page: it switches frames and blends two pictures.
_SCRIPT = """
const frames=[...document.querySelectorAll('.frame')],tabs=[...document.querySelectorAll('.tabs button')];
const blend=document.getElementById('blend'),edges=document.getElementById('edges');let at=0;
function show(i){at=(i+frames.length)%frames.length;
 frames.forEach((f,k)=>f.classList.toggle('on',k===at));tabs.forEach((t,k)=>t.classList.toggle('on',k===at));paint()}
function paint(){document.querySelectorAll('img.scan').forEach(e=>e.style.opacity=blend.value/100);
 document.querySelectorAll('img.edges').forEach(e=>e.style.display=edges.checked?'block':'none')}
tabs.forEach((t,k)=>t.addEventListener('click',()=>show(k)));
blend.addEventListener('input',paint);edges.addEventListener('change',paint);
document.addEventListener('keydown',e=>{if(e.target===blend)return;
 if(e.key==='ArrowRight')show(at+1);else if(e.key==='ArrowLeft')show(at-1);
 else if(e.key===' '){blend.value=blend.value>50?0:100;paint();e.preventDefault()}
 else if(e.key==='e'){edges.checked=!edges.checked;paint()}});
if(frames.length)show(0);
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePicture:
    """One frame of the page.

    Attributes:
        name: of the photo.
        photo_rgb: (h, w, 3) of any size.
        view: the scan from the pose that is shown.
        verdict: good (registered), fair (shown from where the registration would start) or bad (refused).
        headline: one line about the pose; details: further lines.
        command: what a person runs to confirm this frame, "" where there is nothing to confirm.
    """

    name: str
    photo_rgb: NDArray[np.uint8]
    view: Rendering
    verdict: str
    headline: str
    details: tuple[str, ...] = ()
    command: str = ""


def flick_page(title: str, introduction: str, frames: Sequence[FramePicture]) -> str:
    """The page as HTML. Arrow keys change the frame, space swaps photo and scan, e switches the edges."""
    tabs = "".join(f"<button>{escape(frame.name)}</button>" for frame in frames)
    body = "".join(_frame(frame) for frame in frames)
    controls = (
        '<div class="controls"><label>photo <input type="range" id="blend" min="0" max="100" value="0"> scan'
        '</label><label><input type="checkbox" id="edges" checked> edges of the scan (red: depth, blue: '
        'colour or intensity)</label><span class="soft">arrow keys: next frame; space: photo or scan; '
        "e: edges</span></div>"
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}{_PAGE_STYLE}</style></head><body><main>"
        f"<h1>{escape(title)}</h1><p>{escape(introduction)}</p>"
        f'<div class="tabs">{tabs}</div>{controls}{body}</main><script>{_SCRIPT}</script></body></html>\n'
    )


def _frame(frame: FramePicture) -> str:
    photo = resized(frame.photo_rgb, frame.view.camera)
    details = "".join(f"<p class='soft'>{escape(line)}</p>" for line in frame.details)
    command = ""
    if frame.command:
        command = (
            "<p>If the edges lie on the photo, confirm it:</p>"
            f'<pre class="command">{escape(frame.command)}</pre>'
        )
    return (
        f'<div class="frame"><div class="stage">{_image("photo", "jpeg", jpeg(photo))}'
        f"{_image('scan', 'jpeg', jpeg(view_rgb(frame.view)))}"
        f"{_image('edges', 'png', png(edge_layer(frame.view)))}</div>"
        f'<p><span class="pill {frame.verdict}">{escape(frame.name)}</span> {escape(frame.headline)}</p>'
        f"{details}{command}</div>"
    )


def _image(kind: str, form: str, data: bytes) -> str:
    return (
        f'<img class="{kind}" alt="{kind}" '
        f'src="data:image/{form};base64,{base64.b64encode(data).decode("ascii")}">'
    )
