"""Attacks on `featuredb serve` over a real map: each costs its own query, and honest clients are answered."""

import io
import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from PIL import Image

from featuredb.errors import ServiceError
from featuredb.store import Database
from reloc.client import CameraRequest, Client
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from tests.support.live import wait_until
from tests.support.planar_map import CAMERA, field_texture, planar_map, render, view
from tools.attacks import png, progressive_jpeg, zeros
from tools.serve_process import ServeProcess

SIDE = 10_944  # 120 million pixels, the most that are taken
LENS = CameraRequest(model="PINHOLE", width=640, height=480, params=CAMERA.params)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "field"
    Database.create(path).commit_map(planar_map(1))
    return path


@pytest.fixture(scope="module")
def server(database: Path) -> Iterator[ServeProcess]:
    process = ServeProcess(database, "--workers", 1, "--deadline", 20)
    yield process
    assert process.stop() == 0


@pytest.fixture(scope="module")
def client(server: ServeProcess) -> Iterator[Client]:
    with Client(server.endpoint) as connected:
        yield connected


@pytest.fixture(scope="module")
def honest() -> bytes:
    out = io.BytesIO()
    Image.fromarray(render(field_texture(1), view(4, -6, 40, 10, 33), seed=50)).save(out, "PNG")
    return out.getvalue()


@pytest.fixture(scope="module")
def slow() -> bytes:
    """Taken, and seconds of work: 960 MB of pixels."""
    return png(SIDE, SIDE, zeros((SIDE * 8 + 1) * SIDE), bits=16, colour=6)


def refusal(client: Client, data: bytes, timeout_s: float = 40.0) -> ServiceError:
    with pytest.raises(ServiceError) as caught:
        client.localise(data, timeout_s=timeout_s)
    return caught.value


def in_hand(client: Client) -> None:
    """Wait until a worker has a query."""
    end = time.monotonic() + 20.0
    while client.status().queue.busy == 0:
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_query_beyond_its_time_ends_with_its_worker(
    server: ServeProcess, client: Client, honest: bytes, slow: bytes
) -> None:
    (before,) = server.workers
    assert refusal(client, slow, timeout_s=0.6).code == "DEADLINE"
    assert client.localise(honest, camera=LENS, timeout_s=20.0).status == "localised"
    (after,) = server.workers
    assert after != before
    assert client.status().queue.ready == 1


def test_a_worker_that_hangs_is_replaced(server: ServeProcess, client: Client, honest: bytes) -> None:
    (before,) = server.workers
    os.kill(before, signal.SIGSTOP)
    assert refusal(client, honest, timeout_s=1.0).code == "DEADLINE"
    assert client.localise(honest, camera=LENS, timeout_s=20.0).status == "localised"
    assert before not in server.workers


def test_a_worker_that_crashes_costs_its_query_alone(
    server: ServeProcess, client: Client, honest: bytes, slow: bytes
) -> None:
    with ThreadPoolExecutor(2) as pool:
        crashing: Future[ServiceError] = pool.submit(refusal, client, slow)
        in_hand(client)
        waiting = pool.submit(client.localise, honest, camera=LENS, timeout_s=20.0)
        (worker,) = server.workers
        os.kill(worker, signal.SIGSEGV)
        error = crashing.result()
        assert (error.code, "SIGSEGV" in error.message) == ("INTERNAL", True)
        assert waiting.result().status == "localised"


def test_a_worker_that_dies_between_queries_costs_none(
    server: ServeProcess, client: Client, honest: bytes
) -> None:
    (worker,) = server.workers
    os.kill(worker, signal.SIGKILL)
    while Path(f"/proc/{worker}").exists():
        time.sleep(0.005)
    assert client.localise(honest, camera=LENS, timeout_s=20.0).status == "localised"


def test_passes_over_many_pixels_are_refused_before_decoding(client: Client) -> None:
    data = progressive_jpeg(SIDE, 80)
    assert len(data) < 300_000
    start = time.monotonic()
    error = refusal(client, data)
    assert (error.code, "80 scans" in error.message) == ("TOO_LARGE", True)
    assert time.monotonic() - start < 3.0


def test_memory_beyond_the_limit_is_not_given(database: Path, honest: bytes) -> None:
    options = ServeOptions(
        # Stacks and heaps of further threads take a hundred megabytes of addresses.
        listen=("tcp/127.0.0.1:0",),
        workers=1,
        threads_per_worker=1,
        query_memory_bytes=200 << 20,
        deadline_s=60,
    )
    with start_server(Database.open(database), options) as server, Client(server.endpoints[0]) as client:
        error = refusal(client, progressive_jpeg(SIDE, 2))  # 240 MB of coefficients
        assert error.code in ("TOO_LARGE", "BAD_IMAGE")
        assert client.localise(honest, camera=LENS, timeout_s=20.0).status == "localised"


def test_slow_queries_leave_time_for_those_who_wait(database: Path) -> None:
    """Both workers hang with one; others have asked at once, with the same deadline."""
    plain = png(640, 480, zeros(641 * 480))  # without features: answered at once
    process = ServeProcess(database, "--deadline", 10)
    try:
        with Client(process.endpoint) as client, ThreadPoolExecutor(7) as pool:
            wait_until(lambda: client.status().queue.ready == 2, "both workers are ready")
            for worker in process.workers:
                os.kill(worker, signal.SIGSTOP)
            hung = [pool.submit(refusal, client, plain) for _ in range(2)]
            wait_until(lambda: client.status().queue.busy == 2, "both workers have a query")
            asked = [pool.submit(client.localise, plain) for _ in range(3)]
            assert [f.result().status for f in asked] == ["not_localised"] * 3
            assert [f.result().code for f in hung] == ["DEADLINE"] * 2
    finally:
        assert process.stop() == 0
