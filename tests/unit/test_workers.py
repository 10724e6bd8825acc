"""The server's workers where something fails around them."""

import errno
import os
import pickle
import resource
import tempfile
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from featuredb.errors import ImageError, StoreError
from featuredb.features import decode
from featuredb.features.decode import DecodeLimits
from featuredb.store import Database
from reloc.localiser import Localiser, OnDemand
from reloc.service.handler import answer_query
from reloc.service.workers import answering, process
from reloc.service.workers.answering import WorkerLimits, _is_out_of_memory
from reloc.service.workers.area_files import AreaFiles, MappedAreas
from reloc.service.workers.process import WorkerFailedError, WorkerProcess
from tests.support.field_queries import moved
from tests.support.maps import random_map

LIMITS = WorkerLimits(threads=1, memory_bytes=1 << 30, processor_s=5.0)
ANSWERER = answer_query


def test_a_process_that_was_told_to_end_is_not_alive():
    worker = WorkerProcess(LIMITS, ANSWERER)
    try:
        assert worker.is_alive()
        worker.kill()
        assert not worker.is_alive()
    finally:
        worker.close()


def test_too_many_open_files_are_a_process_that_does_not_come_up(monkeypatch):
    def none_left():
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(process, "_CONTEXT", SimpleNamespace(Pipe=none_left))
    with pytest.raises(WorkerFailedError):
        WorkerProcess(LIMITS, ANSWERER)


@pytest.mark.parametrize(("hard", "set_to"), [(1000, 1000), (resource.RLIM_INFINITY, 5000)])
def test_limits_stay_below_those_of_the_system(monkeypatch, hard, set_to):
    limits = []
    monkeypatch.setattr(resource, "getrlimit", lambda which: (0, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda which, both: limits.append(both))
    answering._set_limit(resource.RLIMIT_CPU, 5000)
    assert limits == [(set_to, hard)]


def test_a_map_that_cannot_be_read_is_told_to_who_names_it():
    def broken():
        raise StoreError("its points are gone")

    copy = pickle.loads(pickle.dumps(OnDemand("w1", broken)))
    with pytest.raises(StoreError, match="its points are gone"):
        copy.get()


def test_what_did_not_change_over_reloads_keeps_its_file_and_its_mapping(tmp_path):
    """A worker gets a localiser's files, three times, and answers from the same arrays."""
    database = Database.create(tmp_path / "db")
    database.commit_map(random_map(0, map_id="a", extent_m=50.0))
    database.commit_map(moved(random_map(1, map_id="b", extent_m=50.0), "b", 100.0))
    writer, reader = AreaFiles(), MappedAreas()
    localiser, mapped, keys = None, [], []
    for change in (None, "c", None):
        if change is not None:
            database.commit_map(moved(random_map(2, extent_m=50.0), change, 5_000.0))
        localiser = Localiser.open(database, previous=localiser)
        files = writer.of(localiser)
        keys.append([file.key for file in files])
        waiting = iter(files)
        mapped.append(reader.localiser(keys[-1], lambda it=waiting: os.dup(next(it).file.fileno())))
        for own, theirs in zip(localiser.areas, mapped[-1].areas, strict=True):
            assert (own.first, len(own.index)) == (theirs.first, len(theirs.index))
            assert [m.map_id for m in own.area.maps] == [m.map_id for m in theirs.area.maps]
            for name in ("point_start", "image_sights", "image_center"):
                np.testing.assert_array_equal(getattr(own.area, name), getattr(theirs.area, name))
            for name in ("points", "view_direction", "descriptors", "lists", "point_row"):
                np.testing.assert_array_equal(
                    getattr(own.area, name).whole(), getattr(theirs.area, name).whole()
                )
    first, second, third = mapped
    assert second.areas[0].area is first.areas[0].area
    assert len(second.areas) == 2
    assert third.areas[1].area is second.areas[1].area
    assert third.areas[0].index is second.areas[0].index
    assert set(keys[0][:-2]) < set(keys[1])  # all but its index and itself
    assert set(keys[2]) - set(keys[1]) == {keys[2][-1]}  # itself


def test_a_full_disk_is_named(monkeypatch):
    def full(**_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(StoreError, match=r"No space left on device.*TMPDIR"):
        AreaFiles().of(SimpleNamespace())


def test_a_picture_without_memory_for_it_is_too_large(monkeypatch):
    data = cv2.imencode(".png", np.zeros((400, 400), np.uint8))[1].tobytes()

    def no_memory(*_):
        raise MemoryError

    monkeypatch.setattr(decode.cv2, "imdecode", no_memory)
    with pytest.raises(ImageError) as error:
        decode.decode_gray(data, DecodeLimits())
    assert error.value.code == "too_large"


@pytest.mark.parametrize(
    ("error", "is_it"),
    [(MemoryError(), True), (RuntimeError("can't start new thread"), True), (RuntimeError("else"), False)],
)
def test_what_a_lack_of_memory_looks_like(error: Exception, is_it: bool) -> None:
    assert _is_out_of_memory(error) == is_it
