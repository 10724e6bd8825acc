"""The page of an anchoring: frames to flick through with the scan over them, the map before and after."""

import shlex
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering, render, shaded_relief
from ingest.html_parts import folded, note, page, picture, pill, table
from ingest.plot_parts import png_bytes
from ingest.register.anchor.anchor_map import AnchorResult
from ingest.register.anchor.frames import TriedFrame
from ingest.register.anchor.proposals import small_camera
from ingest.register.anchor.report import FRAME_HEADER, AnchorReport, frame_rows, report_json
from ingest.register.anchor.together import TOGETHER
from ingest.register.structure.surface_fit import median_m
from ingest.workspace import write_json_and_page

_WIDTH_PX = 1280  # of overlays: a screen's width; more only makes the page heavy
_DEPTH_STEP = 0.015  # share of the depth by which it jumps at an edge: 1 m seen from 70 m
_DEPTH_RGB, _VALUE_RGB = (255, 60, 60), (60, 230, 255)
_DPI = 110
_MAX_POINTS = 60_000  # more only hide each other and cost seconds
_BEFORE, _AFTER, _SCAN, _INK = "#c62828", "#f9a825", "#9aa7b4", "#1b2733"

PhotoRgb = Callable[[MapImage], NDArray[np.uint8]]

_STYLE = """
.stage{position:relative;background:#111;border-radius:8px;overflow:hidden;line-height:0}
.stage img{display:block;width:100%;margin:0;position:absolute;left:0;top:0}
.stage img.photo{position:relative}
.controls{display:flex;flex-wrap:wrap;gap:18px;align-items:center;margin:12px 0}
.controls input[type=range]{width:320px}.tabs{display:flex;flex-wrap:wrap;gap:8px;margin:14px 0}
.tabs button{border:1px solid var(--line);background:#fff;border-radius:8px;padding:6px 12px;font:inherit;
cursor:pointer}.tabs button.on{border-color:var(--ink);font-weight:600}
.frame{display:none}.frame.on{display:block}
pre.command{background:#eef1f4;padding:10px 14px;border-radius:8px;user-select:all}
main{max-width:1320px}
"""
# It switches frames and blends two pictures.
_SCRIPT = """
const frames=[...document.querySelectorAll('.frame')],tabs=[...document.querySelectorAll('.tabs button')];
const blend=document.getElementById('blend'),edges=document.getElementById('edges');let at=0;
function show(i){at=(i+frames.length)%frames.length;
 frames.forEach((f,k)=>f.classList.toggle('on',k===at));tabs.forEach((t,k)=>t.classList.toggle('on',k===at));paint()}
function paint(){document.querySelectorAll('img.scan').forEach(e=>e.style.opacity=blend.value/100);
 document.querySelectorAll('img.edges').forEach(e=>e.style.display=edges.checked?'block':'none')}
tabs.forEach((t,k)=>t.addEventListener('click',()=>show(k)));
blend.addEventListener('input',paint);edges.addEventListener('change',paint);
document.addEventListener('keydown',e=>{if(e.target===blend||e.target.tagName==='SUMMARY')return;
 if(e.key==='ArrowRight')show(at+1);else if(e.key==='ArrowLeft')show(at-1);
 else if(e.key===' '){blend.value=blend.value>50?0:100;paint();e.preventDefault()}
 else if(e.key==='e'){edges.checked=!edges.checked;paint()}});
show(0);
"""
_CONTROLS = (
    '<div class="controls"><label>photo <input type="range" id="blend" min="0" max="100" value="0"> scan'
    '</label><label><input type="checkbox" id="edges" checked> edges of the scan (red: depth, blue: '
    'colour or intensity)</label><span class="soft">arrow keys: next frame; space: photo or scan; '
    "e: edges</span></div>"
)


