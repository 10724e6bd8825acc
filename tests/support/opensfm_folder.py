"""A small OpenSfM folder written by hand, for tests."""

import json
from pathlib import Path
from typing import Any

# A reconstruction as OpenSfM writes it, small enough to be computed by hand; f is 0.9 of 1000 px. "a.jpg" is
# at the origin and looks up; "b.jpg" is turned by 90 degrees about z, x to y, and moved by (1, 0, 0): its
# centre is (0, 1, 0). Point 7 in a: u = 0.9 * 0.1, v = 0; in b: (1, 1, 10), u = v = 0.09.
TINY: dict[str, Any] = {
    "cameras": {
        "v2 x y 1000 800 perspective 0.9": {
            "projection_type": "perspective",
            "width": 1000,
            "height": 800,
            "focal": 0.9,
            "k1": 0.0,
            "k2": 0.0,
        }
    },
    "shots": {
        "a.jpg": {
            "rotation": [0.0, 0.0, 0.0],
            "translation": [0.0, 0.0, 0.0],
            "camera": "v2 x y 1000 800 perspective 0.9",
            "gps_position": [0.5, 0.0, 0.0],
            "gps_dop": 5.0,
        },
        "b.jpg": {
            "rotation": [0.0, 0.0, 1.5707963267948966],
            "translation": [1.0, 0.0, 0.0],
            "camera": "v2 x y 1000 800 perspective 0.9",
        },
        "unseen.jpg": {
            "rotation": [0.0, 0.0, 0.0],
            "translation": [0.0, 0.0, 0.0],
            "camera": "v2 x y 1000 800 perspective 0.9",
        },
    },
    "points": {
        "7": {"coordinates": [1.0, 0.0, 10.0], "color": [255.0, 128.0, 0.0]},
        "12": {"coordinates": [0.0, -2.0, 20.0], "color": [1.0, 2.0, 3.0]},
    },
    "reference_lla": {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0},
}


# Point 12 in a: u = 0, v = -0.09; in b: (2 + 1, 0, 20), u = 0.135, v = 0. The last two rows are no part of
# it: a track that has no point, a photo that is no shot.
ROWS = [
    ("a.jpg", "7", "3", "0.09", "0.0", "0.004"),
    ("a.jpg", "12", "4", "0.0", "-0.09", "0.002"),
    ("b.jpg", "12", "0", "0.135", "0.0", "0.003"),
    ("b.jpg", "7", "1", "0.09", "0.09", "0.008"),
    ("b.jpg", "99", "2", "0.3", "0.2", "0.008"),
    ("other.jpg", "7", "1", "0.3", "0.2", "0.008"),
]


def tracks(rows: list[tuple[str, ...]], version: int = 1) -> str:
    more = "\t255\t128\t0" + ("\t-1\t-1" if version == 2 else "")
    lines = [f"OPENSFM_TRACKS_VERSION_v{version}"] + ["\t".join(row) + more for row in rows]
    return "\n".join(lines) + "\n"


def write_tiny(folder: Path, name: str = "reconstruction.json", version: int = 1) -> Path:
    (folder / name).write_text(json.dumps([TINY]))
    (folder / "tracks.csv").write_text(tracks(ROWS, version))
    return folder
