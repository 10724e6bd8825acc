"""A server told to stop in the middle of its load ends cleanly; tools/service_stops.py does it often."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from featuredb.store import Database
from tests.support.planar_map import field_texture, planar_map, render, view
from tools.service_stops import stopped_under_load


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "field"
    Database.create(path).commit_map(planar_map(1))
    return path


@pytest.mark.parametrize(
    "after_s", [*(pytest.param(s, marks=pytest.mark.evaluation) for s in (0.0, 0.1)), 0.7]
)
def test_a_stop_under_load_is_clean(database: Path, after_s: float) -> None:
    _, photo = cv2.imencode(".png", render(field_texture(1), view(4, -6, 40, 10, 33), seed=50))
    stopped = stopped_under_load(database, bytes(photo), after_s)
    assert stopped.clean, stopped
    assert stopped.codes


_POLLED = """
import os, signal, sys, threading
from featuredb.cli.main import main
from featuredb.store import Database
from reloc.service import serve

def poll(database):
    while True:
        database.poll_version()

def with_threads_that_go_on(database, *args, on_ready):
    for _ in range(2):
        threading.Thread(target=poll, args=(Database.open(database.url),), daemon=True).start()
    real(database, *args, on_ready=lambda server: os.kill(os.getpid(), signal.SIGTERM))

real, serve.serve = serve.serve, with_threads_that_go_on
sys.exit(main(["serve", sys.argv[1], "--listen", "tcp/127.0.0.1:0"]))
"""


def test_threads_in_native_code_do_not_crash_the_end(database: Path) -> None:
    """As the watcher of the store that was not done in time: the interpreter's end crashes 9 of 10."""
    done = subprocess.run(
        [sys.executable, "-c", _POLLED, str(database)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert '"event": "stopped"' in done.stderr
