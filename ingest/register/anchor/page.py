"""A local page to flick through proposed frames: photo, scan, edges; one file, no network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from featuredb.render.rendering import Rendering
from ingest.html_parts import STYLE
from ingest.register.anchor.pictures import edge_layer, jpeg, png, resized, view_rgb

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
