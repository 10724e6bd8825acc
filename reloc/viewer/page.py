"""The page's own files: HTML, style, modules, and the libraries beside them.

Modules name each other by bare names ("viewer/plan.js", "three"), which an import map in the page leads to
files here, or to the text itself in a page that is one file.
"""

import base64
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from featuredb.export.job import whole_or_nothing
from reloc.viewer.photos import THUMBNAIL_PX, Pictures, data_url
from reloc.viewer.scene import ViewerScene

ASSETS = Path(__file__).with_name("assets")
_STYLE = "viewer.css"
# Module names of the libraries; "three/core" is what three.module.min.js calls "./three.core.min.js".
_LIBRARIES = {
    "three": "vendor/three.module.min.js",
    "three/core": "vendor/three.core.min.js",
    "three/orbit": "vendor/OrbitControls.js",
}
_RELATIVE_CORE = b'"./three.core.min.js"'


def page() -> str:
    """The page whose files lie below /assets/."""
    imports = {name: f"/assets/{path}" for name, path in _LIBRARIES.items()}
    return _filled(
        imports={**imports, "viewer/": "/assets/js/"},
        style=f'<link rel="stylesheet" href="/assets/{_STYLE}">',
        values="",
        main='<script type="module" src="/assets/js/main.js"></script>',
    )


def content_policy() -> str:
    """Content-Security-Policy of `page`: nothing from elsewhere, and no script in the page but the map."""
    inside = page().split('<script type="importmap">')[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self'; "
        "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )


def page_in_one(values: Mapping[str, str]) -> str:
    """The page with everything in it; `values`: texts by id that it finds in itself, JSON or base64."""
    modules = {name: (ASSETS / path).read_bytes() for name, path in _LIBRARIES.items()}
    # A module in a data URL has no folder to look into, so the library's one relative import gets a name.
    assert _RELATIVE_CORE in modules["three"]
    modules["three"] = modules["three"].replace(_RELATIVE_CORE, b'"three/core"')
    modules |= {f"viewer/{file.name}": file.read_bytes() for file in sorted((ASSETS / "js").iterdir())}
    imports = {
        name: f"data:text/javascript;base64,{base64.b64encode(data).decode()}"
        for name, data in modules.items()
    }
    style = f"<style>\n{(ASSETS / _STYLE).read_text(encoding='utf-8')}</style>"
    licence = (ASSETS / "vendor" / "LICENSE-three.txt").read_text(encoding="utf-8")
    inside = "".join(
        f'<script type="text/plain" id="{name}">{text.replace("<", chr(92) + "u003c")}</script>\n'
        for name, text in values.items()
    )
    return _filled(
        imports=imports,
        style=style,
        values=f"<!-- three.js\n{licence}-->\n{inside}",
        main='<script type="module">import "viewer/main.js";</script>',
    )


def _filled(*, imports: Mapping[str, str], style: str, values: str, main: str) -> str:
    template = (ASSETS / "index.html").read_text(encoding="utf-8")
    # The values last: whatever maps are called, nothing is looked for in them.
    marks = {"@STYLE@": style, "@IMPORTS@": json.dumps({"imports": imports}), "@MAIN@": main}
    for mark, text in {**marks, "@VALUES@": values}.items():
        assert template.count(mark) == 1, mark
        template = template.replace(mark, text)
    return template


# A third of a megabyte of JPEG is a lot to send, and ten thousand photos are many of those.
DEFAULT_POINTS = 250_000


def write_static_page(out: Path, scene: ViewerScene, pictures: Pictures) -> int:
    """Write the page to a new file; returns its size in bytes.

    Raises:
        ExportError: there is something at `out`, or its folder is missing.
    """
    with whole_or_nothing(out) as part:
        shown: dict[str, str] = {}
        missing: dict[str, str] = {}
        for (map_id, image_id), image in scene.images.items():
            data, reason = pictures.jpeg(image, THUMBNAIL_PX)
            key = f"{image_id} {map_id}"
            if data is None:
                missing[key] = reason
            else:
                shown[key] = data_url("image/jpeg", data)
        values = {
            "scene": _json({**scene.document, "queries": False}),
            "pictures": _json({"shown": shown, "missing": missing}),
        }
        for place, data in enumerate(scene.points):
            values[f"points-{place}"] = base64.b64encode(data).decode()
        part.write_text(page_in_one(values), encoding="utf-8")
        return part.stat().st_size


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
