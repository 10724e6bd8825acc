"""One block of a drone's subtitles as numbers, in each dialect that is known.

| dialect | looks like | written by |
|---|---|---|
| bracketed | `[latitude: 41.42] [longtitude : 2.23] [rel_alt: 1.3 abs_alt: 9.1]` | Mavic 2, Air 2, Mavic 3 |
| F/SS line | `F/2.8, SS 30.15, ISO 260, GPS (-121.7, 48.0, 17), D 221.21m, H 200.70m` | Phantom 4, Mini |
| HOME/GPS BAROMETER | `HOME(149.0,-20.2) 2017.08.05 ... GPS(149.0,-20.2,16) BAROMETER:1.9` | Mavic Pro |
| HOME/GPS Hb Hs | `GPS(149.0,-20.2,16) Hb:1.9 Hs:1.9` | Phantom 3, Inspire 1 |
| GPS metres | `GPS(36.6,-6.1,0.0M) BAROMETER:0.3M` | Matrice 300 |
| compass letters | `GPS(W: 97.109543, N: 32.593742, 174.21m)` | Autel Evo II |

"longtitude" is DJI's own spelling. A value counts only when it is whole: its bracket is closed, its unit
follows. Which of two unnamed coordinates is the latitude is not decided here (`axis_order.py`).
"""

import re
from dataclasses import dataclass, field

from featuredb.video.telemetry.axis_order import ThirdValue

_NUMBER = r"[+-]?\d{1,12}(?:\.\d{0,15})?"
_GROUP = re.compile(r"\[([^\[\]]{0,300})\]")
_PAIR = re.compile(r"([A-Za-z_]+)\s*:\s*([+-]?\d{1,12}(?:[.,]\d{0,15})?)(?![\d.]|,\d)")
_TUPLE = re.compile(r"(?<![A-Za-z.])(GPS|HOME|G\.PRY)\s*\(([^()]{0,200})\)")
_COORDINATE = re.compile(rf"^(?:([NSEW])\s*:?\s*)?({_NUMBER})\s*(m?)$", re.IGNORECASE)
_BAROMETER = re.compile(rf"\b(?:BAROMETER\s*[:(]|Hb:)\s*({_NUMBER})(?=[Mm\s)]|$)")
_HEIGHT = re.compile(rf"(?<![A-Za-z.])H\s+({_NUMBER})\s*m\b")
_DISTANCE = re.compile(rf"(?<![A-Za-z.])D\s+({_NUMBER})\s*m\b")
_MARKS = re.compile(
    r"GPS\s*\(|\blat(?:itude)?\s*:|FrameCnt\s*:|SrtCnt\s*:|BAROMETER|\[iso\s*:", re.IGNORECASE
)

_NAMES = {
    "latitude": "latitude_deg", "longitude": "longitude_deg", "longtitude": "longitude_deg",
    "altitude": "height_m", "abs_alt": "height_m", "rel_alt": "relative_height_m",
    "gb_yaw": "gimbal_yaw", "gb_pitch": "gimbal_pitch", "gb_roll": "gimbal_roll",
}  # fmt: skip
_NAN = float("nan")


@dataclass(slots=True)
class BlockFields:
    """What one block says.

    Attributes:
        dialect: its name in the table above, "" where nothing was understood.
        row: named values, by the columns that `assemble` takes.
        pair: unnamed coordinates in degrees, in the order written; NaN without a fix.
        home: the same of the place of take-off.
        distance_m: horizontal distance from take-off.
        decimals: digits after the point of the coordinates, -1 without any.
        altitude_unnamed: the height is called "altitude" without saying above what.
    """

    dialect: str = ""
    row: dict[str, float] = field(default_factory=dict)
    pair: tuple[float, float] = (_NAN, _NAN)
    home: tuple[float, float] = (_NAN, _NAN)
    third: ThirdValue = "none"
    third_value: float = _NAN
    distance_m: float = _NAN
    decimals: int = -1
    altitude_unnamed: bool = False


def looks_like_telemetry(text: str) -> bool:
    """Whether a text has words of a drone's subtitles, rather than those of people talking."""
    return _MARKS.search(text) is not None


def parse_block(text: str) -> BlockFields:
    """The numbers of one block; what is missing, not available or cut is left out."""
    fields = BlockFields()
    _read_groups(text, fields)
    for match in _TUPLE.finditer(text):
        _read_tuple(match[1], match[2].split(","), fields)
    barometer, height, distance = _BAROMETER.search(text), _HEIGHT.search(text), _DISTANCE.search(text)
    if barometer or height:
        fields.row.setdefault("relative_height_m", float((barometer or height)[1]))  # type: ignore[index]
    if distance:
        fields.distance_m = float(distance[1])
    fields.dialect = fields.dialect or _dialect_of_tuple(text, fields)
    return fields


def _read_groups(text: str, fields: BlockFields) -> None:
    """The named values in closed square brackets."""
    for group in _GROUP.findall(text):
        for name, written in _PAIR.findall(group):
            number = written.replace(",", ".")
            key, value = name.lower(), float(number)
            fields.dialect = "bracketed"
            if key in _NAMES:
                fields.row[_NAMES[key]] = value
                if key in ("latitude", "longitude", "longtitude"):
                    fields.decimals = max(fields.decimals, len(number.partition(".")[2]))
                fields.altitude_unnamed |= key == "altitude"


def _read_tuple(name: str, parts: list[str], fields: BlockFields) -> None:
    """Values in round brackets: GPS(a, b, c), HOME(a, b, c), G.PRY (pitch, roll, yaw of the gimbal)."""
    if name == "G.PRY":
        angles = [_COORDINATE.match(part.strip().rstrip("°� ")) for part in parts]
        for axis, angle in zip(("pitch", "roll", "yaw"), angles, strict=False):
            if angle:
                fields.row[f"gimbal_{axis}"] = float(angle[2])
        return
    if len(parts) > 3:  # decimal commas, for example; what is then a number is not to be guessed
        return
    first, second, third = [*(_COORDINATE.match(part.strip()) for part in parts), None, None][:3]
    if name == "GPS" and third and not third[1]:
        fields.third_value = float(third[2])
        fields.third = "metres" if third[3] else "decimal" if "." in third[2] else "count"
    if first is None or second is None or first[3] or second[3]:
        return
    pair, named = (float(first[2]), float(second[2])), first[1] and second[1]
    if name == "HOME":
        fields.home = fields.home if named else pair
        return
    if not named:
        fields.pair = pair
    elif not _read_compass((first[1] + second[1]).upper(), pair, fields):
        return
    fields.decimals = max(len(match[2].partition(".")[2]) for match in (first, second))


def _read_compass(letters: str, pair: tuple[float, float], fields: BlockFields) -> bool:
    """Coordinates with their letters; False for N and S, or E and W, twice, which is damage."""
    values = {
        "latitude_deg" if letter in "NS" else "longitude_deg": -value if letter in "SW" else value
        for letter, value in zip(letters, pair, strict=True)
    }
    if len(values) < 2:
        return False
    fields.dialect = "compass letters"
    fields.row.update(values)
    return True


def _dialect_of_tuple(text: str, fields: BlockFields) -> str:
    if re.match(r"F/\d", text):
        return "F/SS line"
    if "GPS" not in text:
        return ""
    if fields.third == "metres":
        return "GPS metres"
    if "Hb:" in text:
        return "HOME/GPS Hb Hs"
    return "HOME/GPS BAROMETER" if "BAROMETER" in text else "GPS"
