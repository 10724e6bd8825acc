"""The page as one file that can be sent: scripts, points, and pictures as thumbnails are inside."""

import base64
import json
from pathlib import Path

from featuredb.export.job import whole_or_nothing
from reloc.viewer.page import page_in_one
from reloc.viewer.photos import THUMBNAIL_PX, Pictures
from reloc.viewer.query import data_url
from reloc.viewer.scene import ViewerScene

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
            "scene": _json({**scene.document, "queries": False, "placing": False}),
            "pictures": _json({"shown": shown, "missing": missing}),
        }
        for place, data in enumerate(scene.points):
            values[f"points-{place}"] = base64.b64encode(data).decode()
        part.write_text(page_in_one(values), encoding="utf-8")
        return part.stat().st_size


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
