"""A server told to stop in the middle of its load ends cleanly; tools/service_stops.py does it often."""

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


@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.7])
def test_a_stop_under_load_is_clean(database: Path, after_s: float) -> None:
    _, photo = cv2.imencode(".png", render(field_texture(1), view(4, -6, 40, 10, 33), seed=50))
    stopped = stopped_under_load(database, bytes(photo), after_s)
    assert stopped.clean, stopped
    assert stopped.codes
