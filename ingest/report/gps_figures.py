"""The figures of a placement by GPS, each with what it says."""

from collections.abc import Mapping
from typing import Any

# As `ingest.register.gps` names them; those of `angles` stand below it there. What has no line is not shown.
FIGURES = {
    "photos_with_gps": "photos that have a position",
    "inliers": "photos whose position agrees; others are far out. Of more than 400 as many, evenly in time, "
    "place the map",
    "rms_horizontal_m": "distance of used positions from the photos' places in the map (RMS), metres",
    "rms_vertical_m": "the same in height",
    "noise_m": "estimated noise of one position, horizontally and in height, metres",
    "drift_m": "estimated drift of the receiver from the first photo to the last, the same way",
    "lag_s": "by how many seconds positions are late; 0 where that is not known",
    "bias_sigma_m": "by what all positions may be wrong together (68 % an axis: east, north, up), metres",
    "scale_sigma": "what the scale is known to (68 %), as a share",
    "turn_sigma_deg": "what the turn is known to about its worst axis (68 %), degrees",
    "checked_turn_sigma_deg": "the same if nothing were assumed of how the photos are held",
    "log10_chance": "how often positions of other photos would fit as well, as a power of ten",
    "told": "whether photos tell their own angles; if not, they are taken to be held level",
    "tilt_off_deg": "median angle in the map between photos and what they tell, or level",
    "tilt_contradicts": "whether that is more than such angles are ever wrong by",
    "yaw_off_deg": "median angle in the map between the photos' compass or gimbal and north",
    "yaw_contradicts": "whether that is more than such angles are ever wrong by",
}


def figure_rows(figures: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value and meaning of each figure, in the order above."""
    known = {**figures, **figures.get("angles", {})}
    return [
        (name, _value(known[name]), what) for name, what in FIGURES.items() if known.get(name) is not None
    ]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "not known"
    if isinstance(value, list | tuple):
        return ", ".join(_value(one) for one in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)
