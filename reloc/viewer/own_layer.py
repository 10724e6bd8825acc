"""A map without a place as the page shows it: in its own frame, never as if it were somewhere on Earth."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import UnplacedSummary
from reloc.viewer.map_layer import as_stored, coverage, described_photo
from reloc.viewer.points import DrawnPoints, drawn_points, sampled
from reloc.viewer.poses import drawn_pose


def own_points(unplaced: UnplacedMap, wanted: int) -> DrawnPoints:
    """At most `wanted` points of the map, own units."""
    rows = sampled(len(unplaced.points), wanted)
    return drawn_points(unplaced.points.xyz[rows], unplaced.points.rgb[rows], len(unplaced.points))


def describe_own_place(
    summary: UnplacedSummary,
    unplaced: UnplacedMap,
    drawn: DrawnPoints,
    buffer: dict[str, Any],
    command: str,
) -> dict[str, Any]:
    """The map as a place of the page with no place on Earth: `frame`, `epsg` and what hangs on them are None.

    Args:
        command: that opens the page of picks.
    """
    frame, why = unplaced.frame, unplaced.no_place
    told = {
        **as_stored(summary),
        "no_place": {"reason": why.reason, "ways": list(why.ways), "command": command},
        **dict.fromkeys(("method", "drift_m", "budget_m", "residual_rms_m", "epsg", "height_datum", "under")),
        "generation": 0,
        "parents": [],
        "chain": [summary.map_id],
        "lineage": "",
        "points": len(unplaced.points),
        "photos": _photos(unplaced),
        "coverage": coverage(drawn),
        "buffer": buffer,
    }
    return {
        "name": f"{summary.name or summary.map_id}, no place on Earth",
        "own": {"metric": frame.metric, "upright": frame.upright},
        "frame": None,
        "epsg": None,
        "height_datums": [],
        "maps": [told],
        "scans": [],
        "trajectories": [],
    }


def picks_command(url: str, map_id: str, photos: Path | None) -> str:
    """What a person types to place the map by picks in a page."""
    folder = "FOLDER" if photos is None else shlex.quote(str(photos))
    return f"featuredb anchor {shlex.quote(url)} {shlex.quote(map_id)} --photos {folder} --page"


def _photos(unplaced: UnplacedMap) -> list[dict[str, Any]]:
    """The photos, poses in the own frame."""
    photos = []
    for image in unplaced.images:
        pose, camera = image.cam_from_local, unplaced.cameras[image.camera_id]
        drawn = drawn_pose(pose.center, np.asarray(pose.rotation.T), camera)
        photos.append(described_photo(image, unplaced, {**drawn, "utm": None, "ellipse": None}))
    return photos
