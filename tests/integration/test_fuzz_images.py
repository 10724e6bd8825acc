"""Hostile files through scan and decode: each is a photo or has its reason, and nothing crashes or hangs."""

import io
import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from featuredb.errors import ImageError
from featuredb.features.decode import DecodeLimits, decode_gray, decode_rgb
from featuredb.features.exif.read import read_exif
from featuredb.features.image_header import IMAGE_ERROR_CODES
from ingest.photos.scan import ScanOptions, scan_folder

LIMITS = DecodeLimits(max_bytes=4 << 20, max_pixels=4_000_000, min_side_px=64)
CASES_PER_KIND = 60


try:
    import pillow_heif
except ImportError:
    pillow_heif = None
else:
    pillow_heif.register_heif_opener()


def _seed_files() -> dict[str, bytes]:
    coarse = np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = Image.fromarray(coarse).resize((128, 96), Image.Resampling.BICUBIC)
    exif = Image.Exif()
    exif.update({271: "Maker", 272: "Model", 274: 1})
    exif.get_ifd(34665).update({36867: "2024:05:06 07:08:09", 41989: 24})
    exif.get_ifd(34853).update(
        {1: "N", 2: (46.0, 50.0, 33.0), 3: "W", 4: (91.0, 59.0, 40.0), 5: b"\0", 6: 198.0}
    )
    files = {}
    for kind, options in (
        ("JPEG", {"quality": 85}),
        ("JPEG", {"quality": 85, "progressive": True}),
        ("PNG", {}),
        ("WEBP", {"quality": 85}),
        ("TIFF", {"compression": "tiff_lzw"}),
        ("BMP", {}),
        ("AVIF", {"quality": 85}),
        *((("HEIF", {"quality": 85}),) if pillow_heif is not None else ()),
    ):
        buffer = io.BytesIO()
        image.save(buffer, kind, exif=exif, **options)
        files[f"{kind}{'_progressive' if 'progressive' in options else ''}"] = buffer.getvalue()
    return files


SEEDS = _seed_files()
Change = Callable[[bytes, random.Random], bytes]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _flip_bits(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 20)):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _flip_header(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        changed[rng.randrange(min(len(changed), 700))] = rng.randrange(256)
    return bytes(changed)


def _zero_hole(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    stop = min(len(data), start + rng.randint(1, 4096))
    return data[:start] + bytes(stop - start) + data[stop:]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.randint(1, 200) :]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + data[rng.randrange(len(data)) :] + data[start:]


CHANGES: tuple[Change, ...] = (_cut, _flip_bits, _flip_header, _zero_hole, _remove, _repeat)


def _outcome(data: bytes) -> str:
    """Decode both ways and read the metadata; ok or the code of the refusal."""
    read_exif(data)
    try:
        gray = decode_gray(data, LIMITS)
        rgb = decode_rgb(data, LIMITS)
    except ImageError as error:
        return error.code if str(error) else "no message"
    assert gray.dtype == rgb.dtype == np.uint8
    assert rgb.shape == (*gray.shape, 3)
    assert gray.size <= LIMITS.max_pixels
    return "ok"


@pytest.mark.timeout(120)
@pytest.mark.parametrize("kind", SEEDS)
def test_changed_files_are_decoded_or_refused(kind: str) -> None:
    rng = random.Random(kind)
    outcomes = {"ok": 0}
    assert _outcome(SEEDS[kind]) == "ok"
    for case in range(CASES_PER_KIND):
        outcome = _outcome(CHANGES[case % len(CHANGES)](SEEDS[kind], rng))
        assert outcome in {"ok", *IMAGE_ERROR_CODES}
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
    assert sum(outcomes.values()) == CASES_PER_KIND
    assert outcomes["ok"] < CASES_PER_KIND * 0.8  # the changes do hurt


@pytest.mark.timeout(120)
def test_random_bytes_behind_every_signature() -> None:
    rng = random.Random(11)
    signatures = [seed[:length] for seed in SEEDS.values() for length in (2, 4, 12, 30)]
    for signature in signatures:
        for size in (0, 1, 100, 5000):
            assert _outcome(signature + rng.randbytes(size)) in IMAGE_ERROR_CODES


def _png(width: int, height: int, pixels: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def _jpeg_of_size(width: int, height: int) -> bytes:
    data = bytearray(SEEDS["JPEG"])
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "codes"),
    [
        (_png(2**31 - 1, 2**31 - 1, b""), {"too_large"}),
        (_png(0, 0, b""), {"too_small"}),
        (_png(0xFFFFFFFF, 1, b""), {"too_small"}),
        (_png(1000, 1000, zlib.compress(b"\0" * 1001 * 10)), {"broken"}),
        (_png(1000, 1000, b"nonsense"), {"broken"}),
        (_jpeg_of_size(0, 0), {"too_small"}),
        (_jpeg_of_size(65535, 65535), {"too_large"}),
        (_jpeg_of_size(2000, 1900), {"truncated", "broken"}),
        (_jpeg_of_size(64, 64), {"ok"}),
        (SEEDS["JPEG"][:2] + b"\xff\xe1\x00\x00" + SEEDS["JPEG"][2:], {"broken"}),
        (SEEDS["JPEG"][:2] + b"\xff" * 100_000, {"truncated"}),
        (b"II*\0\x08\0\0\0\xff\xff" + bytes(1000), {"truncated"}),
        (b"RIFF\xff\xff\xff\xffWEBP" + bytes(100), {"truncated"}),
        (b"BM" + bytes(12) + b"\x28\0\0\0" + b"\xff" * 40, {"broken"}),
    ],
)
@pytest.mark.timeout(60)
def test_absurd_headers(data: bytes, codes: set[str]) -> None:
    assert _outcome(data) in codes


