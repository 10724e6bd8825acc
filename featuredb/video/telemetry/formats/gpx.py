"""Tracks of GPX files (1.0 and 1.1, https://www.topografix.com/GPX/1/1/), read as a stream.

Documents with a DOCTYPE are refused: GPX has none, and it is what entities, small texts that expand to fill
the memory or to a file of this machine, need. Heights (`ele`) are of unknown datum, as GPX does not name one.
"""

import math
from xml.parsers import expat

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.formats.text import number, parse_wall_clock
from featuredb.video.telemetry.values import Telemetry, assemble, check_count

# Elements of a point whose text counts. `fix` is "none", "2d", "3d", "dgps" or "pps".
_TEXTS = ("ele", "time", "fix")
_MAX_TEXT = 200
_MAX_DEPTH = 100


def read_gpx(data: bytes, origin: str = "GPX") -> Telemetry:
    """The points of all tracks of a GPX file as telemetry in the order of time.

    `times_s` counts from the first point with a time and `clock` is "utc": GPX's times are.

    Raises:
        TelemetryError: not XML, a DOCTYPE, no track points, or none with a time or a position.
    """
    reader = _Reader(origin)
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.StartDoctypeDeclHandler = reader.doctype
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two for unknown encodings
        raise TelemetryError(
            f"{origin}: expected GPX, found no well-formed XML ({error}); if it was cut off, export it again"
        ) from error
    return reader.telemetry()


class _Reader:
    """Collects track points as expat meets them."""

    def __init__(self, origin: str) -> None:
        self._origin = origin
        self._path: list[str] = []
        self._point: dict[str, str] | None = None
        self._rows: list[tuple[float, float, float, float]] = []  # clock, latitude, longitude, height
        self._points, self._local = 0, 0

    def doctype(self, *_: object) -> None:
        raise TelemetryError(
            f"{self._origin}: it has a DOCTYPE, which no GPX file needs; refused for what entities can do"
        )

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._path) >= _MAX_DEPTH:
            raise TelemetryError(
                f"{self._origin}: elements nested more than {_MAX_DEPTH} deep; this is no GPX"
            )
        local = name.rpartition(" ")[2]
        if not self._path and local != "gpx":
            raise TelemetryError(f"{self._origin}: expected the XML of GPX, found <{local[:40]}>")
        self._path.append(local)
        if local == "trkpt" and self._point is None:
            self._point = {key: attributes.get(key, "") for key in ("lat", "lon")}

    def text(self, characters: str) -> None:
        # A point's own elements only, so that an extension's <time> is not taken for it.
        if self._point is None or self._path[-2:-1] != ["trkpt"] or self._path[-1] not in _TEXTS:
            return
        so_far = self._point.get(self._path[-1], "")
        self._point[self._path[-1]] = (so_far + characters)[:_MAX_TEXT]

    def end(self, name: str) -> None:
        local = self._path.pop()
        if local == "trkpt" and self._point is not None and "trkpt" not in self._path:
            self._add(self._point)
            self._point = None

    def _add(self, point: dict[str, str]) -> None:
        self._points += 1
        check_count(self._points, self._origin)
        clock = parse_wall_clock(point.get("time", ""))
        if clock is None:
            return
        self._local += not clock.is_utc
        fixed = point.get("fix", "").strip() != "none"
        latitude, longitude = (number(point[name]) if fixed else math.nan for name in ("lat", "lon"))
        self._rows.append((clock.seconds, latitude, longitude, number(point.get("ele", ""))))

    def telemetry(self) -> Telemetry:
        if not self._points:
            raise TelemetryError(
                f"{self._origin}: a GPX file without track points (<trkpt>); waypoints have no times"
            )
        if not self._rows:
            raise TelemetryError(
                f"{self._origin}: none of {self._points} track points has a <time>; export it with times"
            )
        warnings = []
        timeless = self._points - len(self._rows)
        if timeless:
            warnings.append(f"{timeless} of {self._points} track points have no time and are left out")
        if self._local:
            warnings.append(
                f"{self._local} times name no zone; GPX's times are UTC, so they are taken for it"
            )
        clock, latitude, longitude, height = np.array(self._rows).T
        return assemble(
            {"clock_s": clock, "latitude_deg": latitude, "longitude_deg": longitude, "height_m": height},
            source="GPX",
            origin=self._origin,
            clock="utc",
            in_video_time=False,
            sort=True,
            warnings=warnings,
        )
