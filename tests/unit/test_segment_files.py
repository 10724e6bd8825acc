"""Segments kept as files: the same arrays, made anew where a file is broken, bounded."""

import logging
import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from featuredb.index.segment import Segment, segment_of
from featuredb.index.segment_files import SegmentFiles
from tests.support.maps import random_map


class Made:
    """Makes segments and counts them."""

    def __init__(self, seed: int = 0, observations: int = 200) -> None:
        self.count = 0
        self.segment = segment_of(random_map(seed, observations=observations))

    def __call__(self) -> Segment:
        self.count += 1
        return self.segment


def assert_same(one: Segment, other: Segment) -> None:
    for field in fields(Segment):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        assert mine.dtype == theirs.dtype, field.name
        np.testing.assert_array_equal(mine, theirs, err_msg=field.name)


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("observations", [200, 0])
def test_a_segment_is_made_once_and_mapped_afterwards(tmp_path: Path, observations: int) -> None:
    made = Made(observations=observations)
    assert_same(SegmentFiles(tmp_path).get("db", "w1", made), made.segment)
    again = SegmentFiles(tmp_path).get("db", "w1", made)
    assert made.count == 1
    assert_same(again, made.segment)
    assert not again.image_center.flags.writeable  # of the mapped file, not a copy


def test_another_state_and_another_database_are_other_segments(tmp_path: Path) -> None:
    files = SegmentFiles(tmp_path)
    for k, (database, write_id) in enumerate([("db", "w1"), ("db", "w2"), ("other", "w1")]):
        made = Made(seed=k)
        assert_same(files.get(database, write_id, made), made.segment)
        assert made.count == 1
    assert len(files_of(tmp_path)) == 3


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def of_zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


@pytest.mark.parametrize("broken", [cut, emptied, of_zeros])
def test_a_broken_file_is_made_anew(
    tmp_path: Path, broken: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    made, files = Made(), SegmentFiles(tmp_path)
    files.get("db", "w1", made)
    (path,) = files_of(tmp_path)
    broken(path)
    with caplog.at_level(logging.WARNING):
        assert_same(files.get("db", "w1", made), made.segment)
    assert "made anew" in caplog.text
    assert made.count == 2
    files.get("db", "w1", made)
    assert made.count == 2


def test_what_was_not_used_for_longest_goes_first(tmp_path: Path) -> None:
    size = 0
    for k in range(4):
        before = set(files_of(tmp_path))
        SegmentFiles(tmp_path).get("db", f"w{k}", Made())
        (new,) = set(files_of(tmp_path)) - before
        size = new.stat().st_size
        os.utime(new, (k, k))
    SegmentFiles(tmp_path).get("db", "w1", Made())  # used now
    SegmentFiles(tmp_path, most_bytes=int(2.5 * size)).get("db", "w9", Made())
    for write_id, kept in (("w0", False), ("w1", True), ("w2", False), ("w3", False), ("w9", True)):
        made = Made()
        SegmentFiles(tmp_path).get("db", write_id, made)
        assert (made.count == 0) == kept, write_id


def test_where_nothing_can_be_kept_it_is_made_each_time(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    made, files = Made(), SegmentFiles(tmp_path / "file" / "segments")
    for _ in range(2):
        assert_same(files.get("db", "w1", made), made.segment)
    assert made.count == 2
