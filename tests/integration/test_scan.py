"""Scanning folders: order, reasons, copies, links, cache."""

import io
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from featuredb.errors import IngestError
from featuredb.features.decode import DecodeLimits
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, require_usable, scan_folder


def scene(seed: int, size: tuple[int, int] = (640, 480)) -> Image.Image:
    """A smooth random picture."""
    coarse = np.random.default_rng(seed).integers(0, 256, (9, 12, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC)


def save(path: Path, image: Image.Image, **tags: Any) -> None:
    """Write a JPEG; tags: make, time, gps=(latitude, longitude)."""
    exif = Image.Exif()
    if "make" in tags:
        exif.update({271: tags["make"], 272: "Model"})
        exif.get_ifd(34665)[41989] = 28
    if "time" in tags:
        exif.get_ifd(34665)[36867] = tags["time"]
    if "gps" in tags:
        latitude, longitude = tags["gps"]
        exif.get_ifd(34853).update({1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0)})
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, "JPEG", quality=tags.get("quality", 90), exif=exif)


def by_name(photos: tuple[Photo, ...]) -> dict[str, Photo]:
    return {photo.name: photo for photo in photos}


def test_every_entry_has_its_outcome_in_the_order_of_names(tmp_path: Path) -> None:
    save(tmp_path / "b.jpg", scene(1), make="Maker", gps=(48.1, 11.5), time="2024:01:02 03:04:05")
    save(tmp_path / "a" / "deep" / "c.JPEG", scene(2))
    save(tmp_path / "no_extension", scene(3))
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "x.jpg").mkdir()
    save(tmp_path / "x.jpg" / "inside.jpg", scene(4))
    save(tmp_path / ".hidden.jpg", scene(5))
    save(tmp_path / ".thumbs" / "t.jpg", scene(5))
    save(tmp_path / "small.jpg", scene(6, (200, 300)))
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "b.jpg").read_bytes()[:-40])
    os.mkfifo(tmp_path / "pipe.jpg")
    result = scan_folder(tmp_path)
    assert [(p.name, p.status, p.reason_code) for p in result.photos] == [
        (".hidden.jpg", "skipped", "hidden"),
        (".thumbs", "skipped", "hidden"),
        ("a/deep/c.JPEG", "ok", ""),
        ("b.jpg", "ok", ""),
        ("cut.jpg", "skipped", "truncated"),
        ("empty.jpg", "skipped", "not_an_image"),
        ("no_extension", "ok", ""),
        ("notes.txt", "skipped", "not_an_image"),
        ("pipe.jpg", "skipped", "unreadable"),
        ("small.jpg", "skipped", "too_small"),
        ("x.jpg/inside.jpg", "ok", ""),
    ]
    assert all(photo.reason for photo in result.photos if photo.status == "skipped")
    assert result.skipped == {"hidden": 2, "truncated": 1, "not_an_image": 2, "unreadable": 1, "too_small": 1}
    b = by_name(result.photos)["b.jpg"]
    assert (b.width, b.height, b.make, b.model) == (640, 480, "Maker", "Model")
    assert b.camera_key == f"maker|model|640x480|f{float(f'{b.focal_px:.3g}'):.0f}|jfif"
    assert b.gps is not None
    assert (b.gps.latitude_deg, b.gps.height_m) == (pytest.approx(48.1), None)
    assert by_name(result.photos)["no_extension"].camera_key == ""


def test_loops_of_links_end_and_linked_files_are_copies(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "up").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "sub" / "itself").symlink_to(tmp_path / "sub", target_is_directory=True)
    (tmp_path / "z.jpg").symlink_to(tmp_path / "a.jpg")
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nothing")
    (tmp_path / "self.jpg").symlink_to(tmp_path / "self.jpg")
    found = {p.name: p.reason_code for p in scan_folder(tmp_path).photos}
    assert found == {
        "a.jpg": "",
        "gone.jpg": "unreadable",
        "self.jpg": "unreadable",
        "sub/itself": "folder_again",
        "sub/up": "folder_again",
        "z.jpg": "duplicate",
    }