def write_anchor_report(
    folder: Path, report: AnchorReport, old: FeatureMap, cloud: PointCloud, read_rgb: PhotoRgb, command: str
) -> Path:
    """Write `anchor.json` and `anchor.html` (see `anchor_page`) into the folder; the path of the page."""
    html = anchor_page(report, old, cloud, read_rgb, command)
    return write_json_and_page(folder / "anchor", report_json(report), html)


def anchor_page(
    report: AnchorReport, old: FeatureMap, cloud: PointCloud, read_rgb: PhotoRgb, command: str
) -> str:
    """The page as HTML, pictures inside.

    Args:
        old: the map before. read_rgb: colours (h, w, 3) of a photo of the map.
        command: that confirms a proposed frame, whose name goes in the place of {image}.
    """
    title = f"Anchoring of {report.map_name}"
    result = report.result
    state = pill("good", "placed") if report.placed else pill("bad", "not placed")
    if result is None:
        state = pill("fair", "proposed, nothing is changed")
    parts = [
        f"<h1>{escape(title)} {state}</h1>",
        f'<p class="soft">map <code>{escape(report.map_id)}</code> of '
        f"<code>{escape(report.database)}</code>, "
        f"scans <code>{escape(', '.join(report.scan_ids))}</code></p>",
    ]
    if result is not None and result.reason:
        parts.append(f'<p class="note stop"><b>{escape(result.reason)}</b>: {escape(result.message)}</p>')
    parts += [note(text) for text in report.notes]
    if result is not None and result.feature_map is not None:
        parts.append(_placed_section(report, result, old, cloud))
    rows = [["" if v is None else str(v) for v in row] for row in frame_rows(report)]
    frames = [_frame(report, frame, old, cloud, read_rgb, command) for frame in report.tried.tried]
    if frames:
        tabs = "".join(f"<button>{escape(frame.image.name)}</button>" for frame in report.tried.tried)
        words = "Photos of the map with the edges of the scan, as the scan looks from each photo's pose."
        parts += ["<h2>Frames</h2>", f"<p>{words}</p>", f'<div class="tabs">{tabs}</div>', _CONTROLS, *frames]
    every = table(FRAME_HEADER, rows, numbers=(1, 2, 3, 5, 6, 7), names=(0,))
    parts.append(f"<h2>All frames</h2><section class='wide'>{every}</section>")
    times = [(name, f"{seconds:.2f} s") for name, seconds in report.times_s().items()]
    parts.append("<h2>Time</h2><section>" + table((), times, numbers=(1,), names=(0,)) + "</section>")
    parts.append(folded("Everything", report_json(report)))
    return page(title, parts, _STYLE, _SCRIPT if frames else "")


