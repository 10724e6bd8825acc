"""Scan and EXIF on real photos, against values read independently and against the flights themselves."""

import hashlib
import io
import itertools
import math
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from featuredb.features.decode import decode_gray
from ingest.photos.duplicates import MAX_BITS, hash_bits, hash_distances, picture_hash
from ingest.photos.scan import scan_folder

pytestmark = pytest.mark.real_data


def test_brighton_is_read_in_full(shared_data: Path) -> None:
    folder = shared_data / "brighton" / "images"
    photos = scan_folder(folder).photos
    assert [p.status for p in photos] == ["ok"] * 18
    key = "dji|fc300s|4000x2250|f2310"
    turned = {f"DJI_00{number}.JPG" for number in range(24, 30)}  # by a program that saved them anew
    assert {p.name: p.camera_key for p in photos} == {
        p.name: f"{key}|jfif" if p.name in turned else key for p in photos
    }
    first = photos[0]
    with Image.open(first.path) as image:
        gps = image.getexif().get_ifd(34853)
    assert first.gps is not None
    degrees, minutes, seconds = map(float, gps[2])
    assert first.gps.latitude_deg == pytest.approx(degrees + minutes / 60 + seconds / 3600, abs=1e-9)
    degrees, minutes, seconds = map(float, gps[4])
    assert first.gps.longitude_deg == pytest.approx(-(degrees + minutes / 60 + seconds / 3600), abs=1e-9)
    assert first.gps.height_m == pytest.approx(198.309)
    assert first.capture_time == datetime(2016, 6, 23, 16, 31, 59)
    assert first.sha256 == hashlib.sha256(first.path.read_bytes()).hexdigest()
    # 3.61 mm on a 1/2.3 inch sensor (6.17 mm wide), which the maker calls 20 mm.
    assert first.focal_px == pytest.approx(3.61 / 6.17 * 4000, rel=0.02)


def test_both_ways_to_the_focal_length_agree(shared_data: Path) -> None:
    """The S100 writes its sensor's resolution, used here, and the 35 mm equivalent of 24 mm."""
    photo = scan_folder(shared_data / "lewis" / "images").usable[0]
    assert photo.focal_px == pytest.approx(24 * math.hypot(1600, 1200) / 43.2666, rel=0.01)


def test_copr_has_no_position_and_one_camera(shared_data: Path) -> None:
    usable = scan_folder(shared_data / "copr" / "images").usable
    assert len(usable) == 41
    assert all(p.gps is None for p in usable)
    assert {p.camera_key for p in usable} == {"canon|canon eos digital rebel xsi|2136x1424|f2870|jfif"}


def test_photos_without_metadata_share_no_camera(shared_data: Path) -> None:
    usable = scan_folder(shared_data / "sacre_coeur" / "mapping").usable
    assert len(usable) == 10
    assert {p.camera_key for p in usable} == {""}


@pytest.mark.parametrize(
    "name", ["lewis", *(pytest.param(name, marks=pytest.mark.evaluation) for name in ("brighton", "copr"))]
)
def test_true_neighbours_are_farther_than_any_copy(shared_data: Path, name: str) -> None:
    grays = [decode_gray(path) for path in sorted((shared_data / name / "images").iterdir())[:18]]
    hashes = hash_bits([picture_hash(gray) for gray in grays])
    nearest = min(int(hash_distances(a, b[None])[0]) for a, b in itertools.combinations(hashes, 2))
    farthest = 0
    for gray, own in zip(grays[:5], hashes[:5], strict=True):
        for side, quality in itertools.product((1.0, 0.5, 0.25), (95, 40)):
            copy = cv2.resize(gray, None, fx=side, fy=side, interpolation=cv2.INTER_AREA)
            data = cv2.imencode(".jpg", np.clip(copy * 1.1, 0, 255), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            copied = hash_bits([picture_hash(decode_gray(data.tobytes()))])
            farthest = max(farthest, int(hash_distances(own, copied)[0]))
    assert farthest <= MAX_BITS < nearest


def test_a_smaller_copy_of_a_flight_is_found(shared_data: Path, tmp_path: Path) -> None:
    sources = sorted((shared_data / "lewis" / "images").iterdir())[:6]
    for path in sources:
        (tmp_path / path.name).symlink_to(path)
    with Image.open(sources[2]) as image:
        buffer = io.BytesIO()
        image.resize((800, 600)).save(buffer, "JPEG", quality=60)  # its EXIF is lost
    (tmp_path / "from_a_chat.jpg").write_bytes(buffer.getvalue())
    result = scan_folder(tmp_path)
    assert len(result.usable) == 6
    assert [p.duplicate_of for p in result.photos if p.name == "from_a_chat.jpg"] == [sources[2].name]
