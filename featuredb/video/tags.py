"""What the text tags of a film say about its camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

# Phones, QuickTime's own atoms, and what libav makes of them; the most specific first.
_MAKE = ("com.apple.quicktime.make", "com.android.manufacturer", "make", "manufacturer")
_MODEL = ("com.apple.quicktime.model", "com.android.model", "model")
# The first survives trimming and export on a phone, and names its time zone.
_CREATION = ("com.apple.quicktime.creationdate", "creation_time", "date")
# Action cameras and drones name themselves only in what they call their stream.
_MAKER_WORDS = {"gopro": "GoPro", "dji": "DJI", "insta360": "Insta360"}
_STREAM_NAMES = ("encoder", "handler_name", "comment")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTags:
    """Make and model of the camera and the time of recording; each None if not said."""

    make: str | None
    model: str | None
    creation_time: datetime | None


def camera_tags(tags: Mapping[str, str]) -> CameraTags:
    """Read the tags, whose names are in lower case."""
    return CameraTags(
        make=_first(tags, _MAKE) or _maker(tags),
        model=_first(tags, _MODEL),
        creation_time=_creation_time(tags),
    )


def _first(tags: Mapping[str, str], names: tuple[str, ...]) -> str | None:
    for name in names:
        value = tags.get(name, "").strip()
        if value:
            return value
    return None


def _maker(tags: Mapping[str, str]) -> str | None:
    said = " ".join(tags.get(name, "") for name in _STREAM_NAMES).lower()
    return next((make for word, make in _MAKER_WORDS.items() if word in said), None)


def _creation_time(tags: Mapping[str, str]) -> datetime | None:
    for name in _CREATION:
        try:
            time = datetime.fromisoformat(tags.get(name, "").strip())
        except ValueError:
            continue
        return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
    return None