def _frame(
    report: AnchorReport,
    tried: TriedFrame,
    old: FeatureMap,
    cloud: PointCloud,
    read_rgb: PhotoRgb,
    command: str,
) -> str:
    """A tried frame; a refused one as the scan looks from where its registration started."""
    result = report.result
    last = result.rounds[-1].frames if result and result.rounds else ()
    again = {frame.image.image_id: frame for frame in last}
    registration = again.get(tried.image.image_id, tried).registration
    pose, lens = registration.cam_from_local, registration.camera or old.cameras[tried.image.camera_id]
    if pose is None:
        pose = tried.proposal.prior.cam_from_local
        kind, details = "bad", ""
        headline = f"{registration.reason}: {registration.message}. Shown from where its search started."
    else:
        kind, details = "good", f"<p class='soft'>{escape(_evidence_line(registration.evidence))}</p>"
        headline = f"registered by {registration.source} with {len(registration.pixels)} correspondences"
        if result is None:
            line = escape(command.replace("{image}", shlex.quote(tried.image.name)))
            details += f'<p>If the edges lie on the photo, confirm it:</p><pre class="command">{line}</pre>'
    view = scan_view(cloud, lens, pose)
    size = (view.camera.width, view.camera.height)
    photo = np.asarray(cv2.resize(read_rgb(tried.image), size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    stage = (
        picture(jpeg(photo), "photo", "jpeg", "photo")
        + picture(jpeg(view_rgb(view)), "scan", "jpeg", "scan")
        + picture(png(edge_layer(view)), "edges of the scan", "png", "edges")
    )
    return (
        f'<div class="frame"><div class="stage">{stage}</div>'
        f"<p>{pill(kind, tried.image.name)} {escape(headline)}</p>{details}</div>"
    )


def _evidence_line(evidence: Mapping[str, Any]) -> str:
    parts = ("confirmation", TOGETHER)
    pictures = {f"{part} {k}": v for part in parts for k, v in evidence.get(part, {}).items()}
    shown = {
        k: v
        for k, v in {**evidence, **pictures}.items()
        if isinstance(v, (int, float, str)) and not isinstance(v, bool) and v != ""
    }
    return ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items())


def _placed_section(report: AnchorReport, result: AnchorResult, old: FeatureMap, cloud: PointCloud) -> str:
    new, before, after, move = result.feature_map, result.before, result.after, result.checks["move"]
    assert new is not None
    assert before is not None
    assert after is not None
    facts = [
        ("heights", f"{report.datum_before} before, {report.datum_after} after"),
        ("map points to scan", f"median {median_m(before):.2f} m before, {median_m(after):.3f} m after"),
        ("moved", f"{move['horizontal_m']:.2f} m in plan, {move['up_m']:+.2f} m up"),
        ("turned", f"{move['heading_deg']:+.2f} degrees about the vertical, {move['tilt_deg']:.2f} tilted"),
        ("scale", f"{move['scale']:.5f}"),
        ("placement, 1 sigma", _sigmas(new)),
        *(
            (f"focal length of camera {k}", f"{was.focal_px:.1f} px before, {now.focal_px:.1f} px after")
            for k, (was, now) in enumerate(zip(old.cameras, new.cameras, strict=True))
        ),
    ]
    centers = cloud.frame.enu_from(new.frame).act([image.cam_from_local.center for image in new.images])
    was_at, is_at = (of.points_local(cloud.frame) for of in (old, new))
    drawn = map_over_scan_png(cloud, was_at, is_at, centers)
    over = picture(drawn, "Map points over the scan, before and after")
    far = residuals_png(before, after)
    distances = picture(far, "Distances of map points to the scan, before and after")
    return f"<h2>The map</h2><section>{table((), facts, names=(0,))}{over}{distances}</section>"


def _sigmas(feature_map: FeatureMap) -> str:
    middle = np.median(feature_map.points_local(), axis=0)
    jacobian = point_jacobian(middle)
    spread = np.sqrt(np.diag(jacobian @ feature_map.placement.covariance @ jacobian.T))
    turn = np.degrees(np.sqrt(np.diag(feature_map.placement.covariance)[1:4]).max())
    return f"east {spread[0]:.3f}, north {spread[1]:.3f}, up {spread[2]:.3f} m, {turn:.3f} degrees"


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
    everything = np.vstack([before_local, after_local, centers_local])[:, :2]
    low, high = np.percentile(everything, (0.5, 99.5), axis=0)
    edge = 0.1 * (high - low) + 2.0
    low, high = low - edge, high + edge
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
    bottom, ceiling = np.percentile(np.concatenate([before_local[:, 2], after_local[:, 2]]), (0.5, 99.5))
    margin = 0.15 * (ceiling - bottom) + 1.0
    side.set(xlim=(low[0], high[0]), ylim=(bottom - margin, ceiling + margin))
    side.set(xlabel="east, m", ylabel="up, m")
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
            words = f"{label}: median {np.median(values):.3f} m"
            axes.hist(np.clip(values, low, high), bins=list(bins), color=colour, alpha=0.6, label=words)
    axes.set(xscale="log", xlabel="distance of a map point to the scan, m", ylabel="map points")
    axes.legend(fontsize=8)
    return png_bytes(figure)


def _thinned(points: NDArray[Any], most: int = _MAX_POINTS) -> NDArray[Any]:
    return points[:: max(1, -(-len(points) // most))]
