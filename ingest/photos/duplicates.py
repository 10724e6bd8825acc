"""Copies of one photo: the same bytes, or the same picture encoded or resized anew.

The picture is compared by 256 signs of its lowest cosine frequencies. Measured on real flights, in bits
that differ of 256:

| pairs                                                     | smallest | median |
|-----------------------------------------------------------|----------|--------|
| neighbours of `brighton` (nadir, 80 % overlap)             | 112      | 122    |
| neighbours of `lewis` (oblique), all pairs                 | 44       | 126    |
| neighbours of `copr` (kite, one second apart), all pairs   | 64       | 128    |
| copies: JPEG quality 95..40, size 1 to 1/4, brightness     | 0        | 2 (largest 18) |

A threshold of 24 bits lies between 18 and 44. `tests/integration/test_scan_real.py` measures it again.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ingest.photos.photo import Photo

if TYPE_CHECKING:
    from ingest.sfm.matching import Matched

_HASH_SIDE = 16
_SAMPLED_SIDE = 64
_EARTH_RADIUS_M = 6_371_000.0


MAX_BITS = 24  # of the 256 of the picture hash; between copies (18) and true neighbours (44)
_MAX_TIME_S = 2.0  # capture times are copied with the EXIF; two are for writers that round to even seconds
_MAX_DISTANCE_M = 1.0  # positions are copied too; one metre allows for rounded digits
_MAX_ASPECT = 0.01  # relative difference of the shapes; resizing rounds to whole pixels


def picture_hash(gray: NDArray[np.uint8]) -> str:
    """Hash of a grey picture (h, w): 64 hex digits.

    Signs of the lowest 16 x 16 coefficients of the cosine transform against their median, after area
    averaging to 64 x 64 (Zauner, Implementation and benchmarking of perceptual image hash functions,
    2010, with 256 bits in place of 64).
    """
    small = cv2.resize(gray, (_SAMPLED_SIDE, _SAMPLED_SIDE), interpolation=cv2.INTER_AREA)
    low = cv2.dct(small.astype(np.float32))[:_HASH_SIDE, :_HASH_SIDE].ravel()
    return np.packbits(low > np.median(low)).tobytes().hex()


def hash_bits(hashes: Sequence[str]) -> NDArray[np.uint64]:
    """Picture hashes as words (n, 4)."""
    return np.frombuffer(bytes.fromhex("".join(hashes)), dtype=np.uint64).reshape(len(hashes), -1)


def hash_distances(one: NDArray[np.uint64], others: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Number of differing bits (n,) between a picture hash (4,) and others (n, 4), both as words."""
    return np.asarray(np.bitwise_count(others ^ one).sum(axis=1, dtype=np.int64))


def exact_duplicates(photos: Sequence[Photo]) -> dict[str, str]:
    """Names of usable photos whose bytes repeat, each with the name that is kept: the first one."""
    kept: dict[str, str] = {}
    copies: dict[str, str] = {}
    for photo in sorted((p for p in photos if p.status == "ok"), key=lambda p: p.name):
        first = kept.setdefault(photo.sha256, photo.name)
        if first != photo.name:
            copies[photo.name] = first
    return copies


def near_duplicates(photos: Sequence[Photo], hashes: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Names of photos that show the picture of another, with that one's name and the differing bits.

    The copy with most pixels is kept, then one with a position, then the first by name. Photos that both
    say when, where or with what they were taken must agree in it, so that a scene that stands still and
    is photographed twice keeps both photos; of a site's photos only the picture counts.

    Args:
        photos: usable ones.
        hashes: `picture_hash` of each.
    """
    if not photos:
        return {}
    bits, kept = hash_bits(hashes), np.zeros(len(photos), dtype=np.bool_)
    copies: dict[str, tuple[str, int]] = {}
    for i in sorted(range(len(photos)), key=lambda i: _preference(photos[i])):
        distances = hash_distances(bits[i], bits)
        near = [
            (int(distances[k]), k)
            for k in np.flatnonzero(kept & (distances <= MAX_BITS)).tolist()
            if _agree(photos[i], photos[k])
        ]
        if near:
            distance, best = min(near)
            copies[photos[i].name] = (photos[best].name, distance)
        else:
            kept[i] = True
    return copies


def copies_of(photos: Sequence[Photo], matched: "Matched") -> dict[int, int]:
    """Rows of photos that show the picture of another owner's photo, each with the row that is kept.

    The picture may have been cut, framed, marked or scaled: what matched says so (ingest.sfm.overlays).
    Photos of one owner are left alone: who photographs twice from one place does no harm.
    """
    group_of: dict[int, set[int]] = {}
    for i, j in matched.copies:
        if (photos[i].contributor, photos[i].owner) != (photos[j].contributor, photos[j].owner):
            group = group_of.get(i, {i}) | group_of.get(j, {j})
            group_of |= dict.fromkeys(group, group)
    kept = {i: min(group, key=lambda k: _preference(photos[k])) for i, group in group_of.items()}
    return {i: best for i, best in sorted(kept.items()) if i != best}


def _preference(photo: Photo) -> tuple[int, bool, str]:
    return -photo.width * photo.height, photo.gps is None, photo.name


def _agree(a: Photo, b: Photo) -> bool:
    """Whether nothing that both photos say of themselves speaks against their being copies."""
    if abs(a.width * b.height / (a.height * b.width) - 1.0) > _MAX_ASPECT:
        return False
    if a.film and a.film == b.film:
        return False  # keyframes are chosen to differ, by little where the camera comes slowly nearer
    if a.gps_is_hint or b.gps_is_hint:
        return True  # what photo sites say of a picture that was uploaded again is of the upload
    for mine, other in ((a.make, b.make), (a.model, b.model)):
        if mine and other and mine != other:
            return False
    if a.capture_time and b.capture_time:
        # An offset that one copy lost says nothing, so local times are compared.
        apart = a.capture_time.replace(tzinfo=None) - b.capture_time.replace(tzinfo=None)
        if abs(apart.total_seconds()) > _MAX_TIME_S:
            return False
    return not (a.gps and b.gps) or _distance_m(a, b) <= _MAX_DISTANCE_M


def _distance_m(a: Photo, b: Photo) -> float:
    """Horizontal distance on a sphere, good to half a percent, for comparing with about a metre."""
    assert a.gps is not None
    assert b.gps is not None
    north = math.radians(a.gps.latitude_deg - b.gps.latitude_deg)
    east = math.radians((a.gps.longitude_deg - b.gps.longitude_deg + 180.0) % 360.0 - 180.0)
    return _EARTH_RADIUS_M * math.hypot(north, east * math.cos(math.radians(a.gps.latitude_deg)))
