"""What a height may be above, and its units, by name: what a help needs, so nothing heavy."""

from typing import Literal, get_args

HeightDatum = Literal["ellipsoidal", "egm96", "egm2008", "navd88", "unknown"]
HEIGHT_DATUMS: tuple[HeightDatum, ...] = get_args(HeightDatum)

FOOT_M = 0.3048
US_SURVEY_FOOT_M = 1200.0 / 3937.0
HEIGHT_UNITS: dict[str, float] = {"m": 1.0, "ft": FOOT_M, "us-ft": US_SURVEY_FOOT_M}