def test_names_that_are_not_text_are_reported(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    shutil.copy(tmp_path / "a.jpg", os.fsencode(tmp_path) + b"/\xff\xfe.jpg")
    photos = scan_folder(tmp_path).photos
    assert [(p.name, p.reason_code) for p in photos] == [(r"\xff\xfe.jpg", "bad_name"), ("a.jpg", "")]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_files_without_permission_are_reported(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    (tmp_path / "a.jpg").chmod(0)
    (tmp_path / "sub").mkdir(mode=0)
    assert [p.reason_code for p in scan_folder(tmp_path).photos] == ["unreadable", "unreadable"]


def test_same_bytes_keep_the_first_name(tmp_path: Path) -> None:
    save(tmp_path / "b.jpg", scene(1))
    for name in ("c.jpg", "a.jpg"):
        shutil.copy(tmp_path / "b.jpg", tmp_path / name)
    photos = scan_folder(tmp_path).photos
    assert [(p.name, p.reason_code, p.duplicate_of) for p in photos] == [
        ("a.jpg", "", ""),
        ("b.jpg", "duplicate", "a.jpg"),
        ("c.jpg", "duplicate", "a.jpg"),
    ]


def test_same_picture_keeps_the_largest(tmp_path: Path) -> None:
    save(tmp_path / "a_small.jpg", scene(1, (320, 240)), quality=40)
    save(tmp_path / "b_original.jpg", scene(1), make="Maker", time="2024:01:02 03:04:05")
    save(tmp_path / "c_again.jpg", scene(1), quality=60)
    save(tmp_path / "d_other.jpg", scene(2))
    photos = scan_folder(tmp_path).photos
    assert [(p.name, p.reason_code, p.duplicate_of) for p in photos] == [
        ("a_small.jpg", "near_duplicate", "b_original.jpg"),
        ("b_original.jpg", "", ""),
        ("c_again.jpg", "near_duplicate", "b_original.jpg"),
        ("d_other.jpg", "", ""),
    ]


@pytest.mark.parametrize(
    ("mine", "other", "copies"),
    [
        ({"time": "2024:01:02 03:04:05"}, {"time": "2024:01:02 03:04:06"}, True),
        ({"time": "2024:01:02 03:04:05"}, {"time": "2024:01:02 03:09:05"}, False),
        ({"time": "2024:01:02 03:04:05"}, {}, True),
        ({"gps": (48.1, 11.5)}, {"gps": (48.1000045, 11.5)}, True),  # half a metre
        ({"gps": (48.1, 11.5)}, {"gps": (48.10002, 11.5)}, False),  # 2.2 metres
        ({"make": "Maker"}, {"make": "Other"}, False),
    ],
)
def test_a_scene_that_stands_still_is_no_copy(
    tmp_path: Path, mine: dict[str, Any], other: dict[str, Any], copies: bool
) -> None:
    save(tmp_path / "a.jpg", scene(1), **mine)
    save(tmp_path / "b.jpg", scene(1), quality=70, **other)
    assert (len(scan_folder(tmp_path).usable) == 1) == copies


def test_other_shapes_are_no_copies(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    save(tmp_path / "b.jpg", scene(1, (640, 360)))
    assert len(scan_folder(tmp_path).usable) == 2


def test_limits_are_obeyed(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    limits = DecodeLimits(max_pixels=640 * 480 - 1)
    assert [p.reason_code for p in scan_folder(tmp_path, ScanOptions(limits=limits)).photos] == ["too_large"]


def test_a_large_film_is_refused_by_its_first_bytes(tmp_path: Path) -> None:
    with (tmp_path / "film.mp4").open("wb") as file:
        file.write(b"\0\0\0\x18ftypmp42")
        file.truncate(1 << 40)
    assert [p.reason_code for p in scan_folder(tmp_path).photos] == ["unsupported"]


def test_the_cache_spares_reading_and_sees_changes(tmp_path: Path) -> None:
    folder, cache = tmp_path / "photos", tmp_path / "work" / "scan.json"
    save(folder / "a.jpg", scene(1), make="Maker", gps=(48.1, 11.5), time="2024:01:02 03:04:05")
    save(folder / "b.jpg", scene(2))
    (folder / "c.jpg").write_bytes(b"no photo")
    first = scan_folder(folder, cache_file=cache)
    again = scan_folder(folder, cache_file=cache)
    assert (first.read, again.read) == (3, 0)
    assert _comparable(first.photos) == _comparable(again.photos)
    save(folder / "b.jpg", scene(3))
    os.utime(folder / "b.jpg", ns=(1, 1))
    (folder / "a.jpg").rename(folder / "d.jpg")
    changed = scan_folder(folder, cache_file=cache)
    assert changed.read == 2
    assert [p.name for p in changed.usable] == ["b.jpg", "d.jpg"]
    assert by_name(changed.usable)["d.jpg"].sha256 == by_name(first.usable)["a.jpg"].sha256
    assert set(json.loads(cache.read_text())["files"]) == {"b.jpg", "c.jpg", "d.jpg"}
    other = ScanOptions(limits=DecodeLimits(min_side_px=100))
    assert scan_folder(folder, other, cache_file=cache).read == 3


@pytest.mark.parametrize("content", ["", "{", "[]", '{"key": 1}', '{"key": "1:x", "files": 7}', "\0"])
def test_a_broken_cache_is_not_used(tmp_path: Path, content: str) -> None:
    save(tmp_path / "photos" / "a.jpg", scene(1))
    cache = tmp_path / "scan.json"
    scan_folder(tmp_path / "photos", cache_file=cache)
    key = json.loads(cache.read_text())["key"]
    cache.write_text(content.replace("1:x", key))
    assert scan_folder(tmp_path / "photos", cache_file=cache).read == 1
    assert scan_folder(tmp_path / "photos", cache_file=cache).read == 0


def test_attribution_of_photos_that_name_none(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(1))
    exif = Image.Exif()
    exif.update({315: "A. Person", 33432: "CC0"})
    scene(2).save(tmp_path / "b.jpg", exif=exif)
    photos = scan_folder(tmp_path, ScanOptions(owner="The Club", licence="CC BY 4.0")).photos
    assert [(p.owner, p.licence) for p in photos] == [("The Club", "CC BY 4.0"), ("A. Person", "CC0")]


def test_progress_ends_at_all_files(tmp_path: Path) -> None:
    for seed in range(4):
        save(tmp_path / f"{seed}.jpg", scene(seed))
    calls: list[tuple[str, int, int]] = []
    scan_folder(tmp_path, progress=lambda *call: calls.append(call))
    assert calls == [("scan", done, 4) for done in range(5)]


def test_folders_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "nothing", tmp_path / "file"):
        with pytest.raises(IngestError, match="expected a folder"):
            scan_folder(folder)
    result = scan_folder(tmp_path)
    with pytest.raises(IngestError, match=r"1 not_an_image; file: .+\)$"):
        require_usable(result, tmp_path)


def _comparable(photos: tuple[Photo, ...]) -> list[Any]:
    """Photos with their positions as numbers: GeoPrior has no equality."""
    return [
        (replace(p, gps=None), p.gps and (p.gps.latitude_deg, p.gps.longitude_deg, p.gps.sigma_horizontal_m))
        for p in photos
    ]


def test_random_files_are_decoded_as_their_bytes_say(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    scene(1).save(buffer, "PNG")
    (tmp_path / "really_png.jpg").write_bytes(buffer.getvalue())
    save(tmp_path / "really_jpeg.png", scene(2))
    assert [p.status for p in scan_folder(tmp_path).photos] == ["ok", "ok"]
