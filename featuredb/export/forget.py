"""Takes photos out of evidence and provenance: what a map says of itself names photos, too."""

import re
from collections.abc import Collection, Iterable
from typing import Any

from featuredb.maps.feature_map import MapImage

_HELD = "(left out)"
_CANDIDATE_DIGITS = 32  # a contributed photo's id is the beginning of its hash


def names_of(images: Iterable[MapImage]) -> frozenset[str]:
    """What photos are called in evidence: paths, file names, hashes, ids of contributed photos."""
    found: set[str] = set()
    for image in images:
        found |= {image.name, image.name.rsplit("/", 1)[-1], image.sha256, image.sha256[:_CANDIDATE_DIGITS]}
    return frozenset(found - {""})


def forget(value: Any, names: Collection[str]) -> Any:
    """A JSON value without what is said of some photos.

    Members that are called like one of them or that are one of these names are left out, and so is, from a
    list, an object that names one of them: it is about that photo. A name in the midst of a text is replaced.
    """
    if not names:
        return value
    longest_first = sorted(names, key=lambda name: (-len(name), name))
    within = re.compile(rf"(?<![\w/.-])(?:{'|'.join(map(re.escape, longest_first))})(?![\w-])")
    return _without(value, frozenset(names), within)


def _without(value: Any, names: frozenset[str], within: re.Pattern[str]) -> Any:
    if isinstance(value, dict):
        kept = {
            within.sub(_HELD, k): v for k, v in value.items() if k not in names and not _is_name(v, names)
        }
        return {key: _without(v, names, within) for key, v in kept.items()}
    if isinstance(value, list | tuple):
        return [_without(v, names, within) for v in value if not _about(v, names)]
    return within.sub(_HELD, value) if isinstance(value, str) else value


def _about(value: Any, names: frozenset[str]) -> bool:
    """Whether an element of a list is one of the photos, or tells of one."""
    if isinstance(value, dict):
        return any(_is_name(v, names) for v in value.values())
    return _is_name(value, names)


def _is_name(value: Any, names: frozenset[str]) -> bool:
    return isinstance(value, str) and value in names
