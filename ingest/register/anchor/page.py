"""The page of an anchoring: frames to flick through with the scan over them, the map before and after."""

import shlex
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import atomic_file
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from ingest.html_parts import folded, note, page, picture, pill, table
from ingest.register.anchor.anchor_map import AnchorResult
from ingest.register.anchor.frames import TriedFrame
from ingest.register.anchor.pictures import (
    edge_layer,
    jpeg,
    map_over_scan_png,
    png,
    residuals_png,
    resized,
    scan_view,
    view_rgb,
)
from ingest.register.anchor.report import FRAME_HEADER, AnchorReport, frame_rows, report_json
from ingest.register.anchor.together.register import TOGETHER
from ingest.workspace import write_json

REPORT_JSON, REPORT_HTML = "anchor.json", "anchor.html"

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
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REPORT_JSON, report_json(report))
    with atomic_file(folder / REPORT_HTML) as temporary:
        temporary.write_text(anchor_page(report, old, cloud, read_rgb, command), encoding="utf-8")
    return folder / REPORT_HTML


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
    if result is None:
        state = pill("fair", "proposed, nothing is changed")
    elif report.placed:
        state = pill("good", "placed")
    else:
        state = pill("bad", "not placed")
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
    parts.append(
        "<h2>All frames</h2><section class='wide'>"
        + table(FRAME_HEADER, rows, numbers=(1, 2, 3, 5, 6, 7), names=(0,))
        + "</section>"
    )
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
            line = command.replace("{image}", shlex.quote(tried.image.name))
            details += (
                f'<p>If the edges lie on the photo, confirm it:</p><pre class="command">{escape(line)}</pre>'
            )
    view = scan_view(cloud, lens, pose)
    stage = (
        picture(jpeg(resized(read_rgb(tried.image), view.camera)), "photo", "jpeg", "photo")
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
    new = result.feature_map
    assert new is not None
    assert result.before is not None
    assert result.after is not None
    move = result.checks["move"]
    facts = [
        ("heights", f"{report.datum_before} before, {report.datum_after} after"),
        (
            "map points to scan",
            f"median {result.before.median_m:.2f} m before, {result.after.median_m:.3f} m after",
        ),
        ("moved", f"{move['horizontal_m']:.2f} m in plan, {move['up_m']:+.2f} m up"),
        ("turned", f"{move['heading_deg']:+.2f} degrees about the vertical, {move['tilt_deg']:.2f} tilted"),
        ("scale", f"{move['scale']:.5f}"),
        ("placement, 1 sigma", _sigmas(new)),
        *(
            (f"focal length of camera {k}", f"{before.focal_px:.1f} px before, {after.focal_px:.1f} px after")
            for k, (before, after) in enumerate(zip(old.cameras, new.cameras, strict=True))
        ),
    ]
    centers = np.array([image.cam_from_local.center for image in new.images])
    local = cloud.frame.enu_from(new.frame)
    pictures = picture(
        map_over_scan_png(
            cloud, old.points_local(cloud.frame), new.points_local(cloud.frame), local.act(centers)
        ),
        "Map points over the scan, before and after",
    ) + picture(
        residuals_png(result.before.distance_m, result.after.distance_m),
        "Distances of map points to the scan, before and after",
    )
    return f"<h2>The map</h2><section>{table((), facts, names=(0,))}{pictures}</section>"


def _sigmas(feature_map: FeatureMap) -> str:
    middle = np.median(feature_map.points_local(), axis=0)
    jacobian = point_jacobian(middle)
    spread = np.sqrt(np.diag(jacobian @ feature_map.placement.covariance @ jacobian.T))
    turn = np.degrees(np.sqrt(np.diag(feature_map.placement.covariance)[1:4]).max())
    return f"east {spread[0]:.3f}, north {spread[1]:.3f}, up {spread[2]:.3f} m, {turn:.3f} degrees"
