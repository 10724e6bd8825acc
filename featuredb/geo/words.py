"""A way across the ground in words."""

import math

_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def way_words(east_m: float, north_m: float) -> str:
    """How far and to which of eight winds: "50.0 km to the east"."""
    length = math.hypot(east_m, north_m)
    wind = _WINDS[round(math.degrees(math.atan2(east_m, north_m)) / 45.0) % 8]
    return f"{length / 1000.0:.1f} km to the {wind}" if length >= 1000.0 else f"{length:.0f} m to the {wind}"
