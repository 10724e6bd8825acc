"""The server's workers where something fails around them."""

import errno
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
from reloc.localiser import OnDemand
from reloc.service.handler import answer_query
from reloc.service.workers import answering, process
from reloc.service.workers.answering import WorkerLimits
from reloc.service.workers.area_files import AreaFiles
from reloc.service.workers.process import WorkerEndedError, WorkerProcess

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
    with pytest.raises(WorkerEndedError):
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