@pytest.mark.timeout(60)
def test_more_pixels_than_claimed_are_not_inflated() -> None:
    assert _outcome(_png(64, 64, zlib.compress(bytes(200 << 20), 9))) == "ok"


@pytest.mark.timeout(60)
def test_a_jpeg_of_thousands_of_scans_is_refused() -> None:
    data = SEEDS["JPEG_progressive"]
    scan = data[data.rindex(b"\xff\xda") : -2]
    assert _outcome(data[:-2] + scan * 5000 + b"\xff\xd9") == "unsupported"


@pytest.mark.timeout(300)
def test_a_folder_of_such_files_is_scanned(tmp_path: Path) -> None:
    rng = random.Random(17)
    extensions = (".jpg", ".PNG", ".tif", ".txt", ".heic", "", ".jpg.part")
    written = set()
    for number in range(360):
        kind = rng.choice(sorted(SEEDS))
        data = rng.choice(CHANGES)(SEEDS[kind], rng) if number % 12 else rng.randbytes(rng.randrange(3000))
        name = f"{number:03}{rng.choice(extensions)}"
        (tmp_path / name).write_bytes(data)
        written.add(name)
    (tmp_path / "directory.jpg").mkdir()
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "zero.jpg").touch()
    (tmp_path / "good.jpg").write_bytes(SEEDS["JPEG"])
    result = scan_folder(tmp_path, ScanOptions(limits=LIMITS, workers=2))
    assert {photo.name for photo in result.photos} == written | {"pipe.jpg", "zero.jpg", "good.jpg"}
    known = {*IMAGE_ERROR_CODES, "duplicate", "near_duplicate"}
    for photo in result.photos:
        if photo.status == "ok":
            assert photo.width * photo.height > 0, photo
        else:
            assert photo.reason_code in known, photo
            assert photo.reason, photo
    good = next(photo for photo in result.photos if photo.name == "good.jpg")
    # Some of the others are the same picture with a scratch.
    assert good.status == "ok" or good.reason_code == "near_duplicate"
    assert len(result.skipped) >= 4
