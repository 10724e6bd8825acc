"""Photos of a map in a folder: by name, by content, and the reasons why not."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.maps.feature_map import MapImage
from featuredb.maps.photo_files import PhotoFolder
from tests.support.maps import random_map


def image(name: str, data: bytes) -> MapImage:
    return replace(random_map(images=1).images[0], name=name, sha256=hashlib.sha256(data).hexdigest())


def test_a_photo_is_found_by_its_name_and_by_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    (tmp_path / "day" / "a.jpg").write_bytes(b"a")
    (tmp_path / "renamed.JPG").write_bytes(b"b")
    folder = PhotoFolder(tmp_path)
    assert folder.find(image("day/a.jpg", b"a")) == (tmp_path / "day" / "a.jpg", "")
    assert folder.find(image("day/b.jpg", b"b")) == (tmp_path / "renamed.JPG", "")


def test_a_file_of_the_name_with_other_bytes_does_not_count(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"edited")
    path, reason = PhotoFolder(tmp_path).find(image("a.jpg", b"a"))
    assert path is None
    assert "SHA-256" in reason


def test_a_file_that_has_changed_is_read_again(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"edited")
    folder = PhotoFolder(tmp_path)
    assert folder.by_name(image("a.jpg", b"a"))[0] is None
    (tmp_path / "a.jpg").write_bytes(b"a")
    assert folder.by_name(image("a.jpg", b"a"))[0] == tmp_path / "a.jpg"


@pytest.mark.parametrize("name", ["../secret.jpg", "day/../../secret.jpg", "/secret.jpg"])
def test_a_name_does_not_lead_out_of_the_folder(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "photos"
    (inside / "day").mkdir(parents=True)
    (tmp_path / "secret.jpg").write_bytes(b"s")
    asked = name if not name.startswith("/") else str(tmp_path / "secret.jpg")
    path, reason = PhotoFolder(inside).find(image(asked, b"s"))
    assert path is None
    assert reason == "its name leads out of the folder"
