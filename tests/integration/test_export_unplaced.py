"""Maps without a place leave in their own frame, and formats that need a place say so."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from featuredb.cli.main import main
from featuredb.export.formats.ply import ROW
from featuredb.store import Database
from featuredb.store.verify import verify
from tests.support.maps import random_map, random_unplaced_map


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    database = Database.create(tmp_path_factory.mktemp("unplaced") / "db")
    database.commit_maps([random_unplaced_map(1), random_map(2)])
    return database.url


def _export(url: str, out: Path, kind: str, *more: str) -> int:
    return main(["export", url, str(out), "--format", kind, *more])


def test_colmap_has_the_own_frame(url: str, tmp_path: Path) -> None:
    unplaced = Database.open(url).snapshot().load_unplaced("map-1")
    assert _export(url, tmp_path / "colmap", "colmap", "--status", "unplaced") == 0
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "map-1" / "sparse"))
    assert np.allclose([model.points3D[k + 1].xyz for k in range(60)], unplaced.points.xyz)
    told = json.loads((tmp_path / "colmap" / "map-1" / "georeference.json").read_text())
    assert (told["placement"], told["frame"]["origin"], told["frame"]["upright"]) == (None, None, True)
    assert told["no_place"]["ways"] == ["place it by picks"]
    assert "utm" not in told


def test_ply_keeps_them_apart_from_places_on_earth(url: str, tmp_path: Path) -> None:
    assert _export(url, tmp_path / "ply", "ply", "--maps", "map-1", "map-2") == 0
    files = sorted(path.name for path in (tmp_path / "ply").glob("*.ply"))
    assert files == ["epsg32632_unknown.ply", "own_frame_map-1.ply"]
    header, body = (tmp_path / "ply" / "own_frame_map-1.ply").read_bytes().split(b"end_header\n", 1)
    assert b"no place on Earth" in header
    unplaced = Database.open(url).snapshot().load_unplaced("map-1")
    rows = np.frombuffer(body, dtype=ROW)
    assert np.array_equal(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), unplaced.points.xyz)
    assert "map-1,random map 1,own_frame_map-1.ply,,,60" in (tmp_path / "ply" / "maps.csv").read_text()


@pytest.mark.parametrize("kind", ["las", "geojson", "kml", "geopose", "opensfm", "dataset"])
def test_formats_that_need_a_place_say_so(
    url: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _export(url, tmp_path / "out", kind, "--maps", "map-1") == 2
    error = capsys.readouterr().err
    assert "map-1 has no place" in error
    assert "place it by picks" in error
    assert "colmap, ply" in error
    assert not (tmp_path / "out").exists()


def test_a_map_without_a_place_is_thinned_where_it_is(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = Database.open(url).snapshot().load_unplaced("map-1")
    assert main(["thin", url, "map-1", "--cover", "15"]) == 0
    after = Database.open(url).snapshot().load_unplaced("map-1")
    assert 0 < after.observations.has_descriptor.sum() < before.observations.has_descriptor.sum()
    assert after.no_place == before.no_place
    assert verify(Database.open(url)).problems == ()
    version = Database.open(url).snapshot().version
    assert main(["rollback", url, str(version - 1)]) == 0
    back = Database.open(url).snapshot().load_unplaced("map-1")
    assert back.observations.has_descriptor.sum() == before.observations.has_descriptor.sum()
