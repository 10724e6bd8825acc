"""Segments kept as files: the same arrays, made anew where a file is broken, bounded."""

import logging
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.index.descriptor_index import LISTS
from featuredb.index.segment import Segment, segment_of
from featuredb.index.segment_files import SegmentFiles, _kinds, _write
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
    assert_same(SegmentFiles("db", tmp_path).get("w1", made), made.segment)
    again = SegmentFiles("db", tmp_path).get("w1", made)
    assert made.count == 1
    assert_same(again, made.segment)
    assert not again.image_center.flags.writeable  # of the mapped file, not a copy


def test_another_state_and_another_database_are_other_segments(tmp_path: Path) -> None:
    for k, (database, write_id) in enumerate([("db", "w1"), ("db", "w2"), ("other", "w1")]):
        made = Made(seed=k)
        assert_same(SegmentFiles(database, tmp_path).get(write_id, made), made.segment)
        assert made.count == 1
    assert len(files_of(tmp_path)) == 3


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def of_zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def rewritten(path: Path, **changed: object) -> None:
    _write(path, replace(Made().segment, **changed))  # type: ignore[arg-type]


def of_fewer_codes(path: Path) -> None:
    rewritten(path, codes=Made().segment.codes[:-1])


def of_fewer_descriptors(path: Path) -> None:
    rewritten(path, descriptors=Made().segment.descriptors[:-3])


def of_no_such_list(path: Path) -> None:
    rewritten(path, lists=np.full_like(Made().segment.lists, LISTS))


def of_no_such_point(path: Path) -> None:
    rewritten(path, see_point=Made().segment.see_point.astype(np.int32) + np.int32(100_000))


def of_slices_that_go_back(path: Path) -> None:
    rewritten(path, image_start=Made().segment.image_start[::-1])


def test_points_that_images_see_take_two_bytes_where_these_tell_all() -> None:
    assert Made().segment.see_point.dtype == np.uint16
    assert [_kinds(points)["see_point"][0] for points in (1 << 16, (1 << 16) + 1)] == ["<u2", "<i4"]


@pytest.mark.parametrize(
    "broken",
    [
        cut,
        emptied,
        of_zeros,
        of_fewer_codes,
        of_fewer_descriptors,
        of_no_such_list,
        of_no_such_point,
        of_slices_that_go_back,
    ],
)
def test_a_broken_file_is_made_anew(
    tmp_path: Path, broken: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    made, files = Made(), SegmentFiles("db", tmp_path)
    files.get("w1", made)
    (path,) = files_of(tmp_path)
    broken(path)
    with caplog.at_level(logging.WARNING):
        assert_same(files.get("w1", made), made.segment)
    assert "made anew" in caplog.text
    assert made.count == 2
    files.get("w1", made)
    assert made.count == 2


def test_the_folder_is_bounded_and_what_is_used_stays(tmp_path: Path) -> None:
    """What was not used for longest goes first; the next start finds all that fits."""
    size = 0
    for k in range(4):
        before = set(files_of(tmp_path))
        SegmentFiles("db", tmp_path).get(f"w{k}", Made())
        (new,) = set(files_of(tmp_path)) - before
        size = new.stat().st_size
        os.utime(new, (k, k))
    files = SegmentFiles("db", tmp_path, most_bytes=int(2.5 * size))
    files.get("w1", Made())
    files.get("w9", Made())
    files.settle()
    for write_id, kept in (("w0", False), ("w1", True), ("w2", False), ("w3", False), ("w9", True)):
        made = Made()
        SegmentFiles("db", tmp_path).get(write_id, made)
        assert (made.count == 0) == kept, write_id


def test_of_more_than_fits_the_same_part_is_kept_at_each_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    SegmentFiles("db", tmp_path / "probe").get("w", Made())
    (path,) = files_of(tmp_path / "probe")
    most = int(5.5 * path.stat().st_size)
    counts = []
    for _ in range(3):
        files, made = SegmentFiles("db", tmp_path / "cache", most), [Made() for _ in range(8)]
        with caplog.at_level(logging.WARNING):
            for k in range(8):
                files.get(f"w{k}", made[k])
        files.settle()
        counts.append(sum(one.count for one in made))
    assert counts[0] == 8
    assert counts[1] == counts[2] <= 4
    assert caplog.text.count("is not kept") == 3, "once a start"


def test_a_folder_that_may_only_be_read_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made()
    SegmentFiles("db", tmp_path).get("w1", made)

    def refused(*_: object) -> None:
        raise PermissionError("only for reading")

    monkeypatch.setattr("featuredb.index.segment_files.os.utime", refused)
    monkeypatch.setattr("featuredb.index.segment_files.atomic_file", refused)
    files = SegmentFiles("db", tmp_path)
    assert_same(files.get("w1", made), made.segment)
    assert made.count == 1


def test_without_a_home_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    made, files = Made(), SegmentFiles("db")
    for _ in range(2):
        assert_same(files.get("w1", made), made.segment)
    files.settle()
    assert made.count == 2


def test_where_nothing_can_be_kept_it_is_made_each_time(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    made, files = Made(), SegmentFiles("db", tmp_path / "file" / "segments")
    for _ in range(2):
        assert_same(files.get("w1", made), made.segment)
    assert made.count == 2
